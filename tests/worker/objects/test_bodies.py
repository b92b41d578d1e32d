"""Objects of several parts, and objects given as a URDF, SDF or MJCF: mass properties by closed forms, and safety."""

from pathlib import Path

import numpy as np
import pytest

from graspd.api.uploads import files_of_upload
from graspd.client.add_commands import upload_of
from graspd.service.model.states import AssetKind
from graspd.service.store.assets import pack, unpack
from graspd.service.store.object_sets import find_set_objects
from graspd.worker.objects.check import check_object
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.prepare import load_object, object_from_path
from tests.worker.objects.shapes import Mesh, box, join, sphere

#: OBJ holds 17 digits; the reader rounds coordinates to nine.
ROUNDING = 1e-7
SIZE, MASS, FRICTION = (0.04, 0.05, 0.06), 0.3, 0.8


def obj(mesh: Mesh) -> bytes:
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in mesh[0].tolist()]
    return "\n".join(lines + [f"f {a} {b} {c}" for a, b, c in (mesh[1] + 1).tolist()]).encode()


def load(files: dict[str, bytes], **options) -> ObjectModel:
    return load_object(files, name="m", digest="", face_error_m=0.0, options=options)


def cuboid(size, at=(0.0, 0.0, 0.0)) -> tuple[float, np.ndarray, np.ndarray]:
    """Volume, centre, and second moments about the origin of a cuboid: V diag(a^2) / 12 + V c c^T."""
    volume, centre = float(np.prod(size)), np.array(at)
    return volume, centre, volume * (np.diag(np.square(size)) / 12 + np.outer(centre, centre))


def assert_mass_properties(model: ObjectModel, *cuboids: tuple[float, np.ndarray, np.ndarray], signs=(1, 1, 1)) -> None:
    """Compare volume, centre and inertia per mass with sums over cuboids, of which overlaps count negatively."""
    volume = sum(sign * one[0] for sign, one in zip(signs, cuboids, strict=False))
    centre = sum(sign * one[0] * one[1] for sign, one in zip(signs, cuboids, strict=False)) / volume
    second = sum(sign * one[2] for sign, one in zip(signs, cuboids, strict=False)) / volume - np.outer(centre, centre)
    assert model.volume == pytest.approx(volume, rel=ROUNDING)
    np.testing.assert_allclose(model.centre_of_mass, centre, atol=ROUNDING * 0.1)
    expected = np.trace(second) * np.eye(3) - second
    np.testing.assert_allclose(model.inertia, expected, atol=1e-6 * np.trace(expected))


@pytest.mark.parametrize(("gap", "options"), [(0.0, {}), (0.0005, {}), (0.002, {"rigid": True})])
def test_stacked_boxes_are_one_rigid_body(gap: float, options: dict) -> None:
    upper, at = (0.02, 0.03, 0.05), (0.004, 0.003, 0.03 + gap + 0.025)
    model = load({"m.obj": obj(join(box(*SIZE), box(*upper, at)))}, **options)
    assert_mass_properties(model, cuboid(SIZE), cuboid(upper, at))


def test_overlapping_and_nested_boxes_count_their_overlap_once() -> None:
    upper, at = (0.02, 0.03, 0.05), (0.004, 0.003, 0.04)
    shared = cuboid((0.02, 0.03, 0.015), (0.004, 0.003, 0.0225))
    inner = box(0.01, 0.02, 0.03, (0.002, 0.0, 0.001))
    model = load({"m.obj": obj(join(box(*SIZE), box(*upper, at), inner))})
    assert any("united 3" in repair for repair in model.repairs)
    assert_mass_properties(model, cuboid(SIZE), cuboid(upper, at), shared, signs=(1, 1, -1))


