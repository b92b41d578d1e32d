"""Versions that enter every content address: change one when the bytes of a result may change."""

from __future__ import annotations

from typing import Final

PACKAGE_VERSION: Final = "0.2.0"

#: Newest schema of task messages, and the oldest that a worker of this version still reads. A message carries the range
#: that can read it, so workers of two versions may run side by side (`service/model/workers.py`).
TASK_SCHEMA: Final = 6
OLDEST_TASK_SCHEMA: Final = 2
#: The first schema whose tasks may have several batches.
SCHEMA_OF_RANGES: Final = 6
#: The first schema whose workers fetch the network that a request's options name.
SCHEMA_OF_NETWORKS: Final = 4

#: Revision of each stage's algorithm. Part of the digest of a result, so results of two revisions never collide.
STAGE_REVISIONS: Final = {"synthesize": 30, "scene": 5, "render": 6}
