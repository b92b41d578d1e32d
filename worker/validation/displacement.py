"""Simulated displacement of an object in a rigid hand during 0.15 s of gravity (Hasson et al. 2019).

The hand is fixed in its grasp posture. The object has mass 1 kg and friction coefficient 3. Gravity acts along -z of
its frame for 35 steps of 1/240 s. In free fall it would move by 10.7 cm. The protocol was made for PyBullet with a
restitution of 0.5; MuJoCo has no restitution."""

import math
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final

import mujoco
import numpy as np

from graspd.service.model.transforms import Floats
from graspd.worker.engines.mujoco_warnings import is_invalid
from graspd.worker.execution_context import DEFAULT_CONTEXT, ExecutionContext
from graspd.worker.grasps import Posture
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.memory_cache import cached_by_content
from graspd.worker.objects.model import ObjectModel
from graspd.worker.validation.decomposition import ConvexPieces, decompose
from graspd.worker.validation.model import add_object, add_shape, empty_spec

MASS: Final = 1.0
FRICTION: Final = 3.0
GRAVITY: Final = 9.8
TIMESTEP_S: Final = 1 / 240
STEPS: Final = 35


def simulated_displacement_cm(
    hand: HandModel,
    obj: ObjectModel,
    grasp: Posture,
    *,
    pieces: ConvexPieces | None = None,
    run: ExecutionContext = DEFAULT_CONTEXT,
) -> Floats:
    """Return displacements (N,) of the centre of mass for N postures [cm]; nan if the simulation diverged."""
    model = _model(hand, obj, pieces or decompose(obj))
    bodies = body_poses(hand, grasp.hand_pose, grasp.joint_positions)
    centre = obj.centre_of_mass

    def work(poses: Floats) -> float:
        data = mujoco.MjData(model)
        data.mocap_pos[:] = poses[:, :3]
        data.mocap_quat[:] = poses[:, 3:]
        mujoco.mj_step(model, data, nstep=STEPS)
        return math.nan if is_invalid(data) else float(np.linalg.norm(data.qpos[:3] - centre))

    with ThreadPoolExecutor(run.cores, thread_name_prefix="displacement") as pool:
        return 100.0 * np.array(list(pool.map(work, bodies)), float)


@cached_by_content(8)
def _model(hand: HandModel, obj: ObjectModel, pieces: ConvexPieces) -> Any:
    spec = empty_spec(TIMESTEP_S)
    spec.option.gravity = [0, 0, -GRAVITY]
    friction = [FRICTION, 0.005, 1e-4]
    for b in range(hand.bodies):
        # Mocap bodies move only by command, so one model serves all grasps.
        body = spec.worldbody.add_body(name=f"body{b}", mocap=True)
        for i, piece in enumerate(hand.pieces):
            if piece.body == b:
                add_shape(spec, body.add_geom(friction=friction, name=f"hand{i}"), piece, f"hand{i}")
    add_object(spec, obj, pieces.vertices, friction, MASS)
    return spec.compile()
