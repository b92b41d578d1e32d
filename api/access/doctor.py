"""Checks of API keys for `graspd doctor`: whether an exposed service has keys, and when they expire."""

import stat
from datetime import UTC, datetime, timedelta
from typing import Final

from graspd.api.access.auth import Proxy
from graspd.api.access.keys import KeyFile, Scope
from graspd.api.formatting import is_loopback
from graspd.service.model.errors import GraspdError
from graspd.service.run.doctor.checks import Finding, bad, good, warning
from graspd.service.settings import Settings

_SOON: Final = timedelta(days=7)
_ADD: Final = "graspd keys add admin --scope admin"


def check_keys(settings: Settings) -> Finding:
    path = settings.resolved_keys_file
    try:
        found = KeyFile(path).list()
    except GraspdError as error:
        return bad(str(error), f"restore {path}, or make new keys: move it away, then {_ADD}")
    if not found:
        if Proxy(settings).is_on:
            return good("no keys; people sign in only through the proxy")
        if is_loopback(settings.host):
            return good(f"no keys, and none are needed, because the API binds {settings.host}")
        return bad(f"no keys, but the API does not start on {settings.host} without one", _ADD)
    if stat.S_IMODE(path.stat().st_mode) & 0o007:
        return bad(f"everybody can read {path}, which holds the secret of the browser sessions", f"chmod 600 {path}")
    live = [key for key in found if key.is_live]
    if not live:
        return bad(f"all {len(found)} keys are expired or revoked", _ADD)
    soon = datetime.now(UTC) + _SOON
    kept = {key.name for key in live if key.expires is None or datetime.fromisoformat(key.expires) >= soon}
    if ending := sorted({key.name for key in live} - kept):
        fix = f"graspd keys rotate {ending[0]} --grace 24h"
        return warning(f"keys that expire within a week: {', '.join(ending[:3])}", fix)
    if not any(key.scope is Scope.ADMIN for key in live):
        return warning(f"{len(live)} valid keys, none with scope admin", _ADD)
    return good(f"{len(live)} valid keys")
