"""Engines of validation by name, and the module that each of them needs."""

from importlib.util import find_spec
from typing import Final

#: Engine -> module of its package, in the order of the bits in `quality/held_in`.
MODULES: Final = {"mujoco": "mujoco", "physx": "sapien", "drake": "pydrake"}
ENGINES: Final = tuple(MODULES)


def installed_engines() -> tuple[str, ...]:
    return tuple(name for name, module in MODULES.items() if find_spec(module) is not None)
