"""Keys of caches: equal for equal models, different for whatever differs in what a model holds."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh

from graspd.worker.hands.surface import sample_surface
from graspd.worker.objects.disk_cache import content_of
from graspd.worker.quality.probe import probe_of
from graspd.worker.rendering.scene_setup import CameraPlan, Setting
from graspd.worker.scenes.simulate import rest_probability
from tests.worker.models import object_from_mesh, two_finger_hand

BOX = object_from_mesh(trimesh.creation.box((0.06, 0.04, 0.05)))
HAND = two_finger_hand()


def test_a_name_and_the_digest_of_the_files_say_nothing_of_the_content() -> None:
    assert dataclasses.replace(BOX, name="other", digest="other").content == BOX.content
    assert two_finger_hand().content == HAND.content


@pytest.mark.parametrize("field", [f.name for f in dataclasses.fields(BOX) if f.name not in ("name", "digest")])
def test_whatever_differs_in_an_object_changes_its_content(field: str) -> None:
    assert dataclasses.replace(BOX, **{field: np.array([7])}).content != BOX.content


@pytest.mark.parametrize("field", [f.name for f in dataclasses.fields(HAND) if f.name not in ("name", "digest")])
def test_whatever_differs_in_a_hand_changes_its_content(field: str) -> None:
    assert dataclasses.replace(HAND, **{field: np.array([7])}).content != HAND.content


def test_arrays_of_equal_bytes_and_other_shapes_differ() -> None:
    flat = dataclasses.replace(BOX, vertices=BOX.vertices.ravel())
    assert flat.content != BOX.content


def test_a_field_that_cannot_be_told_is_refused() -> None:
    with pytest.raises(TypeError, match="object"):
        content_of(dataclasses.replace(BOX, repairs=object()))  # type: ignore[arg-type]


def test_no_cache_gives_one_mesh_of_a_file_for_another() -> None:
    # As many corners and faces, the same digest of the file: only what was prepared differs.
    other = dataclasses.replace(object_from_mesh(trimesh.creation.box((0.02, 0.04, 0.05))), digest=BOX.digest)
    one, two = (probe_of(HAND, obj, hand_points=64, object_points=64) for obj in (BOX, other))
    assert not np.array_equal(one.samples, two.samples)
    plan, pose = CameraPlan(1, 16, 16, None), np.array([[[0.0, 0, 0, 1, 0, 0, 0]]])
    first, second = (Setting([obj], pose, plan, seed=0, samples=1) for obj in (BOX, other))
    assert first._key() != second._key()


def test_no_cache_gives_one_tree_of_a_file_for_another() -> None:
    # The fingers stand elsewhere on the same palm: the same pieces bury other points.
    origin = HAND.origin.copy()
    origin[1:, 2] = -0.06
    other = dataclasses.replace(HAND, origin=origin)
    assert not np.array_equal(sample_surface(HAND, 200).position, sample_surface(other, 200).position)


def test_a_cache_serves_an_equal_model_that_was_loaded_again() -> None:
    again = dataclasses.replace(BOX)
    first = probe_of(HAND, BOX, hand_points=64, object_points=64)
    assert probe_of(two_finger_hand(), again, hand_points=64, object_points=64) is first


def test_chances_of_rest_are_those_of_the_hull_not_of_the_file() -> None:
    # A tall plate and a cube of one volume and digest, and as many corners.
    cube, plate = (
        dataclasses.replace(object_from_mesh(trimesh.creation.box(size)), digest=BOX.digest, volume=BOX.volume)
        for size in ((0.05, 0.05, 0.05), (0.1, 0.1, 0.0125))
    )
    shares = [rest_probability(obj, [0]) for obj in (cube, plate)]
    assert shares == [rest_probability(dataclasses.replace(obj, digest="fresh"), [0]) for obj in (cube, plate)]
    assert shares[0] != shares[1]
