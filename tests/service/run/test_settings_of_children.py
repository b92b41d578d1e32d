"""Every setting reaches the children of `graspd up` as it was given."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from pydantic import SecretStr

from graspd.service.run.supervisor import _SETTLED, _stated
from graspd.service.settings import Settings

#: Values of each setting that its default is none of; texts hold what shells, JSON and URLs give a meaning.
_ODD = "a b\"c'd%20#e?f,ü{}"
_TEXTS = ("store_url", "store_public_endpoint", "proxy_addresses", "webhook_networks", "controller_name", "device")
_SECRETS = ("index_url", "api_key", "proxy_secret", "webhook_secret")
_PATHS = ("keys_file", "kernels", "heartbeat_file")
VALUES: dict[str, Any] = {
    **dict.fromkeys(_TEXTS, _ODD),
    **dict.fromkeys(_SECRETS, SecretStr(f"{_ODD} and at least sixteen")),
    **{name: Path(f"/srv/{_ODD}/{name}") for name in _PATHS},
    "proxy_groups": {'lab, the "first"': "vision:submit", "ü": ":admin", "*": ":read"},
    "metrics_need_key": False,
    "log_level": "DEBUG",
    "log_format": "json",
    "prefilter": "off",
    "join": "4",
    "worker_number": 0,
    "api_root_path": "/graspd",
    "lease_s": 4 / 3,
    "quota_jobs_per_day": 7,
}


def value_of(name: str) -> Any:
    if name in VALUES:
        return VALUES[name]
    default = Settings.model_fields[name].default
    assert isinstance(default, int | float), f"the test has no value for {name}"
    return default + 1


@pytest.mark.parametrize("name", sorted(Settings.model_fields.keys() - _SETTLED))
def test_a_setting_reaches_the_children(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    given = Settings(**{name: value_of(name)})
    for variable, text in _stated(given).items():
        monkeypatch.setenv(variable, text)
    assert getattr(Settings(), name) == getattr(given, name)


@pytest.mark.parametrize(
    "name", [name for name, field in Settings.model_fields.items() if field.default is None and name not in _SETTLED]
)
def test_a_setting_taken_back_does_not_come_from_the_environment(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    value = value_of(name)
    monkeypatch.setenv(
        f"GRASPD_{name.upper()}", value.get_secret_value() if isinstance(value, SecretStr) else str(value)
    )
    for variable, text in _stated(Settings(**{name: None})).items():
        monkeypatch.setenv(variable, text)
    assert getattr(Settings(), name) is None
