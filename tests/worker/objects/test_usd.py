"""USD stages as objects: units, instances, layers, colours, mass; hostile stages; stages that others made."""

import io
import random
import sys
import tempfile
import zipfile
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from graspd.service.model.errors import MeshError
from graspd.worker.objects.check import check_object
from graspd.worker.objects.formats import read_mesh, usd
from graspd.worker.objects.mesh_geometry import signed_volume
from graspd.worker.objects.prepare import files_from_path, load_object

pytest.importorskip("pxr", reason="needs the extra usd")

HEAD = '#usda 1.0\n(\n defaultPrim = "Thing"\n metersPerUnit = {unit}\n upAxis = "Y"\n {more}\n)\n'
#: A tetrahedron with its corner at the origin; volume 1/6.
TETRAHEDRON = """
 point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
 int[] faceVertexCounts = [3, 3, 3, 3]
 int[] faceVertexIndices = [0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3]
"""


def stage(body: str, *, unit: float = 0.01, more: str = "") -> bytes:
    # A statement ends at a line end.
    return HEAD.format(unit=unit, more=more).encode() + body.replace("{ ", "{\n").replace(" }", "\n}").encode()


def thing(inner: str, meta: str = "", **head: object) -> bytes:
    return stage(f'def Xform "Thing" ({meta}) {{\n{inner}\n}}\n', **head)  # type: ignore[arg-type]


def refusal(files: dict[str, bytes], **options: object) -> str:
    found = check_object(files, "thing", **options)
    assert found["verdict"] == "refuse", found
    message = str(found["message"])
    assert len(message) < 400
    assert "\n" not in message
    return message


def test_frame_is_the_stages_in_metres() -> None:
    """Axes stay as authored: +y up is not turned; transforms, also of the default prim, are applied."""
    inner = (
        f'double3 xformOp:translate = (0, 20, 0)\nuniform token[] xformOpOrder = ["xformOp:translate"]\n{TETRAHEDRON}'
    )
    soup = read_mesh("thing.usda", thing(f'def Mesh "m" {{ {inner} }}'))
    assert np.allclose(soup.vertices.min(axis=0), [0, 0.2, 0])
    assert np.allclose(soup.vertices.max(axis=0), [0.01, 0.21, 0.01])
    # Stages are kept within a limit of bytes, and by digests instead of their files.
    kept = usd._read_packed.cache
    assert 0 < kept.currsize <= kept.maxsize == usd._KEPT_BYTES
    assert all(len(key[0]) == 32 and isinstance(key[0], str) for key in kept)


@pytest.mark.parametrize(
    ("prim", "size", "volume"),
    [
        ('def Cube "g" { double size = 2 }', (2, 2, 2), 8.0),
        ('def Sphere "g" { double radius = 1 }', (2, 2, 2), 4.18879),
        ('def Cylinder "g" { double radius = 1\n double height = 3\n uniform token axis = "X" }', (3, 2, 2), 9.42478),
        ('def Capsule "g" { double radius = 1\n double height = 3\n uniform token axis = "Y" }', (2, 5, 2), 13.61357),
        ('def Cone "g" { double radius = 1\n double height = 3\n uniform token axis = "Z" }', (2, 2, 3), 3.14159),
    ],
)
def test_primitives_are_solids(prim: str, size: tuple[float, ...], volume: float) -> None:
    """Chords of 64 sections lose 0.2 % of a circle's area, a sphere and a capsule at most 2 % of their volume."""
    obj = load_object({"g.usda": thing(prim)}, name="g", digest="", face_error_m=0)
    assert np.allclose(np.ptp(obj.vertices, axis=0), np.array(size) * 0.01, rtol=2e-3)
    assert np.allclose(obj.vertices.max(axis=0), -obj.vertices.min(axis=0), rtol=2e-3, atol=1e-6)
    assert obj.volume * 1e6 == pytest.approx(volume, rel=0.02)
    assert obj.watertight


