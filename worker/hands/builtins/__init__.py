"""The built-in hands, written from published kinematic facts as URDFs of primitives.

``python -m worker.hands.builtins`` writes them into `service/builtin/hands/`. Frames and numbers follow the makers'
data: Wonik Allegro Hand (right), Barrett BH8-280, Shadow Dexterous Hand E (right, without forearm and wrist).
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from worker.hands.builtins.allegro import allegro
from worker.hands.builtins.barrett import barrett
from worker.hands.builtins.shadow import shadow

HANDS: Final[dict[str, Callable[[], tuple[str, dict[str, Any]]]]] = {
    "allegro": allegro,
    "barrett": barrett,
    "shadow": shadow,
}


def files_of(name: str) -> dict[str, bytes]:
    """The files of a built-in hand as they stand in `service/builtin/hands/NAME/`."""
    urdf, options = HANDS[name]()
    asset = {"file": f"{name}.urdf", **options}
    return {f"{name}.urdf": urdf.encode(), "asset.json": (json.dumps(asset, indent=2) + "\n").encode()}


def write(root: Path) -> None:
    """Write every built-in hand below `root`."""
    for name in HANDS:
        (root / name).mkdir(parents=True, exist_ok=True)
        for filename, data in files_of(name).items():
            (root / name / filename).write_bytes(data)
