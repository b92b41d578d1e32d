"""Checks of the fleet: controller, capable workers, the API, and clocks.

Wrong clocks do not affect leases, which use monotonic clocks. They affect displayed times, sorting by time, expiry of
keys, the grace time of shards, and S3, which refuses requests with a difference of fifteen minutes.
"""

import json
import secrets
import socket
import time
import urllib.error
import urllib.request
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, suppress
from datetime import datetime
from typing import Any, Final

from redis.exceptions import RedisError

from graspd.service.model.errors import GraspdError
from graspd.service.model.messages import WorkerHeartbeat
from graspd.service.model.states import Stage
from graspd.service.model.version import PACKAGE_VERSION
from graspd.service.pipeline.leading import PART
from graspd.service.queue.rq_queue import RqQueue, open_queue
from graspd.service.run.address import local_url, recorded_address
from graspd.service.run.doctor.backends import is_redis_expected, query_queue
from graspd.service.run.doctor.checks import Finding, bad, good, skipped, warning
from graspd.service.run.doctor.machine import local_store
from graspd.service.settings import Settings
from graspd.service.store.store import open_store

_HTTP_S: Final = 5.0


def check_controller(settings: Settings) -> Finding:
    dead = bad("no heartbeat from a controller: nothing is indexed or queued", "graspd controller")
    return query_queue(settings, lambda queue: good("a controller is alive") if queue.is_announced(PART) else dead)


def check_workers(settings: Settings) -> Finding:
    """Check that workers are healthy, have this version and serve every stage with waiting tasks."""
    return query_queue(settings, lambda queue: _check_workers(queue.workers(), _waiting_tasks(queue)))


def _waiting_tasks(queue: RqQueue) -> Counter[Stage]:
    found: Counter[Stage] = Counter()
    for (_, stage), number in queue.depths().items():
        found[stage] += number
    return +found


def _check_workers(beats: list[WorkerHeartbeat], waiting: Counter[Stage]) -> Finding:
    if other := [beat for beat in beats if beat.version != PACKAGE_VERSION]:
        some = ", ".join(sorted({f"{beat.version} on {beat.host}" for beat in other})[:3])
        return bad(f"{len(other)} workers are of another version: {some}", f"install graspd {PACKAGE_VERSION} there")
    if ill := [beat for beat in beats if beat.state == "quarantined"]:
        fix = f"on {ill[0].host}: graspd doctor --only gpu,kernels,disk"
        return bad(f"{len(ill)} workers are in quarantine, such as {ill[0].name}: {ill[0].reason}", fix)
    served = {stage for beat in beats for stage in beat.stages}
    if alone := sorted(stage.value for stage in waiting if stage not in served):
        tasks, stages = sum(number for stage, number in waiting.items() if stage not in served), ",".join(alone)
        return bad(f"{tasks} tasks wait, and no worker serves {', '.join(alone)}", f"graspd worker --stages {stages}")
    if not beats:
        return warning("there is no worker, and no task waits", "graspd worker, or graspd up --workers 1")
    states = sorted(Counter(beat.state for beat in beats).items())
    text = ", ".join(f"{number} {state}" for state, number in states)
    return good(f"{text}, on {len({beat.host for beat in beats})} machines; {sum(waiting.values())} tasks wait")


def check_port(settings: Settings) -> Finding:
    url = recorded_address(settings.data_dir)
    if url is None and "api_url" in settings.model_fields_set:
        url = settings.api_url
    expected = url is not None
    url = url or local_url(settings.host, settings.port)
    found = _query_readiness(url)
    if found is None and not expected:
        return skipped(f"no API runs at {url}")
    if found is None:
        return bad(f"no API answers at {url}", "start graspd api; check proxy, firewall and GRASPD_API_URL")
    if not found:
        return bad(f"the server at {url} is not graspd", "stop it; or set GRASPD_PORT, or GRASPD_API_URL to the API")
    if not found.get("ok"):
        away = [part for part, state in found["parts"].items() if not state.get("ok")]
        return bad(f"the API at {url} is not ready: {', '.join(away)}", "see the checks of these parts above")
    return good(f"the API at {url} is ready")


def _query_readiness(url: str) -> dict[str, Any] | None:
    """Return the answer of an API; {} for another server, None if there is no answer."""
    own = [urllib.request.ProxyHandler({})] if "//127.0.0.1" in url else []
    opener = urllib.request.build_opener(*own)
    try:
        with opener.open(f"{url.rstrip('/')}/readyz", timeout=_HTTP_S) as answer:
            body = answer.read(65536)
    except urllib.error.HTTPError as error:
        body = error.read(65536)
    except (OSError, ValueError) as error:
        # A free port refuses the connection; a server of another protocol closes it or sends other data.
        refused = isinstance(getattr(error, "reason", error), ConnectionRefusedError | socket.gaierror | TimeoutError)
        return None if refused else {}
    except Exception:
        return {}
    try:
        found = json.loads(body)
    except ValueError:
        return {}
    return found if isinstance(found, dict) and isinstance(found.get("parts"), dict) else {}


_OFF_S: Final = 2.0
_WRONG_S: Final = 300.0
_FIX: Final = "timedatectl set-ntp true, or chronyd, on the machine whose clock differs from all others"


def check_clocks(settings: Settings) -> Finding:
    offsets = dict(_clock_offsets(settings))
    if not offsets:
        return skipped("only this machine's clock can be read")
    largest = sorted(offsets.items(), key=lambda one: -abs(one[1]))[:5]
    line = ", ".join(f"{who} {offset:+.1f} s" for who, offset in largest)
    most = max(abs(offset) for offset in offsets.values())
    if most > _WRONG_S:
        return bad(f"clocks differ from this one: {line}; S3 refuses such requests, and keys expire wrongly", _FIX)
    if most > _OFF_S:
        return warning(f"clocks differ from this one: {line}", _FIX)
    return good(f"within {_OFF_S:.0f} s: {line}")


def _clock_offsets(settings: Settings) -> Iterator[tuple[str, float]]:
    """Yield names and clock offsets to this machine [s]; other checks report missing parts."""
    if is_redis_expected(settings):
        with suppress(GraspdError, RedisError, OSError), closing(open_queue(settings, patience=0)) as queue:
            before = time.time()
            seconds, micros = queue.connection.time()
            yield "Redis", seconds + micros / 1e6 - (before + time.time()) / 2
            # An age up to the next heartbeat is normal; only the excess is a clock offset.
            due = 4 / 3 * settings.lease_s
            ages = {beat.host: time.time() - _unix_seconds(beat.seen) for beat in queue.workers()}
            yield from ((host, -age if age < 0 else min(0.0, due - age)) for host, age in ages.items())
    folder = local_store(settings)
    if folder is None or folder.exists():
        with suppress(GraspdError):
            yield "store", _store_time(settings)


def _store_time(settings: Settings) -> float:
    """Return the offset of the store's clock [s]; 0 below one second, the resolution of some stores."""
    store, key = open_store(settings.resolved_store_url), f"health/clock-{secrets.token_hex(8)}"
    before = time.time()
    try:
        store.put(key, b"1")
        after = time.time()
        made = _unix_seconds(store.stamp(key)[1])
    finally:
        store.delete(key)
    return 0.0 if before - 1.0 <= made <= after + 1.0 else made - (before + after) / 2


def _unix_seconds(when: str) -> float:
    return datetime.fromisoformat(when).timestamp()
