"""Grasp synthesis in this process."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Final, Unpack

from graspd.grasps import Grasps
from graspd.service.model.errors import InputError
from graspd.service.model.local_options import LocalOptions
from graspd.service.model.options import option_rows, validate, with_keywords

if TYPE_CHECKING:
    from graspd.keywords import SynthesizeKeywords

_KEYWORDS: Final = {flag: row.name for row in option_rows(LocalOptions, "python") for flag in row.flags}
_FLAG: Final = re.compile(r"--[a-z]+(?:-[a-z]+)*")


@with_keywords(LocalOptions, "python")
def synthesize(
    hand: str | Path,
    object: str | Path,
    *,
    progress: Callable[[float], None] | None = None,
    **options: Unpack[SynthesizeKeywords],
) -> Grasps:
    """Plan, validate and measure grasps of a hand on an object, as `graspd synth` does.

    The same seed gives the same grasps. The first call of a process compiles or loads kernels.

    Args:
        hand: a URDF, a ZIP with one, or the name of a built-in hand.
        object: a mesh (STL, OBJ, PLY, GLB, OFF) or the name of a built-in object.
        progress: called with the finished share, 0 to 1.
        options: docs/reference/options.md lists them, with units, bounds and defaults. `grasps` is the number of
            grasps wanted; there are fewer if the budget ends first.

    Returns:
        Grasps: at most `grasps`; poses in the object frame [m], joints [rad or m]. `reason` explains a shortfall.

    Raises:
        InputError: an argument is invalid (MeshError, HandError: a file); the message contains the fix.
        ImportError: the engine is not installed (`graspd[worker]`).
    """
    try:
        inspect.signature(synthesize).bind(hand, object, **options)
    except TypeError as error:
        raise TypeError(f"synthesize() {error}") from None
    try:
        from graspd.worker.files.synthesis import synthesize_with_options
    except ModuleNotFoundError as error:
        raise ImportError(f"synthesize needs {error.name}; run pip install 'graspd[worker]'") from error
    # None means that the option was not given.
    asked = validate(LocalOptions, {name: value for name, value in options.items() if value is not None})
    on_progress = (lambda done, total, _message: progress(done / total)) if progress else None
    try:
        made = synthesize_with_options(str(hand), str(object), asked, progress=on_progress)
    except InputError as error:
        # The engine's messages spell options as on the command line.
        error.args = (_FLAG.sub(lambda flag: _KEYWORDS.get(flag[0], flag[0]), str(error)),)
        raise
    return Grasps(made.arrays, made.attributes)