def test_instances_and_point_instancers_are_copies() -> None:
    """Two instances and three points of an instancer, whose prototype is scaled by 2 and mirrored."""
    turned = 'float3 xformOp:scale = (-2, 2, 2)\nuniform token[] xformOpOrder = ["xformOp:scale"]'
    more = f"""
def Xform "Proto" {{ def Mesh "m" {{ {TETRAHEDRON} }} }}
def Xform "Thing" {{
 def "a" (instanceable = true\n references = </Proto>) {{ {_translate(0, 0, 5)} }}
 def "b" (instanceable = true\n references = </Proto>) {{ {_translate(0, 0, 8)} }}
 def PointInstancer "p" {{
  rel prototypes = <q>
  int[] protoIndices = [0, 0, 0]
  point3f[] positions = [(10, 0, 0), (20, 0, 0), (30, 0, 0)]
  def Mesh "q" {{ {turned}\n{TETRAHEDRON} }}
 }}
}}"""
    obj = load_object({"a.usda": stage(more)}, name="a", digest="", face_error_m=0, options={"compound": True})
    soup = read_mesh("a.usda", stage(more))
    assert signed_volume(soup.vertices, soup.faces) == pytest.approx(obj.volume, rel=1e-5), "inside out"
    assert obj.volume == pytest.approx((2 + 3 * 8) / 6 * 1e-6, rel=1e-5)
    assert obj.vertices[:, 0].max() == pytest.approx(0.3)


def _translate(*by: float) -> str:
    return f'double3 xformOp:translate = {by}\nuniform token[] xformOpOrder = ["xformOp:translate"]'


def test_layers_variants_and_packages() -> None:
    """The selected variant refers to a second layer; a USDZ of both is the same object."""
    meta = 'variants = { string size = "large" }\n prepend variantSets = "size"'
    variants = """variantSet "size" = {
 "small" { def "m" (references = @parts/missing.usda@) {} }
 "large" { def "m" (references = @./parts/solid.usda@) {} } }"""
    with pytest.raises(MeshError, match=r"Could not open asset @parts/missing.usda@ for reference"):
        read_mesh("a.usda", thing(variants, meta.replace("large", "small")))
    root = thing(variants, meta)
    solid = thing(f'def Mesh "m" {{ {TETRAHEDRON} }}')
    files = {"a.usda": root, "parts/solid.usda": solid, "asset.json": b'{"file": "a.usda"}'}
    obj = load_object(files, name="a", digest="", face_error_m=0)
    assert obj.volume == pytest.approx(1e-6 / 6, rel=1e-6)
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        archive.writestr("a.usda", root)
        archive.writestr("parts/solid.usda", solid)
        archive.writestr("textures/skin.png", b"no picture")
    assert np.array_equal(
        load_object({"a.usdz": packed.getvalue()}, name="a", digest="", face_error_m=0).vertices, obj.vertices
    )


def test_files_of_a_stage_on_disk(tmp_path: Path) -> None:
    (tmp_path / "in" / "sub").mkdir(parents=True)
    (tmp_path / "in" / "root.usda").write_bytes(thing('def "m" (references = @./sub/b.usda@) {}'))
    (tmp_path / "in" / "sub" / "b.usda").write_bytes(thing(f'def Mesh "m" {{ {TETRAHEDRON} }}'))
    (tmp_path / "in" / "unrelated.usda").write_bytes(b"#usda 1.0\n")
    name, files, stated = files_from_path(tmp_path / "in" / "root.usda")
    assert (name, sorted(files), stated) == ("root", ["root.usda", "sub/b.usda"], {"file": "root.usda"})
    (tmp_path / "in" / "sub" / "b.usda").write_bytes(thing("", "references = @../../outside.usda@"))
    (tmp_path / "outside.usda").write_bytes(thing(""))
    with pytest.raises(Exception, match="outside its folder"):
        files_from_path(tmp_path / "in" / "root.usda")


def test_mass_friction_and_density() -> None:
    """Masses of bodies are summed; a body's mass includes its parts; options override; grams are converted."""
    apis = '"PhysicsCollisionAPI", "MaterialBindingAPI", "PhysicsMassAPI"'
    solid = f"""def Mesh "m" (prepend apiSchemas = [{apis}]) {{
 float physics:mass = 5
 rel material:binding:physics = </Thing/rubber>
 {TETRAHEDRON} }}"""
    rubber = (
        'def Material "rubber" (prepend apiSchemas = ["PhysicsMaterialAPI"]) { float physics:dynamicFriction = 0.8 }'
    )
    api = 'prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"]'
    files = {"a.usda": thing(f"float physics:mass = 250\n{solid}\n{rubber}", api, more="kilogramsPerUnit = 0.001")}
    obj = load_object(files, name="a", digest="", face_error_m=0)
    assert (obj.mass, obj.friction) == (pytest.approx(0.25), pytest.approx(0.8))
    assert check_object(files, "a")["facts"]["mass_stated"]
    assert load_object(files, name="a", digest="", face_error_m=0, options={"mass": 2.0}).mass == 2.0
    dense = thing(f"float physics:density = 0.002\n{solid.replace('mass = 5', 'mass = 0')}", api)
    obj = load_object({"b.usda": dense}, name="b", digest="", face_error_m=0)
    assert obj.mass == pytest.approx(0.002 / 0.01**3 * obj.volume)


