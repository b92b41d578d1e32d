"""USD articulations as hands: joint frames, units, drives, colliders; refusals; a hand that another tool converted."""

import math
from pathlib import Path

import numpy as np
import pytest

from graspd.service.model.transforms import pose_to_matrix, quat_from_axis_angle
from graspd.worker.hands.check import check_hand
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import HandSource, hand_from_path, load_hand
from graspd.worker.hands.model import HandModel
from tests.worker.objects.test_usd import stage

pytest.importorskip("pxr", reason="needs the extra usd")

#: Converted from the built-in hand by urdf-usd-converter 0.3.4 (NVIDIA), and flattened to one layer.
BARRETT = Path(__file__).with_name("barrett.usdc")

BODY = 'prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"]'
SOLID = 'prepend apiSchemas = ["PhysicsCollisionAPI"]'


def body(name: str, at: tuple[float, ...], inner: str, *, scale: float = 1.0, mass: float = 0.0) -> str:
    return f"""def Xform "{name}" ({BODY}) {{
 float physics:mass = {mass}
 double3 xformOp:translate = {at}
 float3 xformOp:scale = ({scale}, {scale}, {scale})
 uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]
 {inner} }}
"""


def cube(name: str, half: tuple[float, ...], more: str = "", apis: str = SOLID) -> str:
    return f"""def Cube "{name}" ({apis}) {{
 double size = 2
 float3 xformOp:scale = {half}
 uniform token[] xformOpOrder = ["xformOp:scale"]
 {more} }}
"""


def joint(kind: str, name: str, ends: tuple[str, str], more: str, apis: str = "") -> str:
    return f"""def Physics{kind}Joint "{name}" ({f"prepend apiSchemas = [{apis}]" if apis else ""}) {{
 rel physics:body0 = </Thing/{ends[0]}>
 rel physics:body1 = </Thing/{ends[1]}>
 {more} }}
"""


SLIDE = """uniform token physics:axis = "Y"
 float physics:lowerLimit = 0
 float physics:upperLimit = 4
 point3f physics:localPos0 = (0, {side}, 6)
 float drive:linear:physics:stiffness = 300
 float drive:linear:physics:maxForce = 20"""
HINGE = """uniform token physics:axis = "X"
 float physics:lowerLimit = -30
 float physics:upperLimit = 90
 point3f physics:localPos0 = (1, 0, 2)
 point3f physics:localPos1 = (0.5, 0.25, -2)
 quatf physics:localRot0 = (0.8, 0.6, 0, 0)
 quatf physics:localRot1 = (0.6, 0, 0.8, 0)
 float drive:angular:physics:stiffness = 2
 float drive:angular:physics:maxForce = 5000"""
DRIVEN = ('"PhysicsDriveAPI:linear"', '"PhysicsDriveAPI:angular"')
#: A gripper in centimetres: two sliding fingers, the second one reversed and scaled, and a hinged tip on the first.
PARTS = {
    "palm": body("palm", (0, 0, 0), cube("box", (2, 6, 1)), mass=0.5),
    "left": body("left", (0, 5, 6), cube("box", (1, 0.5, 3)), mass=0.1),
    "right": body("right", (0, -5, 6), cube("box", (0.5, 0.25, 1.5)), scale=2.0),
    "tip": body("tip", (1, 5, 10), cube("box", (0.4, 0.4, 2))),
    "nail": body("nail", (1, 5, 12), cube("box", (0.2, 0.2, 0.5))),
    "root": joint("Fixed", "root", ("nothing", "palm"), ""),
    "slide": joint("Prismatic", "slide", ("palm", "left"), SLIDE.format(side=5), DRIVEN[0]),
    "mate": joint(
        "Prismatic",
        "mate",
        ("right", "palm"),
        """uniform token physics:axis = "Y"
 point3f physics:localPos1 = (0, -5, 6)
 float physics:lowerLimit = 0
 float physics:upperLimit = 4
 rel newton:mimicJoint = </Thing/slide>
 float newton:mimicCoef1 = 1""",
    ),
    "bend": joint("Revolute", "bend", ("left", "tip"), HINGE, DRIVEN[1]),
    "glue": joint("Fixed", "glue", ("tip", "nail"), "point3f physics:localPos0 = (0, 0, 2)"),
}


