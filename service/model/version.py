"""Versions that enter every content address: change one when the bytes of a result may change."""

from __future__ import annotations

from typing import Final

PACKAGE_VERSION: Final = "0.1.0"

#: Version of the task message a worker accepts; a worker refuses any other.
TASK_SCHEMA: Final = 2

#: Revision of each stage's algorithm. Part of the digest of a result, so results of two revisions never collide.
STAGE_REVISIONS: Final = {"synthesize": 12, "scene": 2, "render": 3}
