"""Registered methods: graspd's own, and `graspd.planners` entry points of installed packages."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from pydantic import ValidationError

from graspd.service.model.base import first_error
from graspd.service.model.errors import InputError, available_names
from graspd.service.model.libraries import pause_garbage_collection
from graspd.worker.planners.port import BatchPlanner, Method, Options, Planner

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

#: Entry-point group of planners of other packages.
GROUP: Final = "graspd.planners"

#: Method name -> module and attribute of its `Method`. Modules are imported when used.
PLANNERS: Final[dict[str, tuple[str, str]]] = {
    "fast_graspd": ("graspd.worker.planners.fast_graspd.planner", "METHOD"),
    "graspit": ("graspd.baselines.graspit.method", "METHOD"),
    "graspd2022": ("graspd.baselines.graspd2022.method", "METHOD"),
    "dfc": ("graspd.baselines.dfc.method", "METHOD"),
    "learned": ("graspd.baselines.learned.method", "METHOD"),
    "autograsp": ("graspd.baselines.autograsp.method", "METHOD"),
}


def method_names() -> list[str]:
    return [*PLANNERS, *sorted(set(_entry_points()) - set(PLANNERS))]


def method(name: str) -> Method:
    """Return the method of a name; other packages cannot replace graspd's own names.
    Raises InputError: unknown method, or a package's entry point that cannot be loaded or is no `Method`."""
    if name in PLANNERS:
        module, attribute = PLANNERS[name]
        with pause_garbage_collection():
            own: Method = getattr(import_module(module), attribute)
        return own
    offered = _entry_points()
    if name not in offered:
        raise InputError(f"unknown method {name!r}{available_names(name, method_names())}")
    try:
        found = offered[name].load()
    except Exception as error:
        raise InputError(f"method {name!r} cannot be loaded from {offered[name].value}: {error}") from error
    if not isinstance(found, Method):
        raise InputError(f"method {name!r}: {offered[name].value} is no graspd.worker.planners.Method")
    return found


def planner(name: str, options: Mapping[str, Any] | None = None, *, in_scenes: bool = False) -> Planner:
    """Return the planner of a method with its options; strings are parsed as the option's type.
    Raises InputError: unknown method, unknown option, value out of range, or a method that `in_scenes` excludes."""
    known = method(name)
    if in_scenes and not known.in_scenes:
        able = ", ".join(one for one in method_names() if method(one).in_scenes)
        raise InputError(f"method {name} plans around free objects only; in scenes choose {able}, or scene free")
    if not in_scenes and not known.free:
        raise InputError(f"method {name} plans in scenes only; give a scene with a table, or choose fast_graspd")
    return known.planner(_options(name, options))


def batch_planner(name: str, options: Mapping[str, Any] | None = None) -> BatchPlanner | None:
    """Return a method's planner of several batches in one launch; None if it plans them one by one."""
    make = method(name).joined
    return make(_options(name, options)) if make is not None else None


def _options(name: str, options: Mapping[str, Any] | None) -> Options:
    known = method(name)
    try:
        return known.options(**(options or {}))
    except ValidationError as error:
        there_are = ", ".join(known.options.model_fields) or "none"
        raise InputError(f"option of {name}: {first_error(error)}; its options: {there_are}") from None


def local_options(name: str, options: Mapping[str, Any] | None) -> dict[str, Any]:
    """Replace files in a local user's options by digests, and cache the files in this process.
    Raises InputError: unknown method, or a file that cannot be used."""
    files, given = method(name).files, dict(options or {})
    return given | {key: files[key](Path(str(value))) for key, value in given.items() if key in files}


def _entry_points() -> dict[str, EntryPoint]:
    from importlib.metadata import entry_points

    return {point.name: point for point in entry_points(group=GROUP)}