def files(more: str = "", unit: float = 0.01, **changed: str) -> dict[str, bytes]:
    prims = "".join((PARTS | changed).values()) + more
    return {"claw.usda": stage(f'def Xform "Thing" {{ {prims} }}', unit=unit)}


def claw(**changed: str) -> HandModel:
    return load_hand(files(**changed), name="claw", digest="")


def test_units_limits_drives_and_masses_are_si() -> None:
    hand = claw()
    assert hand.dof_names == ("slide", "bend")
    assert hand.joint_names == ("slide", "mate", "bend")
    assert np.allclose(hand.lower, [0, -math.pi / 6])
    assert np.allclose(hand.upper, [0.04, math.pi / 2])
    # kg cm/s^2 and kg cm^2/s^2 (per degree): 1e-2 N and 1e-4 N m.
    assert np.allclose(hand.effort, [0.2, 0.5])
    assert np.allclose(hand.stiffness, [300, 2e-4 * 180 / math.pi])
    assert hand.root_link == "palm"
    assert {"palm", "left", "right", "tip", "nail"} <= hand.frames.keys()
    assert hand.masses[0] == pytest.approx(0.5)
    left, right = (hand.body_names.index(name) for name in ("left", "right"))
    assert hand.masses[left] == pytest.approx(0.1)
    # A box without a stated mass has water's density: 2 x 1 x 6 cm after the scale of its body.
    assert hand.masses[right] == pytest.approx(2e-2 * 1e-2 * 6e-2 * 1000)
    sizes = {piece.link: piece.size for piece in hand.pieces}
    assert np.allclose(sizes["right"], [0.02, 0.01, 0.06])
    assert np.allclose(sizes["nail"], [0.004, 0.004, 0.01])


def test_joint_frames_of_both_bodies_meet_at_every_joint_value() -> None:
    """A joint of USD demands T0 L0 J(q) = T1 L1; numbers of the file are used directly, poses come from the model."""
    hand = claw()
    rng = np.random.default_rng(1)
    values = rng.uniform(hand.lower, hand.upper, (5, 2))
    pose = np.tile([0.0, 0, 0, 1, 0, 0, 0], (5, 1))
    bodies = body_poses(hand, pose, np.stack([values[:, 0], values[:, 0], values[:, 1]], axis=1))

    def link(name: str) -> np.ndarray:
        body, offset = hand.frames[name]
        return np.array([pose_to_matrix(one) @ pose_to_matrix(offset) for one in bodies[:, body]])

    def frame(position: tuple[float, ...], turn: tuple[float, ...] = (1, 0, 0, 0)) -> np.ndarray:
        return pose_to_matrix(np.array([*np.multiply(position, 0.01), *turn]))

    def motion(axis: int, slide: float = 0.0, angle: float = 0.0) -> np.ndarray:
        unit = np.eye(3)[axis]
        return pose_to_matrix(np.array([*(slide * unit), *quat_from_axis_angle(unit, np.array(angle))]))

    for k in range(5):
        slide, bend = values[k]
        pairs = (
            (link("palm")[k] @ frame((0, 5, 6)) @ motion(1, slide=slide), link("left")[k]),
            # From the palm to the right finger, the joint of the file points the other way.
            (link("right")[k] @ motion(1, slide=slide), link("palm")[k] @ frame((0, -5, 6))),
            (
                link("left")[k] @ frame((1, 0, 2), (0.8, 0.6, 0, 0)) @ motion(0, angle=bend),
                link("tip")[k] @ frame((0.5, 0.25, -2), (0.6, 0, 0.8, 0)),
            ),
            (link("tip")[k] @ frame((0, 0, 2)), link("nail")[k]),
        )
        for one, other in pairs:
            np.testing.assert_allclose(one, other, atol=1e-6)  # The file's numbers have 32 bits.


