"""The compose file as Docker would read it, and its services as plain processes of this machine."""

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import yaml

from tests.conftest import REPOSITORY

COMPOSE: Final = REPOSITORY / "docker-compose.yml"
ENV_EXAMPLE: Final = REPOSITORY / ".env.example"
_VARIABLE: Final = re.compile(r"\$(?:\$|\{(?P<name>\w+)(?:(?P<kind>:[-?])(?P<rest>[^}]*))?\})")


def load(variables: Mapping[str, str]) -> dict[str, Any]:
    return interpolated(yaml.safe_load(COMPOSE.read_text()), variables)


def interpolated(node: Any, variables: Mapping[str, str]) -> Any:
    """A part of the file with `${NAME}`, `${NAME:-default}` and `${NAME:?message}` put in, and `$$` as `$`."""
    if isinstance(node, dict):
        return {key: interpolated(value, variables) for key, value in node.items()}
    if isinstance(node, list):
        return [interpolated(value, variables) for value in node]
    if not isinstance(node, str):
        return node

    def put(found: re.Match[str]) -> str:
        if found[0] == "$$":
            return "$"
        value = variables.get(found["name"], "")
        if value or found["kind"] is None:
            return value
        if found["kind"] == ":?":
            raise KeyError(found["rest"])
        return found["rest"]

    return _VARIABLE.sub(put, node)


def names_asked_for(text: str) -> set[str]:
    return {found["name"] for found in _VARIABLE.finditer(text) if found["name"]}


def example() -> dict[str, str]:
    return dict(re.findall(r"^(?:# )?([A-Z][A-Z0-9_]*)=(.*)$", ENV_EXAMPLE.read_text(), re.MULTILINE))


def seconds(duration: str) -> float:
    units = {"h": 3600.0, "m": 60.0, "s": 1.0}
    return sum(float(number) * units[unit] for number, unit in re.findall(r"(\d+(?:\.\d+)?)([hms])", duration))


def environment(service: Mapping[str, Any], data: Path, moved: Mapping[str, str]) -> dict[str, str]:
    kept = {name: os.environ[name] for name in ("PATH", "HOME", "WARP_CACHE_PATH") if name in os.environ}
    given = {name: str(value) for name, value in service["environment"].items()}
    for old, new in moved.items():
        given = {name: value.replace(old, new) for name, value in given.items()}
    return kept | given | {"GRASPD_DATA_DIR": str(data)}


def redis_command(service: Mapping[str, Any], server: Path, port: int, folder: Path) -> Sequence[str]:
    where = ("--bind", "127.0.0.1", "--port", str(port), "--dir", str(folder))
    return [str(server), *service["command"][1:], *where]


#: The services, with a password that stands for any.
SERVICES: Final[dict[str, Any]] = load({"REDIS_PASSWORD": "secret"})["services"]