URDF = """<robot name="r"><link name="base"/><joint name="j" type="fixed"><parent link="base"/><child link="b"/>
<origin xyz="0 0 0.1"/></joint><link name="b">
<contact><lateral_friction value="0.8"/></contact>
<inertial><origin xyz="0.002 0 0.003" rpy="0 0 1.5707963267948966"/><mass value="0.3"/>
<inertia ixx="2e-4" ixy="0" ixz="0" iyy="1.5e-4" iyz="0" izz="1e-4"/></inertial>
<collision><origin xyz="0.01 0 0" rpy="1.5707963267948966 0 0"/><geometry>
<mesh filename="package://thing/meshes/box.obj" scale="0.001 0.001 0.001"/></geometry></collision></link></robot>"""
SDF = """<?xml version="1.0"?><sdf version="1.6"><model name="thing"><link name="b"><pose>0 0 0.1 0 0 0</pose>
<inertial><pose>0.002 0 0.003 0 0 1.5707963267948966</pose><mass>0.3</mass>
<inertia><ixx>2e-4</ixx><iyy>1.5e-4</iyy><izz>1e-4</izz></inertia></inertial>
<collision name="c"><pose>0.01 0 0 1.5707963267948966 0 0</pose><geometry><mesh>
<uri>model://thing/meshes/box.obj</uri><scale>0.001 0.001 0.001</scale></mesh></geometry>
<surface><friction><ode><mu>0.8</mu></ode></friction></surface></collision></link></model></sdf>"""
MJCF = """<mujoco><compiler meshdir="meshes"/><asset><mesh name="m" file="box.obj" scale="0.001 0.001 0.001"/></asset>
<worldbody><body pos="3 2 1" euler="0 90 0"><freejoint/><body name="b" pos="0 0 0.1">
<inertial pos="0.002 0 0.003" euler="0 0 90" mass="0.3" diaginertia="2e-4 1.5e-4 1e-4"/>
<geom type="mesh" mesh="m" pos="0.01 0 0" euler="90 0 0" friction="0.8 0.1 0.1"/></body></body></worldbody></mujoco>"""
MESH = {"meshes/box.obj": obj(box(*(1000 * size for size in SIZE)))}


@pytest.mark.parametrize(("name", "text"), [("b.urdf", URDF), ("model.sdf", SDF), ("b.xml", MJCF)])
def test_a_description_gives_scale_place_mass_inertia_and_friction(name: str, text: str) -> None:
    files = {name: text.encode(), "asset.json": b"{}", **MESH}
    model = load(files)
    # MuJoCo holds meshes in single precision.
    tolerance = 1e-7
    # Turned by 90 degrees about x, the box is 0.06 long in y.
    middle, half = np.array([0.01, 0.0, 0.1]), np.array([SIZE[0], SIZE[2], SIZE[1]]) / 2
    np.testing.assert_allclose(model.vertices.min(axis=0), middle - half, atol=tolerance)
    np.testing.assert_allclose(model.vertices.max(axis=0), middle + half, atol=tolerance)
    assert (model.mass, model.friction) == pytest.approx((MASS, FRICTION), rel=1e-12)
    np.testing.assert_allclose(model.centre_of_mass, [0.002, 0.0, 0.103], atol=tolerance)
    # The turn about z exchanges the moments of x and y.
    np.testing.assert_allclose(model.inertia, np.diag([1.5e-4, 2e-4, 1e-4]) / MASS, atol=1e-7 * 1e-3)
    assert check_object(files, "b")["facts"]["mass_stated"]
    own = load(files, mass=0.5, friction=0.4)
    assert (own.mass, own.friction) == (0.5, 0.4)
    assert load(files, density=500.0).mass == pytest.approx(500 * np.prod(SIZE), rel=1e-6)
    half_size = load(files, scale_to=0.03)
    np.testing.assert_allclose(half_size.inertia, model.inertia / 4, rtol=1e-6)
    np.testing.assert_allclose(half_size.centre_of_mass, model.centre_of_mass / 2, atol=tolerance)


@pytest.mark.parametrize(
    ("moments", "z"),
    # A placeholder, moments of a far larger body, a sum of two below the third, and a centre outside.
    [((1, 1, 0), 0.003), ((1, 1, 1), 0.003), ((1e-4, 1e-4, 3e-4), 0.003), ((2e-4, 1.5e-4, 1e-4), 0.05)],
)
def test_an_inertia_that_the_shape_cannot_have_is_computed_and_said_so(moments: tuple, z: float) -> None:
    given = URDF.replace("0.003", str(z))
    for key, old, new in zip(("ixx", "iyy", "izz"), ("2e-4", "1.5e-4", "1e-4"), moments, strict=True):
        given = given.replace(f'{key}="{old}"', f'{key}="{new}"')
    files = {"b.urdf": given.encode(), **MESH}
    model, report = load(files), check_object(files, "b")
    assert_mass_properties(model, cuboid((SIZE[0], SIZE[2], SIZE[1]), (0.01, 0.0, 0.1)))
    assert model.mass == MASS and "stated inertia" in report["message"]


def one_link(inner: str) -> bytes:
    return f'<robot name="r"><link name="b">{inner}</link></robot>'.encode()


def shape(tag: str, geometry: str, xyz: str = "0 0 0") -> str:
    return f'<{tag}><origin xyz="{xyz}"/><geometry>{geometry}</geometry></{tag}>'


def test_shapes_of_one_link_that_lie_apart_are_one_rigid_body() -> None:
    cube = '<box size="0.04 0.05 0.06"/>'
    model = load({"b.urdf": one_link(shape("visual", cube) + shape("visual", cube, "0 0 0.1"))})
    assert_mass_properties(model, cuboid(SIZE), cuboid(SIZE, (0, 0, 0.1)))


