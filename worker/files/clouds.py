"""Point clouds as files, one npz for each views shard, and the hand of each grasp as points."""

import json
from collections.abc import Mapping
from itertools import groupby
from pathlib import Path
from typing import Any, Final

import numpy as np
from cachetools import LRUCache, cached
from numpy.typing import NDArray

from graspd.service.model.transforms import Floats, apply
from graspd.service.readers import Clouds
from graspd.service.readers.clouds import OF_GRASPS
from graspd.service.store.shards import Shard
from graspd.worker.files.provenance import hand_of_shard
from graspd.worker.files.subsets import require_empty_folder
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.surface import sample_surface

_WORDS = ("hand", "object", "shard_id", "base_id")  # keys of a sample that state its origin


def write_clouds(clouds: Clouds, folder: Path, said: Mapping[str, Any]) -> dict[str, int]:
    """Write `clouds-NNNNN.npz`, and `clouds.json` with `said` and the returned counts of files and clouds.
    An npz has the keys of a sample (docs/how-to/clouds.md), stacked over its C clouds. Arrays with a row per grasp are
    concatenated; `grasp/count` (C,) is the number of rows of each cloud.
    Raises ConflictError: the folder exists and is not empty."""
    require_empty_folder(folder)
    folder.mkdir(parents=True, exist_ok=True)
    done = {"files": 0, "clouds": 0, "empty": 0}
    for _, samples in groupby(clouds, key=lambda sample: sample["shard_id"]):
        together = list(samples)
        found: dict[str, Any] = {name: np.array(str(together[0][name])) for name in _WORDS}
        found["grasp/count"] = np.array([len(sample["grasp/base_row"]) for sample in together], np.int32)
        for name in together[0]:
            if name not in _WORDS:
                values = [sample[name] for sample in together]
                found[name] = np.concatenate(values) if name.startswith(OF_GRASPS) else np.stack(values)
        np.savez_compressed(folder / f"clouds-{done['files']:05}.npz", **found)
        done["files"] += 1
        done["clouds"] += len(together)
        done["empty"] += sum(sample["cloud/seen"] == 0 for sample in together)
    (folder / "clouds.json").write_text(json.dumps({**said, **done}, indent=1) + "\n")
    return done


#: Number of points on a hand: about 5 mm apart on a hand of human size.
POINTS: Final = 2048


def hand_surface(shard: Shard, rows: NDArray[np.intp]) -> Floats:
    """Return hand surface points (K, H, 3) of the grasps `rows` (K,) of a base shard, object frame [m].
    Raises NotFoundError: the hand of the shard is not available here."""
    hand = _hand(shard)
    points = sample_surface(hand, POINTS)
    pose, joints = (np.asarray(shard[f"grasp/{part}"], float)[rows] for part in ("hand_pose", "joint_positions"))
    return apply(body_poses(hand, pose, joints)[:, points.body], points.position)


@cached(LRUCache(8), key=lambda shard: shard.attributes["hand_digest"])
def _hand(shard: Shard) -> HandModel:
    return hand_of_shard(shard, None)
