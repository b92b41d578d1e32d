"""Grasps as glTF and USD, opened by trimesh and by usd-core."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from graspd.exchange.inputs import load_case
from graspd.service.model.transforms import pose_to_matrix, quat_to_matrix
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.rendering.hands import drawn_bodies, hand_solids
from tests.exchange.robots.shards import run
from tests.exchange.robots.test_formats import export

#: Positions in float32 and poses with seven digits [m].
ROUNDING_M = 2e-6


def expected(shard: Path, row: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Vertices of the hand's bodies in the frame of the scene or the object, and the object's matrix there."""
    case = load_case(shard)
    at = np.array([0, 0, 0, 1, 0, 0, 0.0]) if case.placed is None else case.placed.object_pose[case.placed.index[row]]
    grasp = case.grasps.grasp
    bodies = pose_to_matrix(at) @ pose_to_matrix(
        body_poses(case.hand, grasp.hand_pose[row], grasp.joint_positions[row])[0]
    )
    found = {
        case.hand.body_names[body]: trimesh.transform_points(solid.vertices, bodies[body])
        for body, solid in zip(drawn_bodies(case.hand), hand_solids(case.hand), strict=True)
    }
    return found, pose_to_matrix(at)


@pytest.mark.parametrize("which", ["free_shard", "table_shard"])
def test_trimesh_reads_a_grasp_whose_parts_stand_where_they_should(
    which: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    shard = request.getfixturevalue(which)
    told = export(shard, "glb", tmp_path)
    files = sorted(tmp_path.glob("*.glb"))
    assert len(files) == told["grasps"]
    upright = np.eye(4)
    upright[:3, :3] = quat_to_matrix(np.array([np.sqrt(0.5), -np.sqrt(0.5), 0, 0]))
    for file in files[:2]:
        scene = trimesh.load(file)
        bodies, thing = expected(shard, int(file.stem.removeprefix("grasp_")))
        case = load_case(shard)
        wanted = bodies | {case.obj.name: trimesh.transform_points(case.obj.vertices, thing)}
        assert ("support_0" in scene.graph.nodes) == (which == "table_shard")
        assert "tool_frame" in scene.graph.nodes
        for name, vertices in wanted.items():
            matrix, geometry = scene.graph[name]
            found = trimesh.transform_points(scene.geometry[geometry].vertices, matrix)
            turned = trimesh.transform_points(vertices, upright)
            np.testing.assert_allclose(found.min(axis=0), turned.min(axis=0), atol=ROUNDING_M)
            np.testing.assert_allclose(found.max(axis=0), turned.max(axis=0), atol=ROUNDING_M)


def test_usd_opens_a_grasp_in_metres_that_moves_from_the_standoff_to_the_lift(
    table_shard: Path, tmp_path: Path
) -> None:
    usd = pytest.importorskip("pxr.Usd")
    geometry = pytest.importorskip("pxr.UsdGeom")
    export(table_shard, "usd", tmp_path)
    file = sorted(tmp_path.glob("*.usd"))[0]
    stage = usd.Stage.Open(str(file))
    assert geometry.GetStageMetersPerUnit(stage) == 1.0 and geometry.GetStageUpAxis(stage) == "Z"
    assert stage.GetDefaultPrim().GetPath() == "/World"
    bodies, thing = expected(table_shard, int(file.stem.removeprefix("grasp_")))

    def vertices(path: str, time: float | None) -> np.ndarray:
        code = usd.TimeCode.Default() if time is None else usd.TimeCode(time)
        mesh = geometry.Mesh(stage.GetPrimAtPath(f"{path}/mesh"))
        matrix = np.array(geometry.Xformable(mesh).ComputeLocalToWorldTransform(code)).T
        return trimesh.transform_points(np.array(mesh.GetPointsAttr().Get()), matrix)

    for name, points in bodies.items():
        np.testing.assert_allclose(vertices(f"/World/barrett/{name}", None), points, atol=ROUNDING_M)
    end = stage.GetEndTimeCode()
    rest, lifted = vertices("/World/bottle", 0.0), vertices("/World/bottle", end)
    bottle = load_case(table_shard).obj
    np.testing.assert_allclose(rest, trimesh.transform_points(bottle.vertices, thing), atol=ROUNDING_M)
    np.testing.assert_allclose(lifted - rest, np.tile([0, 0, 0.1], (len(rest), 1)), atol=1e-5)
    palm = vertices("/World/barrett/palm", 0.0), vertices("/World/barrett/palm", None)
    assert np.linalg.norm((palm[1] - palm[0]).mean(axis=0)) >= 0.1 - 1e-3, "the standoff"
    assert stage.GetPrimAtPath("/World/scene/support_0/mesh").IsValid()


def test_without_usd_core_a_line_says_what_to_install(
    free_shard: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pxr", None)
    found = run("export", free_shard, "--format", "usd", "-o", tmp_path)
    assert found.exit_code == 2 and "pip install 'graspd[usd]'" in found.output