@pytest.mark.parametrize(
    ("geometry", "volume"),
    [
        ('<sphere radius="0.03"/>', 4 / 3 * np.pi * 0.03**3),
        ('<cylinder radius="0.03" length="0.1"/>', np.pi * 0.03**2 * 0.1),
        ('<capsule radius="0.03" length="0.1"/>', np.pi * 0.03**2 * 0.1 + 4 / 3 * np.pi * 0.03**3),
    ],
)
def test_primitives_are_solids(geometry: str, volume: float) -> None:
    # A circle of 64 corners has 0.16 % less area; a ball of such circles has 0.56 % less volume.
    assert load({"b.urdf": one_link(shape("collision", geometry))}).volume == pytest.approx(volume, rel=6e-3)


def test_the_collision_shape_is_taken_if_the_visible_one_cannot_be_used() -> None:
    vertices, faces = sphere(0.03)
    files = {
        "b.urdf": one_link(
            shape("visual", '<mesh filename="open.obj"/>') + shape("collision", '<box size=".1 .1 .1"/>')
        ),
        "open.obj": obj((vertices, faces[: len(faces) // 2])),
    }
    report = check_object(files, "b")
    assert report["verdict"] == "repair" and "took the collision shapes" in report["message"]
    assert report["facts"]["volume_m3"] == pytest.approx(1e-3)
    whole = check_object(files | {"open.obj": obj((vertices, faces))}, "b")
    # Besides the circles, simplification within 0.3 mm takes some of the ball.
    assert whole["facts"]["volume_m3"] == pytest.approx(4 / 3 * np.pi * 0.03**3, rel=0.02)


MESH_OF = '<visual><geometry><mesh filename="{}"/></geometry></visual>'


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (one_link(MESH_OF.format("../../etc/passwd.obj")).decode(), "outside its folder"),
        (one_link(MESH_OF.format("missing.obj")).decode(), "is not there"),
        (one_link(MESH_OF.format("http://x/y.obj")).decode(), "no file of the upload"),
        (one_link(shape("visual", '<box size="1 nan 1"/>')).decode(), "finite"),
        (one_link("").decode(), "no shape"),
        ('<!DOCTYPE r [<!ENTITY a "b">]>' + one_link("&a;").decode(), "entities"),
        (URDF.replace('type="fixed"', 'type="revolute"'), "not one rigid body"),
        (MJCF.replace("<freejoint/>", '<joint axis="0 0 1"/>'), "not one rigid body"),
        (MJCF.replace('file="box.obj"', 'file="/etc/passwd.obj"'), "outside its folder"),
        (SDF.replace("<pose>0 0 0.1", '<pose relative_to="x">0 0 0.1'), "relative to another frame"),
        (SDF.replace("</model>", "</model><model/>"), "2 models"),
    ],
)
def test_no_description_reaches_outside_or_passes_unread(text: str, reason: str) -> None:
    report = check_object({"b.xml": text.encode(), **MESH}, "b")
    assert report["verdict"] == "refuse" and reason in report["message"], report["message"]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two objects, as in pybullet's random_urdfs, beside a plain mesh."""
    for name in ("000", "001"):
        (tmp_path / "set" / name).mkdir(parents=True)
        (tmp_path / "set" / name / f"{name}.urdf").write_bytes(one_link(MESH_OF.format(f"{name}.obj")))
        (tmp_path / "set" / name / f"{name}.obj").write_bytes(obj(box()))
    (tmp_path / "set" / "plain.obj").write_bytes(obj(box()))
    return tmp_path / "set"


def test_a_description_is_one_object_with_its_meshes(folder: Path) -> None:
    found = find_set_objects(folder)
    assert found is not None and {name: sorted(files) for name, files in found.items()} == {
        "000": ["000/000.obj", "000/000.urdf"],
        "001": ["001/001.obj", "001/001.urdf"],
        "plain": ["plain.obj"],
    }
    assert check_object(found["000"], "000")["verdict"] == "accept"
    assert object_from_path(folder / "001" / "001.urdf").name == "001"
    with upload_of(folder / "001" / "001.urdf") as (archive, main):
        files = unpack(archive.read_bytes(), limit_bytes=2**20)
        assert main == "001.urdf" and sorted(files) == ["001.obj", "001.urdf"]
        sent = files_of_upload(AssetKind.OBJECT, "001.zip", pack(files), limit_bytes=2**20)
    assert load(dict(sent)).volume == pytest.approx(0.06 * 0.05 * 0.04) and b"001.urdf" in sent["asset.json"]
