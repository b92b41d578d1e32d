"""graspd in Python: grasps of a hand on an object, from this process, a service or files.

    import graspd

    grasps = graspd.synthesize("my_hand.urdf", "mug.stl", grasps=64, scene="table")
    best = grasps.valid().top("epsilon", 10)
    best.hand_pose, best.joint_positions, best.joint_names
    graspd.open("grasps.h5")
    graspd.Client("http://127.0.0.1:8000").submit("allegro", "mug", grasps=64).wait().grasps()

Modules are imported on first use. Errors of input, files, jobs and the service are `graspd.GraspdError`s.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

from graspd.service.model.libraries import pause_garbage_collection

if TYPE_CHECKING:
    from graspd.grasps import Grasp, Grasps, Postures, open
    from graspd.remote import Client, Job
    from graspd.service.model.errors import (
        BusyError,
        ConflictError,
        DamagedError,
        GraspdError,
        HandError,
        InputError,
        LimitError,
        MeshError,
        NotFoundError,
        TaskError,
        UnavailableError,
    )
    from graspd.synthesis import synthesize

    __version__: str

#: Module that defines a public name; errors and `__version__` are not listed.
_LIVES_IN: Final = {
    "synthesize": "graspd.synthesis",
    **dict.fromkeys(("open", "Grasps", "Grasp", "Postures"), "graspd.grasps"),
    **dict.fromkeys(("Client", "Job"), "graspd.remote"),
}

__all__ = ["BusyError", "Client", "ConflictError", "DamagedError", "Grasp", "GraspdError", "Grasps", "HandError"]
__all__ += ["InputError", "Job", "LimitError", "MeshError", "NotFoundError", "Postures", "TaskError"]
__all__ += ["UnavailableError", "__version__", "open", "synthesize"]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return import_module("graspd.service.model.version").PACKAGE_VERSION
    if name not in __all__:
        raise AttributeError(f"module 'graspd' has no attribute {name!r}")
    with pause_garbage_collection():
        found = getattr(import_module(_LIVES_IN.get(name, "graspd.service.model.errors")), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return __all__
