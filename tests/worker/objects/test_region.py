"""Regions of an object by half-spaces, named parts and colours: surface points, labels, voxels, and planned grasps."""

import io
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh

from graspd.service.model.contact_region import RegionSpec, parse_region
from graspd.service.model.digests import digest_files
from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import InputError
from graspd.service.model.states import AssetKind
from graspd.service.store.library import publish_asset
from graspd.service.store.store import open_store
from graspd.worker.generation import validated_grasps
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects import prepare, repair
from graspd.worker.objects.check import check_object
from graspd.worker.objects.formats import read_mesh
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.parts import CELL_M
from graspd.worker.objects.prepare import from_bytes, load_object, to_bytes
from graspd.worker.objects.region import WHOLE, ContactRegion
from graspd.worker.planners.fitting import FEWEST, SAMPLES, even_points, region_points
from graspd.worker.planners.requirements import LEAST_SHARE, Requirements
from graspd.worker.quality.table import measure
from graspd.worker.stages.assets import object_of
from tests.fakes import message_for
from tests.worker.models import object_from_mesh
from tests.worker.objects.shapes import box, stl

SIZE = np.array([0.06, 0.04, 0.1])
BOX = object_from_mesh(trimesh.creation.box(SIZE))


def region(touch: str = "", avoid: str = "") -> ContactRegion:
    return ContactRegion(*(np.array(parse_region(text).planes) if text else None for text in (touch, avoid)))


def test_a_region_is_where_all_bounds_hold_except_where_all_to_avoid_do() -> None:
    points = np.random.default_rng(0).uniform(-0.05, 0.05, (7, 60, 3))
    x, _, z = np.moveaxis(points, -1, 0)
    for touch, avoid, expected in (
        ("z > 0.01, x < 0.02", "", (z > 0.01) & (x < 0.02)),
        ("", "z > 0.01, x < 0.02", ~((z > 0.01) & (x < 0.02))),
        ("z > 0", "x > 0", (z > 0) & (x <= 0)),
    ):
        np.testing.assert_array_equal(region(touch, avoid).contains(points), expected)
    assert WHOLE.is_whole and region().is_whole and not region(avoid="z > 9").is_whole


@pytest.mark.parametrize(("touch", "avoid", "inside"), [("z < 0.05", "", True), ("", "z < 0.05", False)])
def test_a_point_on_the_bound_of_a_face_is_inside_its_half_space(touch: str, avoid: str, inside: bool) -> None:
    top = np.array([[0.0, 0, 0.05], [0.03, 0.02, 0.05], [0, 0, np.nextafter(0.05, 1)]])
    assert region(touch, avoid).contains(top).tolist() == [inside, inside, not inside]


@pytest.mark.parametrize("touch", ["z > 0", "x > 0.0299", "z > 0.045, x > 0.02", "z > 0.0475, x > 0.0275, y > 0.0175"])
def test_points_cover_a_region_evenly_however_small(touch: str) -> None:
    place, face = region_points(BOX, region(touch))
    assert len(place) > (SAMPLES if "y" not in touch else FEWEST) and region(touch).contains(place).all()
    on_face = np.abs(np.abs(place) - SIZE / 2).min(axis=1)
    assert on_face.max() < 1e-9 and len(face) == len(place)
    # Each octant of the region's bounds that other points of the surface are in has some.
    other = even_points(BOX, 200_000, np.random.default_rng(1))[0]
    other = other[region(touch).contains(other)]
    for axis in range(3):
        share = [(some[:, axis] > np.median(other[:, axis])).mean() for some in (place, other)]
        assert share[0] == pytest.approx(share[1], abs=0.16)


@pytest.mark.parametrize("bounds", [("z > 0.0499, x > 0.0299, y > 0.0199", ""), ("z > 5", ""), ("z > 0", "z > -1")])
def test_a_region_without_surface_is_refused(bounds: tuple[str, str]) -> None:
    with pytest.raises(InputError, match=r"no surface in the region.*in metres"):
        region_points(BOX, region(*bounds))


