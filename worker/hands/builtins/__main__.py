"""Write the built-in hands into the source tree."""

from __future__ import annotations

from pathlib import Path

from worker.hands.builtins import write

write(Path(__file__).parents[3] / "service" / "builtin" / "hands")
