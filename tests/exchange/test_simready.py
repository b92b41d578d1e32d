"""Grasps in the object's own USD file: lines and frames are those of the shard, physics only where absent."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from graspd import service
from graspd.service.model.transforms import apply, pose_to_matrix
from graspd.service.store.shards import read_shard
from graspd.worker.engines import backend
from graspd.worker.grasps import Posture
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path
from tests.exchange.robots.conftest import COMMON
from tests.worker.commands_run import graspd, refused

pytest.importorskip("pxr", reason="needs the extra usd")
from pxr import Sdf, Usd, UsdGeom, UsdPhysics, UsdShade

BLOCK = next(Path(service.__file__).parent.glob("builtin/objects/block/*.stl"))
#: Place of the object's default prim: turned, moved, and scaled from decimetres to the centimetres of the stage.
PLACE = np.array([[0, -10, 0, 3], [10, 0, 0, -4], [0, 0, 10, 5], [0, 0, 0, 1.0]])


def write_block(folder: Path, *, more: str = "") -> Path:
    """Write the block in two layers, in a frame that is neither metric nor at the origin."""
    mesh = trimesh.load_mesh(BLOCK)
    local = trimesh.transform_points(mesh.vertices * 100, np.linalg.inv(PLACE))
    points, extent = (
        ", ".join(f"({x:.6f}, {y:.6f}, {z:.6f})" for x, y, z in rows)
        for rows in (local, [local.min(axis=0), local.max(axis=0)])
    )
    corners = ", ".join(map(str, mesh.faces.ravel()))
    (folder / "parts").mkdir(parents=True)
    layer = Sdf.Layer.CreateAnonymous(".usda")
    layer.ImportFromString(f"""#usda 1.0
(
 defaultPrim = "Body"
)
def Mesh "Body" {{
 float3[] extent = [{extent}]
 point3f[] points = [{points}]
 int[] faceVertexCounts = [{", ".join(["3"] * len(mesh.faces))}]
 int[] faceVertexIndices = [{corners}]
 uniform token subdivisionScheme = "loop"
}}
""")
    layer.Export(str(folder / "parts" / "body.usdc"))
    rows = ", ".join(f"({', '.join(map(str, row))})" for row in PLACE.T)
    (folder / "block.usda").write_text(f"""#usda 1.0
def Xform "Block" {{
 matrix4d xformOp:transform = ( {rows} )
 uniform token[] xformOpOrder = ["xformOp:transform"]
 {more}
 def "body" (references = @./parts/body.usdc@) {{}}
}}
""")
    return folder / "block.usda"


@pytest.fixture(scope="module")
def block(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_block(tmp_path_factory.mktemp("simready") / "in")


@pytest.fixture(scope="module")
def grasps(block: Path) -> Path:
    backend.start_warp()
    graspd(f"synth --hand barrett -n 4 {COMMON} --object", block, "-o", block.parent / "g.h5")
    return block.parent / "g.h5"


@pytest.fixture(scope="module")
def written(block: Path, grasps: Path) -> Path:
    out = block.parents[1] / "out" / "deep" / "block.usd"
    told = graspd("simready --best 0 --grasps", grasps, "-o", out, block)
    assert told["grasps"] == len(read_shard(grasps, kind="base")["quality/valid"])
    return out


def lines_of(stage: Usd.Stage) -> dict[str, np.ndarray]:
    """Return the ends (2, 3) of each grasp vector in metres, by its frame's path."""
    cache, metres, found = UsdGeom.XformCache(), UsdGeom.GetStageMetersPerUnit(stage), {}
    for prim in Usd.PrimRange(stage.GetDefaultPrim()):
        if prim.GetTypeName() == "BasisCurves" and prim.GetName().startswith("grasp_identifier"):
            matrix = np.array(cache.GetLocalToWorldTransform(prim)).T
            points = np.array(UsdGeom.BasisCurves(prim).GetPointsAttr().Get(), float)
            (frame,) = prim.GetRelationship("graspd:frame").GetTargets()
            found[str(frame)] = (points @ matrix[:3, :3].T + matrix[:3, 3]) * metres
    return found


def test_frames_and_joints_are_the_stored_grasps(written: Path, grasps: Path) -> None:
    stage, shard = Usd.Stage.Open(str(written)), read_shard(grasps, kind="base")
    assert UsdGeom.GetStageMetersPerUnit(stage) == 0.01
    frames = [stage.GetPrimAtPath(path) for path in lines_of(stage)]
    assert sorted(frame.GetAttribute("graspd:row").Get() for frame in frames) == list(range(len(frames)))
    for frame in frames:
        row = frame.GetAttribute("graspd:row").Get()
        matrix = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(frame)).T
        matrix[:3, 3] *= 0.01
        np.testing.assert_allclose(matrix, pose_to_matrix(shard["grasp/hand_pose"][row]), atol=1e-6)
        for name in ("grasp", "pregrasp", "squeeze"):
            joints = frame.GetAttribute(f"graspd:{name}:jointPositions").Get()
            np.testing.assert_allclose(joints, shard[f"{name}/joint_positions"][row], atol=1e-12)
        assert tuple(frame.GetAttribute("graspd:jointNames").Get()) == tuple(shard.attributes["joint_names"])


