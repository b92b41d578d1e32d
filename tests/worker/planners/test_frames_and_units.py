"""Requirements on an object whose mesh is in millimetres, far from the origin of its file."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from graspd.service.model.contact_region import parse_pose
from graspd.service.model.local_options import LocalOptions
from graspd.service.model.options import validate
from graspd.service.model.transforms import quat_rotate
from graspd.service.store.shards import read_shard, write_shard
from graspd.worker.files.synthesis import SynthesisResult, synthesize_with_options, wrist_pose
from graspd.worker.files.transfer import transfer_grasps
from graspd.worker.hands.load import hand_from_path
from graspd.worker.planners.requirements import LEAST_SHARE, LIKE_M

FAR = np.array([10.0, -10.0, 10.0])
UNITS = {"units": "mm"}


@pytest.fixture(scope="module")
def bar(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A bar 4 cm wide and 12 cm high, of two parts."""
    lines, count = [], 0
    for name, low in (("low", 0.0), ("high", 0.06)):
        box = trimesh.creation.box(bounds=[[-0.02, -0.02, low], [0.02, 0.02, low + 0.06]])
        lines += [f"o {name}", *("v {:.6f} {:.6f} {:.6f}".format(*place) for place in 1e3 * (box.vertices + FAR))]
        lines += ["f {} {} {}".format(*face) for face in box.faces + 1 + count]
        count += len(box.vertices)
    path = tmp_path_factory.mktemp("far") / "bar.obj"
    path.write_text("\n".join(lines))
    return str(path)


def synth(bar: str, **options) -> SynthesisResult:
    common = {"fidelity": "draft", "device": "cpu", "seed": 3, "grasps": 2}
    return synthesize_with_options("allegro", bar, validate(LocalOptions, common | UNITS | options), processes=1)


@pytest.mark.parametrize("region", ["z > 10.06", "part high"])
@pytest.mark.parametrize("scene", [{}, {"scene": "table", "scenes": 1}])
def test_contacts_are_in_the_region(bar: str, region: str, scene: dict) -> None:
    made = synth(bar, touch_region=region, **scene).arrays
    assert len(made["quality/valid"]) and (made["quality/region_share"] >= LEAST_SHARE).all()
    # Without the shift of the bounds, or with millimetres, the region would be empty and the job refused.
    assert (np.abs(made["grasp/hand_pose"][:, :3] - FAR) < 0.3).all()


def test_cone_pose_and_transfer(bar: str, tmp_path: Path) -> None:
    made = synth(bar, approach_cone="0, 0, -1, 30")
    approach = quat_rotate(made.arrays["grasp/hand_pose"][:, 3:], hand_from_path("allegro").palm.approach)
    assert (-approach[:, 2] >= np.cos(np.deg2rad(30)) - 1e-6).all()
    file = tmp_path / "demo.h5"
    file.write_bytes(write_shard("base", made.arrays, made.attributes | {"shard_id": "0" * 32}))
    pose = parse_pose(wrist_pose(str(file), "allegro", bar, UNITS))
    # Seven digits of a place 10 m away.
    assert np.allclose(pose, made.arrays["grasp/hand_pose"][0], atol=5e-6)
    assert (synth(bar, like=str(file)).arrays["quality/like_distance_m"] <= LIKE_M).all()
    arrays, _ = transfer_grasps(read_shard(file, kind="base"), "barrett")
    assert len(arrays["quality/valid"]) and (np.abs(arrays["grasp/hand_pose"][:, :3] - FAR) < 0.3).all()
