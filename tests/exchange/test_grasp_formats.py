"""Grasps through the formats of others and back; files that would run code, or are nested deep, are refused."""

import os
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from graspd.client.dataset_commands import read_spec
from graspd.commands.exchange import read_sets
from graspd.commands.studies import _read_maps as read_stability
from graspd.exchange import dexgraspbench, published
from graspd.exchange.bench_hand import _read as read_mapping
from graspd.exchange.bench_scene import save_record
from graspd.exchange.imported import Origin, joints_by_name, load_npy, scaled_object, verdicts
from graspd.exchange.published import friction
from graspd.exchange.scoring import write_scored
from graspd.service.model.errors import InputError
from graspd.service.model.transforms import compose, quat_to_matrix
from graspd.service.readers.trajectories import scene_spec_of
from graspd.service.store.shards import Shard, read_shard
from graspd.studies.cards.contents import Contents, with_provenance
from graspd.worker.files.provenance import options_of
from graspd.worker.hands.load import hand_from_path

TINY = 1e-9  # positions and quaternions are only re-ordered, not computed with
DEEP = "[" * 100_000 + "]" * 100_000


class Bomb:
    def __reduce__(self):
        return os.mkdir, ("bomb-went-off",)


def test_a_file_that_would_run_code_is_refused_and_does_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    np.save("bomb.npy", np.array([Bomb()], dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match="cannot be read safely"):
        load_npy(Path("bomb.npy"))
    assert not Path("bomb-went-off").exists()
    for content in (b"", b"\x93NUMPY", b"no array at all"):
        Path("x.npy").write_bytes(content)
        with pytest.raises(InputError, match=r"x\.npy"):
            load_npy(Path("x.npy"))


def test_a_grasp_of_dexgraspbench_moves_with_its_object(hand, block, grasps, tmp_path) -> None:
    (path, *_) = dexgraspbench.write(hand, block, grasps, [0], tmp_path)
    row = load_npy(path)
    moved = np.array([0.3, -0.2, 0.7, *Rotation.from_euler("xyz", [0.3, 1.1, -2.0]).as_quat(scalar_first=True)])
    for name in dexgraspbench.POSTURES:
        row[f"{name}_qpos"][:7] = compose(moved, row[f"{name}_qpos"][:7])
    save_record(path, row | {"obj_pose": moved})
    (back,) = dexgraspbench.read(path, hand="barrett", obj="block")
    place, turn = back.grasps.grasp.hand_pose[0, :3], quat_to_matrix(back.grasps.grasp.hand_pose[0, 3:])
    np.testing.assert_allclose(place, grasps.grasp.hand_pose[0, :3], atol=TINY)
    np.testing.assert_allclose(turn, quat_to_matrix(grasps.grasp.hand_pose[0, 3:]), atol=TINY)


def test_dexgraspbench_scales_are_sets_and_another_hand_is_told(hand, block, grasps, tmp_path) -> None:
    paths = dexgraspbench.write(hand, block, grasps, range(2), tmp_path)
    save_record(paths[0], load_npy(paths[0]) | {"obj_scale": 0.5})
    sets = dexgraspbench.read(tmp_path, hand="barrett", obj="block")
    assert [one.scale for one in sets] == [0.5, 1.0]
    assert np.ptp(sets[0].obj.vertices, axis=0) == pytest.approx(np.ptp(block.vertices, axis=0) / 2, rel=1e-6)
    dexgraspbench.write(hand, block, grasps, [0], tmp_path)
    with pytest.raises(InputError, match="check --hand"):
        dexgraspbench.read(tmp_path, hand="allegro", obj="block")


def test_dexgraspnets_angles_turn_about_the_fixed_axes(tmp_path: Path) -> None:
    angles = np.array([0.4, -1.2, 2.2])
    qpos = dict(zip(("WRJRx", "WRJRy", "WRJRz"), angles, strict=True)) | {"WRJTx": 0.1, "WRJTy": 0.2, "WRJTz": -0.3}
    path = _dexgraspnet(tmp_path, qpos | {"robot0:FFJ2": 0.5}, scale=1.0)
    (found,) = read_sets("dexgraspnet", path, "shadow", "block", {})
    expected = Rotation.from_euler("xyz", angles).as_matrix()  # SciPy's lower-case letters are fixed axes too
    np.testing.assert_allclose(quat_to_matrix(found.grasps.grasp.hand_pose[0, 3:]), expected, atol=TINY)
    np.testing.assert_allclose(found.grasps.grasp.hand_pose[0, :3], [0.1, 0.2, -0.3])


def test_dexgraspnets_joints_are_one_number_more_its_scale_meshs(tmp_path: Path, block) -> None:
    qpos = dict.fromkeys(("WRJTx", "WRJTy", "WRJTz", "WRJRx", "WRJRy", "WRJRz"), 0.0)
    path = _dexgraspnet(tmp_path, qpos | {"robot0:THJ4": 0.37}, 1.0)
    (found,) = published.read_dexgraspnet(path, hand="shadow", obj="block")
    at = next(k for k, name in enumerate(found.hand.joint_names) if name.endswith("THJ5"))
    assert found.grasps.grasp.joint_positions[0, at] == 0.37
    (found,) = published.read_dexgraspnet(_dexgraspnet(tmp_path, qpos, 1.5), hand="shadow", obj="block")
    assert np.ptp(found.obj.vertices, axis=0) == pytest.approx(1.5 * np.ptp(block.vertices, axis=0), rel=1e-6)


def _dexgraspnet(folder: Path, qpos: dict[str, float], scale: float) -> Path:
    path = folder / "core-block.npy"
    np.save(path, np.array([{"qpos": qpos, "scale": scale}], dtype=object), allow_pickle=True)
    return path


def test_columns_and_rotating_axes_are_scipys_rotations() -> None:
    rotations = Rotation.random(20, rng=np.random.default_rng(1))
    matrices, angles = rotations.as_matrix(), rotations.as_euler("XYZ")  # capital letters are rotating axes
    columns = np.concatenate([matrices[:, :, 0], matrices[:, :, 1]], axis=1)
    for found in (published.rotation_of_columns(columns), published.rotation_of_angles(angles)):
        np.testing.assert_allclose(quat_to_matrix(found), matrices, atol=1e-12)


def test_multidex_gives_the_grasps_of_one_robot_on_one_object(hand, tmp_path: Path) -> None:
    torch = pytest.importorskip("torch", reason="torch is not installed; `pip install torch` runs this test")
    joints = len(hand.joint_names)
    q = torch.cat([torch.tensor([0.1, 0.2, 0.3, 1.0, 0, 0, 0, 1, 0]), torch.full((joints,), 0.4)])
    rows = [(q, "ycb+block", "barrett"), (q + 1, "ycb+cup", "barrett"), (q, "ycb+block", "allegro")]
    torch.save({"info": {}, "metadata": rows}, tmp_path / "cmap_dataset.pt")
    options = {"robot": "barrett", "object_name": "ycb+block"}
    (found,) = read_sets("multidex", tmp_path / "cmap_dataset.pt", "barrett", "block", options)
    np.testing.assert_allclose(found.grasps.grasp.hand_pose, [[0.1, 0.2, 0.3, 1, 0, 0, 0]], atol=1e-6)  # float32
    np.testing.assert_allclose(found.grasps.grasp.joint_positions, 0.4, atol=1e-6)


def test_ddgcs_quaternion_and_joints_are_put_in_our_order(hand, tmp_path: Path) -> None:
    place = np.array([[0.1, 0.2, 0.3, 0.0, 0.0, np.sin(0.5), np.cos(0.5)]])
    angles = np.array([[0.1, 0.2, 0.3, 0.1, 0.5, 0.6, 0.7, 0.8]])
    for name, values in (("translation", place), ("representation", angles)):
        rows = np.empty(2, dtype=object)
        rows[:] = [[], values.tolist()]
        np.save(tmp_path / f"barrett_{name}_3.npy", rows, allow_pickle=True)
    (found,) = read_sets("ddgc", tmp_path / "barrett_translation_3.npy", "barrett", "block", {"number": 1})
    np.testing.assert_allclose(found.grasps.grasp.hand_pose[0, 3:], [np.cos(0.5), 0, 0, np.sin(0.5)], atol=TINY)
    joints = dict(zip(hand.joint_names, found.grasps.grasp.joint_positions[0], strict=True))
    assert abs(joints["finger_3_medial"]) == pytest.approx(0.7)
    assert abs(joints["finger_2_distal"]) == pytest.approx(0.6)


def test_imported_grasps_are_scored_and_say_where_they_come_from(hand, block, grasps, tmp_path) -> None:
    dexgraspbench.write(hand, block, grasps, range(len(grasps)), tmp_path / "bench")
    (found,) = dexgraspbench.read(tmp_path / "bench", hand="barrett", obj="block")
    origin = Origin("dexgraspbench", "a test", "CC0-1.0")
    path = write_scored(found, origin, tmp_path / "out", validation="fast", friction=1)
    shard = read_shard(path, kind="base")
    assert (shard.attributes["source"], shard.attributes["licence"]) == ("a test", "CC0-1.0")
    assert len(shard["quality/epsilon"]) == len(grasps) and set(np.unique(shard["quality/success"])) <= {0, 1}


def test_published_reference_grasps_come_in_by_name(shared_data: Path) -> None:
    path = shared_data / "reference_grasps" / "frogger_allegro" / "061_foam_brick.json"
    (found,) = read_sets("reference", path, None, None, {})
    assert (len(found.grasps), found.name) == (28, "061_foam_brick")
    assert found.published.mean() == pytest.approx(0.64, abs=0.005)  # the rate that DATA.md states


def test_a_missing_joint_is_told_and_two_scales_are_two_objects() -> None:
    with pytest.raises(InputError, match="has no joint 'elbow'"):
        joints_by_name(hand_from_path("barrett"), ["elbow"], [[0.0]], what="x")
    assert verdicts([1, 0, True, None, "yes", 300, float("nan")]).tolist() == [1, 0, 1, -1, -1, -1, -1]
    # What is kept of a pair between calls is found by digest.
    assert len({scaled_object("block", scale).digest for scale in (1.0, 0.5, 2.0)}) == 3


#: Files of the block's grasps, and how they are rounded: by text of 12 digits, matrices, float32 [m, rad].
@pytest.mark.parametrize(
    ("name", "files", "rounding"),
    [
        ("dexgraspnet2", "data/dex_grasps_new/*/*/block.npz", 1e-9),
        ("dexlearn", "assets/grasp/graspd_tabletop_graspd_barrett/succ_collect/*/block", 1e-8),
        ("graspgen", "grasps/barrett", 1e-9),
        ("huggingface", "", 1e-9),
        ("lerobot", "", 1e-6),
    ],
)
def test_grasps_of_a_training_format_come_back(name: str, files: str, rounding: float, exported, stored: Shard) -> None:
    if name in ("huggingface", "lerobot"):
        pytest.importorskip("pyarrow")
    options, found = {"robot": "", "object_name": "block", "number": 0}, []
    for file in sorted(exported(name).glob(files)) if files else [exported(name)]:
        for back in read_sets(name, file, "barrett", "block", options):
            assert back.published is not None and (back.placed is None) == (name in ("dexgraspnet2", "graspgen"))
            for k, pose in enumerate(back.grasps.grasp.hand_pose):
                (row,) = np.flatnonzero(np.abs(stored["grasp/hand_pose"][:, :3] - pose[:3]).max(axis=1) < rounding)
                found.append(int(row))
                assert back.published[k] == stored["quality/valid"][row]
                for what in dexgraspbench.POSTURES:
                    given, ours = getattr(back.grasps, what), stored[f"{what}/hand_pose"][row]
                    np.testing.assert_allclose(given.hand_pose[k, :3], ours[:3], atol=rounding)
                    assert abs(given.hand_pose[k, 3:] @ ours[3:]) == pytest.approx(1, abs=1e-6)
                    joints = stored[f"{what}/joint_positions"][row]
                    np.testing.assert_allclose(given.joint_positions[k], joints, atol=rounding)
                if back.placed is not None:
                    rest = stored["scene/object_pose"][stored["grasp/scene_index"][row]]
                    there = back.placed.object_pose[back.placed.index[k]]
                    np.testing.assert_allclose(there, rest, atol=rounding)
    assert sorted(found) == np.flatnonzero(stored["quality/valid"]).tolist()


@pytest.mark.parametrize(
    ("name", "hand", "says"),
    [
        ("foo", "h", "no import format"),
        ("multidex", "h", "--robot and --name"),
        ("ddgc", None, "give --hand and --object"),
    ],
)
def test_what_no_import_can_read_is_told(name: str, hand: str | None, says: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=says):
        read_sets(name, tmp_path, hand, "o", {"robot": "", "object_name": "", "number": 0})


@pytest.mark.parametrize(
    ("name", "reader"),
    [
        ("spec.json", read_spec),
        ("spec.toml", read_spec),
        ("reference.json", friction),
        ("hand_mapping.json", read_mapping),
        ("stability.json", read_stability),
        ("provenance.json", lambda path: with_provenance(Contents.__new__(Contents), path)),
    ],
)
def test_a_file_that_is_nested_deep_is_refused_in_one_line(name: str, reader, tmp_path) -> None:
    file = tmp_path / name
    file.write_text(f"hands = {DEEP}" if name.endswith("toml") else f'{{"hands": {DEEP}}}')
    with pytest.raises(InputError, match=name) as refused:
        reader(file)
    assert "\n" not in str(refused.value)


def test_an_attribute_that_is_nested_deep_says_nothing() -> None:
    assert options_of(DEEP) == {}
    shard = Shard("base", {"scene": DEEP}, {})
    with pytest.raises(InputError, match="is not a valid scene"):
        scene_spec_of(shard)