def test_lines_cross_the_object_between_opposing_contacts(written: Path, grasps: Path) -> None:
    """Both ends are outside, the line enters the block, and the hand touches the block at both entries."""
    shard, hand, mesh = read_shard(grasps, kind="base"), hand_from_path("barrett"), trimesh.load_mesh(BLOCK)
    stage = Usd.Stage.Open(str(written))
    held = Posture.from_columns(shard.arrays)
    for path, (one, other) in lines_of(stage).items():
        row = stage.GetPrimAtPath(path).GetAttribute("graspd:row").Get()
        assert not mesh.contains([one, other]).any()
        axis = (other - one) / np.linalg.norm(other - one)
        hits = mesh.ray.intersects_location([one, other], [axis, -axis], multiple_hits=False)[0]
        assert len(hits) == 2
        bodies = body_poses(hand, held.hand_pose[row], held.joint_positions[row])[0]
        clouds = [apply(bodies[piece.body], piece.vertices) for piece in hand.pieces]
        hulls = [trimesh.PointCloud(cloud).convex_hull for cloud in clouds]
        for hit in hits:
            # Contacts of one side are averaged: their mean may lie beside the fingers, by half a finger's distance.
            assert min(hull.nearest.on_surface([hit])[1][0] for hull in hulls) < 0.02


def test_physics_and_provenance_are_added_where_absent(written: Path, grasps: Path) -> None:
    stage = Usd.Stage.Open(str(written))
    root = stage.GetDefaultPrim()
    (mesh,) = [prim for prim in Usd.PrimRange(root) if prim.IsA(UsdGeom.Mesh)]
    assert len(UsdGeom.Mesh(mesh).GetPointsAttr().Get()) == len(trimesh.load_mesh(BLOCK).vertices), "reference lost"
    assert root.HasAPI(UsdPhysics.RigidBodyAPI) and mesh.HasAPI(UsdPhysics.CollisionAPI)
    assert UsdPhysics.MassAPI(root).GetMassAttr().Get() == pytest.approx(0.1)
    material = UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial("physics")[0]
    assert UsdPhysics.MaterialAPI(material.GetPrim()).GetDynamicFrictionAttr().Get() == pytest.approx(0.6)
    (group,) = [prim for prim in root.GetChild("graspd").GetChildren() if prim.GetTypeName() == "Scope"]
    told, said = group.GetCustomDataByKey("graspd"), read_shard(grasps, kind="base").attributes
    for name in ("hand", "hand_digest", "object_digest", "verdict_level", "root_link"):
        assert told[name] == said[name]
    assert not any(str(Path.home()) in text or "/" in text for text in map(str, told.values()))


def test_stated_physics_stays(tmp_path: Path, grasps: Path) -> None:
    more = """float physics:mass = 0.7
 def Cube "hit" (prepend apiSchemas = ["PhysicsCollisionAPI", "MaterialBindingAPI"]) {
  double size = 0.1
  uniform token purpose = "guide"
  rel material:binding:physics = </Block/rubber>
 }
 def Material "rubber" (prepend apiSchemas = ["PhysicsMaterialAPI"]) {
  float physics:dynamicFriction = 0.9
 }"""
    source = write_block(tmp_path / "in", more=more)
    source.write_text(source.read_text().replace('"Block" {', '"Block" (prepend apiSchemas = ["PhysicsMassAPI"]) {'))
    graspd(f"synth --hand barrett -n 1 {COMMON} --object", source, "-o", tmp_path / "g.h5")
    told = graspd("simready --grasps", tmp_path / "g.h5", "-o", tmp_path / "out.usda", source)
    assert "notes" not in told
    stage = Usd.Stage.Open(str(tmp_path / "out.usda"))
    assert UsdPhysics.MassAPI(stage.GetDefaultPrim()).GetMassAttr().Get() == pytest.approx(0.7)
    assert [p.GetName() for p in stage.Traverse() if p.HasAPI(UsdPhysics.CollisionAPI)] == ["hit"]
    assert [p.GetName() for p in stage.Traverse() if p.HasAPI(UsdPhysics.MaterialAPI)] == ["rubber"]
    assert read_shard(tmp_path / "g.h5", kind="base").attributes["object_friction"] == pytest.approx(0.9)


def test_wrong_files_are_refused(block: Path, grasps: Path, written: Path, tmp_path: Path) -> None:
    other = write_block(tmp_path / "in", more="float graspd = 1")
    out = tmp_path / "o.usd"
    assert "made with the object of digest" in refused("simready --grasps", grasps, "-o", out, other)
    assert "is the output file" in refused("simready --grasps", grasps, "-o", block, block)
    assert "unpack a .usdz" in refused("simready --grasps", grasps, "-o", tmp_path / "o.usdz", block)
    assert not out.exists()


def test_the_validators_rules_pass(written: Path) -> None:
    """omniverse-asset-validator (PyPI), all rules that it enables."""
    validator = pytest.importorskip("omni.asset_validator", reason="omniverse-asset-validator is not installed")
    issues = validator.ValidationEngine().validate(str(written)).issues()
    assert not [str(issue) for issue in issues]