def test_approximations_of_colliders() -> None:
    """A tetrahedron with corners 6 cm apart as a hull, a box and a ball; a disabled collider does not touch."""
    corners = "[(0, 0, 0), (6, 0, 0), (0, 6, 0), (0, 0, 6)]"
    faces = "int[] faceVertexCounts = [3, 3, 3, 3]\nint[] faceVertexIndices = [0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3]"
    apis = 'prepend apiSchemas = ["PhysicsCollisionAPI", "PhysicsMeshCollisionAPI"]'
    for kind, volume in (("convexHull", 36.0), ("boundingCube", 216.0), ("boundingSphere", 4 / 3 * math.pi * 27**1.5)):
        mesh = f"""def Mesh "m" ({apis}) {{
 uniform token physics:approximation = "{kind}"
 point3f[] points = {corners}
 {faces} }}"""
        off = cube("ghost", (9, 9, 9), "bool physics:collisionEnabled = 0")
        hand = claw(tip=body("tip", (1, 5, 10), f"{mesh}\n{off}"))
        (piece,) = [piece for piece in hand.pieces if piece.link == "tip"]
        density = 1000 * volume * 1e-6
        nail = 0.004 * 0.004 * 0.01 * 1000
        assert hand.masses[piece.body] == pytest.approx(density + nail, rel=1e-3)


FAN = joint("Spherical", "bend", ("left", "tip"), "")


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"bend": FAN}, "joint /Thing/bend (Spherical) has 3 degrees of freedom; use revolute joints"),
        (
            {"glue": PARTS["glue"] + joint("Fixed", "loop", ("nail", "palm"), "")},
            "closes a loop; exclude it from the articulation",
        ),
        ({"slide": ""}, "several articulations, such as that of /Thing/"),
        ({"bend": PARTS["bend"].replace("lowerLimit = -30", "lowerLimit = 95")}, "reversed or too large"),
        ({"root": "", "slide": "", "mate": "", "bend": "", "glue": ""}, "no physics joint between rigid bodies"),
        ({"unit": 1.0}, "the hand would be 13.5 m long; correct metersPerUnit"),
        ({"unit": 1e-4}, "the hand would be 0.00135 m long; correct metersPerUnit"),
    ],
)
def test_bad_hands_are_refused_in_one_line(changed: dict[str, str], message: str) -> None:
    found = check_hand(files(**changed), "claw")  # type: ignore[arg-type]
    assert found["verdict"] == "refuse"
    assert message in found["message"]
    assert "\n" not in found["message"]


def test_bodies_and_joints_beside_the_hand_are_told() -> None:
    extra = body("cup", (50, 0, 0), cube("box", (1, 1, 1)))
    closing = joint("Fixed", "loop", ("nail", "palm"), "bool physics:excludeFromArticulation = 1")
    robot = HandSource.read(files(extra + closing)).robot
    assert "1 bodies without a joint to the hand are ignored" in robot.notes
    assert "'loop' is outside the articulation and ignored" in robot.notes


def test_a_hand_converted_by_another_tool_is_the_same_hand() -> None:
    """Numbers of the layer have 32 bits, so 1e-6; palm, pre-shape and tips are guessed, as the layer lacks them."""
    ours, theirs = hand_from_path("barrett"), hand_from_path(BARRETT)
    assert (theirs.body_names, theirs.joint_names, theirs.root_link) == (ours.body_names, ours.joint_names, "palm")
    for name in ("lower", "upper", "effort", "velocity", "masses"):
        np.testing.assert_allclose(getattr(theirs, name), getattr(ours, name), atol=1e-6)
    rng = np.random.default_rng(0)
    joints = rng.uniform(-1, 1, (20, len(ours.joint_names)))
    pose = np.tile([0.0, 0, 0, 1, 0, 0, 0], (20, 1))
    poses = [pose_to_matrix(body_poses(hand, pose, joints)) for hand in (ours, theirs)]
    np.testing.assert_allclose(*poses, atol=1e-6)
    for one, other in zip(ours.pieces, theirs.pieces, strict=True):
        assert (one.kind, one.link) == (other.kind, other.link)
        np.testing.assert_allclose(np.sort(one.vertices, axis=0), np.sort(other.vertices, axis=0), atol=1e-6)
    found = check_hand({"barrett.usdc": BARRETT.read_bytes()}, "barrett")
    assert found["verdict"] == "accept"
    assert "4 degrees of freedom in 8 joints, 3 fingertips, 33 convex pieces" in found["message"]