#: A body on which a narrower handle stands; the handle's lower end is at the height SEAM [m].
BODY, HANDLE, SEAM = box(0.06, 0.06, 0.06, at=(0, 0, 0.03)), box(0.03, 0.03, 0.12, at=(0, 0, 0.12)), 0.06
RED, BLUE = (255, 0, 0), (0, 0, 255)
HOSTILE = [
    "part ",
    "part \x1b[2J",
    "part " + "x" * 81,
    "part a\nb",
    "color red",
    "color #ff00",
    "color #gg0000",
    "parts",
]


def obj(*groups: tuple[str, tuple[np.ndarray, np.ndarray]]) -> dict[str, bytes]:
    lines, count = list[str](), 1
    for heading, (vertices, faces) in groups:
        lines += [heading, *("v {} {} {}".format(*row) for row in vertices)]
        lines += ["f {} {} {}".format(*row) for row in (faces + count).tolist()]
        count += len(vertices)
    return {"m.obj": "\n".join(lines).encode()}


def ply(encoding: str, of: int) -> dict[str, bytes]:
    """A PLY with colours of its vertices (of = 0) or of its faces (of = 1)."""
    mesh = trimesh.util.concatenate([trimesh.Trimesh(*one, process=False) for one in (BODY, HANDLE)])
    colours = np.repeat([RED, BLUE], len(BODY[of]), axis=0)
    mesh.visual = trimesh.visual.ColorVisuals(mesh, **{("vertex_colors", "face_colors")[of]: colours})
    return {"m.ply": mesh.export(file_type="ply", encoding=encoding)}


def glb() -> dict[str, bytes]:
    scene = trimesh.Scene()
    for name, colour, (vertices, faces) in (("pot", RED, BODY), ("handle", BLUE, HANDLE)):
        look = trimesh.visual.material.PBRMaterial(name=f"{name} paint", baseColorFactor=[*colour, 255])
        mesh = trimesh.Trimesh(vertices - [0.1, 0, 0], faces, process=False)
        mesh.visual = trimesh.visual.TextureVisuals(uv=np.zeros((len(vertices), 2)), material=look)
        scene.add_geometry(
            mesh, name, f"{name} mesh", transform=trimesh.transformations.translation_matrix([0.1, 0, 0])
        )
    return {"m.glb": scene.export(file_type="glb")}


OBJ = obj(("o pot\nusemtl steel", BODY), ("g handle grip\nusemtl wood", HANDLE))
CASES = [
    (OBJ, "part handle"),
    (OBJ, "part grip"),
    (OBJ, "part wood"),
    (glb(), "part handle mesh"),
    (glb(), "part handle"),
    (glb(), "part handle paint"),
    (glb(), "color #0000ff"),
    (ply("ascii", 0), "color #0000ff"),
    (ply("binary", 0), "color #0008f8"),
    (ply("ascii", 1), "color #0000ff"),
    (ply("binary", 1), "color #0000ff"),
]


def load(files: dict[str, bytes]) -> ObjectModel:
    return load_object(files, name="m", digest="", face_error_m=3e-4)


def region_of(obj: ObjectModel, text: str) -> Requirements:
    request = JobOptions(touch_region=text)
    return Requirements.of(request, hand_from_path("allegro"), obj=obj.centred, origin=obj.centre)


@pytest.mark.parametrize("text", HOSTILE)
def test_a_region_in_another_form_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="a region is up to 12 bounds"):
        parse_region(text)
    assert parse_region(" part  left handle ") == RegionSpec(part="left handle")
    assert parse_region("color #FF0010") == RegionSpec(colour="#ff0010")


@pytest.mark.parametrize(("files", "text"), CASES)
def test_voxels_of_a_part_end_within_a_cell_of_its_boundary(files: dict[str, bytes], text: str) -> None:
    thing = load(files)
    region = region_of(thing, text).region
    points, _ = trimesh.sample.sample_surface(trimesh.Trimesh(thing.vertices, thing.faces), 20_000, seed=1)
    inside = region.contains(points - thing.centre)
    # The handle stands on the body: of the body's top, only the rim beside the handle is near it.
    far = np.abs(points[:, 2] - SEAM) > CELL_M
    far |= np.abs(points[:, :2]).max(axis=1) > 0.015 + 2 * CELL_M
    assert (inside == (points[:, 2] > SEAM + 1e-6))[far].all() and inside.any()