def test_colours_and_subsets_are_parts() -> None:
    """Display colours are linear; a subset is a part."""
    looks = """
 color3f[] primvars:displayColor = [(1, 0, 0), (1, 0, 0), (0.21404, 0.21404, 0.21404), (0, 0, 1)] (
  interpolation = "uniform"
 )
 def GeomSubset "lid" {
  uniform token elementType = "face"
  int[] indices = [3]
 }"""
    soup = read_mesh("a.usda", thing(f'def Mesh "body" {{ {TETRAHEDRON}\n{looks} }}'))
    assert soup.colours is not None
    assert np.allclose(soup.colours, [[1, 0, 0], [1, 0, 0], [0.5, 0.5, 0.5], [0, 0, 1]], atol=1e-5)
    assert soup.names is not None
    assert [soup.names.sets[k] for k in soup.names.index] == [("body",)] * 3 + [("body", "lid")]


def test_shown_geometry_comes_before_colliders() -> None:
    hull = 'def Cube "hull" (prepend apiSchemas = ["PhysicsCollisionAPI"]) { uniform token purpose = "guide" }'
    inner = f'def Mesh "look" {{ {TETRAHEDRON} }}\n{hull}'
    assert len(read_mesh("a.usda", thing(inner)).faces) == 4
    assert (
        len(
            read_mesh(
                "a.usda", thing(inner.replace('Mesh "look" {', 'Mesh "look" { token visibility = "invisible"'))
            ).faces
        )
        == 12
    )


#: Ten levels of ten instances: 10^10 tetrahedra in a file of a few kilobytes.
NESTED = "\n".join(
    f'def "L{k}" {{ '
    + "\n".join(f'def "i{n}" (instanceable = true\n references = </L{k - 1}>) {{}}' for n in range(10))
    + " }"
    for k in range(1, 11)
)
MESH = f'def Mesh "m" {{ {TETRAHEDRON} }}'


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (thing(MESH, "references = @https://example.com/a.usd@"), "'https://example.com/a.usd', outside its folder"),
        (thing(MESH, "references = @/etc/hosts.usd@"), "'/etc/hosts.usd', outside its folder"),
        (thing(MESH, "payload = @../other.usd@"), "'../other.usd', outside its folder"),
        (thing(MESH, more="subLayers = [@omniverse://server/a.usd@]"), "outside its folder"),
        (thing(MESH, "references = @a.obj@"), "'a.obj', which is no USD layer"),
        (thing(MESH, "references = @`${X}`@"), "which is no USD layer"),
        (thing('def "a" (references = </Thing/a>) {}'), "Cycle detected"),
        (thing(MESH, "references = @./b.usda@"), "Could not open asset @b.usda@"),
        (thing('def "a" (references = </Nothing>) {}'), "Unresolved reference prim path"),
        (
            thing(f"int[] primvars:skel:jointIndices = [0]\n{TETRAHEDRON}").replace(b"def Xform", b"def Mesh"),
            "a mesh with bones",
        ),
        (stage(f'def "L0" {{ {MESH} }}\n{NESTED}\ndef Xform "Thing" (references = </L10>) {{}}'), "prims"),
        (thing(MESH, unit=0), "metersPerUnit is 0"),
        (thing(MESH, unit=100), "--units mm makes it 10 cm long"),
        (thing(""), "no faces"),
        (thing(f'def Mesh "m" {{ {TETRAHEDRON.replace("[3, 3, 3, 3]", "[3, 3]")} }}'), "do not match their corners"),
        (thing(f'def Mesh "m" {{ {TETRAHEDRON.replace("1, 2, 3]", "1, 2, 9]")} }}'), "outside the 4 vertices"),
        (b"#usda 1.0\ndef Xform {", "parse error"),
        (b"PXR-USDC" + bytes(200), "thing.usd"),
        (b"PK\x03\x04" + bytes(200), "not a readable ZIP"),
        (b"solid a\nfacet normal 0 0 1\n", "a mesh of type .stl: rename it"),
    ],
)
def test_bad_stages_are_refused_in_one_line(data: bytes, message: str) -> None:
    assert message in refusal({"thing.usd": data})


