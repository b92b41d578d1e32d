"""Package, message and stage versions; increase a stage's if its results may change."""

from __future__ import annotations

from typing import Final

PACKAGE_VERSION: Final = "0.2.0"

#: Newest schema of task messages, and the oldest readable one. A message states its range of schemas, so workers of
#: two versions may run in parallel (`service/model/messages.py`).
TASK_SCHEMA: Final = 7
OLDEST_TASK_SCHEMA: Final = 2
#: First schema with tasks of several batches.
SCHEMA_OF_RANGES: Final = 6
#: First schema whose workers fetch the network of a request's options.
SCHEMA_OF_NETWORKS: Final = 4

#: Revision of each stage's algorithm. Digests of results contain it, so results of two revisions never collide.
STAGE_REVISIONS: Final = {"synthesize": 33, "scene": 5, "render": 6}