def test_the_check_lists_parts_and_colours() -> None:
    facts = check_object(OBJ, "pot")["facts"]
    assert facts["parts"] == ["grip", "handle", "pot", "steel", "wood"] and facts["colours"] == []
    assert check_object(glb(), "pot")["facts"]["colours"] == ["#ff0000", "#0000ff"]
    assert check_object(stl(BODY), "pot")["facts"]["parts"] == []


def test_an_unknown_part_is_refused_with_the_known_ones() -> None:
    for text, told in (("part lid", "grip, handle, pot"), ("color #00ff00", "no colours to choose from")):
        with pytest.raises(InputError, match=told) as error:
            region_of(load(OBJ), text)
        assert "\n" not in str(error.value) and "m has no" in str(error.value)
    with pytest.raises(InputError, match="no named parts to choose from"):
        region_of(load(stl(BODY)), "part lid")


def test_many_hostile_names_are_dropped() -> None:
    groups = [(f"g {'x' * 81} p{k}\no \x1b[{k}m", BODY) for k in range(3)]
    assert read_mesh("m.obj", obj(*groups)["m.obj"]).names.sets == ((), ("p0",), ("p1",), ("p2",))
    lines = b"".join(b"g q%d\nf 1 2 3\n" % k for k in range(5000))
    assert len(read_mesh("m.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n" + lines).names.sets) == 1000


def test_parts_change_no_digest_and_come_back_from_bytes() -> None:
    thing, plain = load(OBJ), load(obj(("", BODY), ("", HANDLE)))
    assert plain.parts is None and thing.parts is not None
    assert (thing.content, thing.centred.content) == (plain.content, plain.centred.content)
    again = from_bytes(to_bytes(thing), name="m", digest="")
    assert again.parts is not None and again.parts.content == thing.parts.content
    old = np.load(io.BytesIO(to_bytes(plain)))
    assert not [name for name in old.files if name.startswith("part")]
    assert from_bytes(to_bytes(plain), name="m", digest="").parts is None


def test_an_object_stored_by_an_earlier_version_gets_its_parts(
    monkeypatch: pytest.MonkeyPatch, own_cache: Path
) -> None:
    files = {**OBJ, "asset.json": b'{"file": "m.obj"}'}
    store, digest = open_store("memory://"), digest_files(AssetKind.OBJECT, files)
    publish_asset(store, AssetKind.OBJECT, "pot", files)
    message = message_for(object="pot").model_copy(update={"object_digest": digest})
    with monkeypatch.context() as earlier:
        earlier.setattr(repair, "parts_of", lambda *mesh: None)
        thing = object_of(store, message)
    assert thing.parts is None
    prepare._prepare.cache_clear()
    prepare._repair_file.cache_clear()
    shutil.rmtree(own_cache)
    wanted = message.request.model_copy(update={"touch_region": "part handle"})
    again = object_of(store, message.model_copy(update={"request": wanted}))
    assert again.parts is not None and again.content == thing.content
    assert load(OBJ).parts is not None


def test_precision_grasps_touch_only_the_part() -> None:
    hand, thing = hand_from_path("allegro"), load(OBJ)
    for changes, bounds in (
        ({"touch_region": "part handle", "type": "precision"}, f"z > {SEAM - CELL_M}"),
        ({"avoid_region": "part handle"}, f"z < {SEAM + CELL_M}"),
    ):
        request = JobOptions(grasps=8, fidelity="draft", validation="none", seed=3, **changes)
        grasps = validated_grasps(hand, thing, request, count=8).grasps.moved(np.negative(thing.centre))
        share = measure(hand, thing.centred, grasps, region=region_of(thing, bounds).region)["quality/region_share"]
        assert len(grasps) and (share >= LEAST_SHARE).all()