def test_instances_are_counted_before_they_are_made() -> None:
    """10^9 points: 250 million instances of a tetrahedron would need a tenth of a terabyte."""
    from pxr import Usd, UsdGeom, Vt

    made = Usd.Stage.CreateInMemory()
    UsdGeom.Mesh.Define(made, "/Thing/p/m")
    instancer = UsdGeom.PointInstancer.Define(made, "/Thing/p")
    instancer.CreatePrototypesRel().AddTarget("/Thing/p/m")
    instancer.CreateProtoIndicesAttr(Vt.IntArray(5_000_000))
    instancer.CreatePositionsAttr(Vt.Vec3fArray(1))
    made.SetDefaultPrim(made.GetPrimAtPath("/Thing"))
    data = _crate(made)
    assert len(data) < 2**20
    assert "5000000 instances; at most" in refusal({"thing.usd": data})


def _crate(made: object) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        made.GetRootLayer().Export(f"{folder}/a.usdc")  # type: ignore[attr-defined]
        return Path(folder, "a.usdc").read_bytes()


def test_damaged_crates_never_crash_the_reader() -> None:
    from pxr import Sdf, Usd

    layer = Sdf.Layer.CreateAnonymous(".usda")
    layer.ImportFromString(thing(MESH).decode())
    whole = _crate(Usd.Stage.Open(layer))
    assert len(read_mesh("a.usd", whole).faces) == 4
    rng = random.Random(0)
    refused = 0
    for _ in range(6):
        data = bytearray(whole)
        for _ in range(8):
            data[rng.randrange(88, len(data))] = rng.randrange(256)
        try:
            read_mesh("a.usd", bytes(data))
        except MeshError as error:
            refused += 1
            assert "\n" not in str(error)
    assert refused


def test_without_usd_core_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pxr", None)
    assert "pip install 'graspd[usd]'" in refusal({"thing.usd": thing(MESH)})


#: Stages of other projects: package, file, and what `check_object` says of it.
OTHERS = [
    ("warp", "examples/assets/bear.usd", {}, "9.78 m long, too large to grasp; --units cm makes it 97.8 mm long"),
    ("warp", "examples/assets/bear.usd", {"units": "cm"}, "accept: 49 x 55 x 98 mm"),
    ("warp", "examples/assets/rocks.usd", {}, "37.64 m long, too large to grasp"),
    ("warp", "examples/assets/cube.usd", {}, "accept: 2000 x 2000 x 2000 mm, 12 faces"),
    ("warp", "examples/assets/sphere.usd", {}, "accept: 2000 x 2000 x 2000 mm, 224 faces"),
    ("warp", "examples/assets/square_cloth.usd", {}, "it is flat"),
    ("warp", "tests/assets/torus.usda", {}, "repair: 1500 x 500 x 1500 mm"),
    ("warp", "tests/assets/spiky.usd", {}, "accept: 2000 x 2174 x 2000 mm, 48 faces"),
    ("mujoco", "testdata/usd_golden.usda", {}, "accept: 20 x 20 x 20 mm, 12 faces"),
    ("mujoco", "testdata/simple_usd_preview_surface.usda", {}, "4.901 m long, too large to grasp"),
    ("newton", "examples/assets/rj45_plug.usd", {}, "not watertight (82 open edges)"),
    ("newton", "examples/assets/mpm_sand.usda", {}, "no faces"),
    (
        "newton",
        "tests/assets/negative_scale_cube.usda",
        {},
        "accept: 1000 x 500 x 1500 mm, 12 faces, 750000.0 cm3, 1 kg",
    ),
    ("newton", "tests/assets/negative_scale_mesh_pair.usda", {}, "repair: 2000 x 1000 x 1000 mm"),
    ("newton", "tests/assets/cube_cylinder.usda", {}, "2 separate components"),
    ("newton", "tests/assets/ant_multi.usda", {}, "at most 1000000 are taken"),
    ("newton", "tests/assets/kamino/testing/geoms/test_geom_box.usda", {}, "repair: 222 x 444 x 666 mm"),
]


@pytest.mark.parametrize(("package", "file", "options", "told"), OTHERS)
def test_stages_of_other_projects(package: str, file: str, options: dict[str, str], told: str) -> None:
    found = find_spec(package)
    path = Path(found.submodule_search_locations[0] if found and found.submodule_search_locations else "") / file
    if not path.is_file():
        pytest.skip(f"{package} is not installed, or lacks {file}")
    name, files, stated = files_from_path(path)
    result = check_object(files, name, **{**stated, **options})
    assert told in f"{result['verdict']}: {result['message'].removeprefix(f'{name}: ')}"
