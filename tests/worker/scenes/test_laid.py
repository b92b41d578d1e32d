"""Neighbours laid between walls, on a shelf, or beside an object on each of its faces."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from graspd.service.model.errors import SceneError
from graspd.service.model.scene_spec import SceneSpec
from graspd.service.model.transforms import quat_rotate
from graspd.worker.scenes.kinds import GAP, room_in
from graspd.worker.scenes.neighbours import BETWEEN
from graspd.worker.scenes.placement import gaps_between, neighbour_of, scenes_of
from tests.worker.models import object_from_mesh


def box(*size: float, name: str = "box"):
    return object_from_mesh(trimesh.creation.box(size), name)


THING, LOW, TALL = box(0.05, 0.05, 0.05), box(0.08, 0.06, 0.03, name="low"), box(0.03, 0.04, 0.12, name="tall")


def laid(kind: str, others, *, count: int, faces: str = "drawn", thing=THING):
    spec = SceneSpec(kind=kind, faces=faces, neighbours=tuple({"object": one.name} for one in others))
    return spec, *scenes_of(spec, thing, others, count=count, seed=5)


def corners(obj, poses: np.ndarray) -> np.ndarray:
    return np.stack([quat_rotate(pose[3:], obj.hull_vertices) + pose[:3] for pose in poses])


@pytest.mark.parametrize("kind", ["bin", "shelf"])
def test_neighbours_stand_within_the_walls_apart_and_on_the_floor(kind: str) -> None:
    others = [LOW, TALL, LOW]
    spec, scenes, poses = laid(kind, others, count=4)
    room = np.asarray(room_in(spec)) / 2 - GAP
    together = np.concatenate([poses["scene/object_pose"][:, None], poses["scene/neighbour_pose"]], axis=1)
    for number, one in enumerate([THING, *others]):
        found = corners(one, together[:, number])
        assert (np.abs(found[..., :2]) <= room + 1e-9).all()
        np.testing.assert_allclose(found[..., 2].min(axis=1), 0.0, atol=1e-9)
        # The supports' own planes, the boards above and below among them.
        for support in scenes.supports:
            assert min(support.distance(one_scene).min() for one_scene in found) > -1e-9
    gaps = gaps_between([neighbour_of(one) for one in (THING, *others)], together)
    assert min(gap.min() for gap in gaps.values()) >= BETWEEN - 1e-6  # MuJoCo's meshes are float32
    assert len(scenes.placed(np.zeros(1, int)).scenes[0].obstacles) == len(scenes.supports) + len(others)
    assert not np.allclose(poses["scene/neighbour_pose"][:, 0], poses["scene/neighbour_pose"][:, 2]), "two lie apart"


def test_more_scenes_keep_the_first_ones_and_the_object_lies_where_it_lies_alone() -> None:
    _, _, few = laid("bin", [LOW], count=2)
    _, _, more = laid("bin", [LOW], count=3)
    np.testing.assert_array_equal(more["scene/neighbour_pose"][:2], few["scene/neighbour_pose"])
    _, _, alone = laid("bin", [], count=2)
    np.testing.assert_array_equal(few["scene/object_pose"], alone["scene/object_pose"])


def test_on_a_table_each_face_has_its_neighbours() -> None:
    thing = box(0.04, 0.06, 0.09)
    _, _, poses = laid("table", [LOW, TALL], count=1, faces="all", thing=thing)
    ups = [quat_rotate(pose[3:] * [1, -1, -1, -1], np.array([0, 0, 1.0])) for pose in poses["scene/object_pose"]]
    assert len(np.unique(np.round(ups, 6), axis=0)) == len(ups) >= 4
    assert poses["scene/neighbour_pose"].shape == (len(ups), 2, 7)


def test_as_many_as_a_scene_may_have_find_room_around_one_like_them() -> None:
    """Dropped together their bounding balls would never fit on one ring."""
    _, _, poses = laid("table", [THING] * 8, count=1)
    together = np.concatenate([poses["scene/object_pose"][:, None], poses["scene/neighbour_pose"]], axis=1)
    gaps = gaps_between([neighbour_of(THING)] * 9, together)
    assert min(gap.min() for gap in gaps.values()) > 0


def test_a_bin_without_room_says_so_in_a_line() -> None:
    with pytest.raises(SceneError, match=r"no room for 2 neighbours beside box in scene 0: .* wider scene") as told:
        laid("bin", [box(0.3, 0.2, 0.05, name="tray")] * 2, count=1)
    assert "\n" not in str(told.value)
