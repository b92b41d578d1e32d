"""Versions of the package, of task messages and of stages."""

from typing import Final

PACKAGE_VERSION: Final = "0.2.0"

#: Newest and oldest readable schema of task messages (`service/model/messages.py`).
TASK_SCHEMA: Final = 9
OLDEST_TASK_SCHEMA: Final = 2
#: First schema with tasks of several batches.
SCHEMA_OF_RANGES: Final = 6
#: First schema whose workers fetch the network of a request's options.
SCHEMA_OF_NETWORKS: Final = 4
#: First schema with engines besides MuJoCo.
SCHEMA_OF_ENGINES: Final = 8
#: First schema with episodes.
SCHEMA_OF_EPISODES: Final = 9

#: Revision of each stage's algorithm, part of the digests of results. Increase it if the results may change.
STAGE_REVISIONS: Final = {"synthesize": 34, "scene": 5, "render": 6, "episode": 1}
