"""Replay of the validation of one stored grasp: motion of hand and object, contact forces [m, N, N m].

`python -m graspd.worker.stages.replay STORE SHARD ROW` writes it as JSON; the API runs it on demand. The simulation is
that of the validator at nominal friction, in the frame of the object at rest."""

import json
import sys
from typing import Any, Final

import mujoco
import numpy as np

from graspd.service.model.states import Stage
from graspd.service.model.transforms import IDENTITY_POSE, Floats, quat_rotate
from graspd.service.readers.trajectories import slider_positions, trajectory_of
from graspd.service.store.manifests import load_manifest, load_shard
from graspd.service.store.store import Store, open_store
from graspd.worker.grasps import GraspSet
from graspd.worker.stages import assets
from graspd.worker.validation.lift import Lift, LiftOutcome
from graspd.worker.validation.model import MujocoOptions, scene_of
from graspd.worker.validation.protocol import STAGES, Outcome, Rollout, Test

#: Time between two recorded states [s]; stages of closing are as long.
FRAME_S: Final = 0.04
_AXES: Final = ("+x", "-x", "+y", "-y", "+z", "-z")


class _Recorder(Test):
    """Test that records its states."""

    def __init__(self, *scene: Any) -> None:
        super().__init__(*scene)
        self.frames: list[dict[str, Any]] = []
        self._phase, self._since = "closing", 0.0

    def _push(self, direction: int) -> None:
        super()._push(direction)
        self._phase = f"pushed along {_AXES[direction]}"

    def _run(self, seconds: float) -> None:
        super()._run(seconds)
        self._since += seconds
        if self._since < FRAME_S - 1e-9:
            return
        self._since, scene, q = 0.0, self.scene, self.data.qpos
        centre = q[scene.object_qpos : scene.object_qpos + 7]
        self.frames.append(
            {
                "phase": self._phase,
                "hand_pose": q[scene.root_qpos : scene.root_qpos + 7].tolist(),
                "joint_positions": q[scene.joint_qpos].tolist(),
                "object_pose": [*(centre[:3] - quat_rotate(centre[3:], scene.centre)).tolist(), *centre[3:].tolist()],
                "contacts": self._contacts(centre[:3]),
                "load": self.data.xfrc_applied[scene.object_body, :3].tolist(),
            }
        )

    def _contacts(self, centre: Floats) -> list[list[float]]:
        """Return position, inward normal, force, torque about `centre`, and 1 if of the hand, of each contact."""
        model, rows, wrench = self.scene.model, [], np.zeros(6)
        for number, contact in enumerate(self.data.contact):
            ours = model.geom_bodyid[contact.geom] == self.scene.object_body
            if ours.any() and contact.efc_address >= 0:
                mujoco.mj_contactForce(model, self.data, number, wrench)
                axes = (1 if ours[1] else -1) * contact.frame.reshape(3, 3)  # the normal points from geom 0 to geom 1
                force = wrench[:3] @ axes
                torque = np.cross(contact.pos - centre, force) + wrench[3:] @ axes
                by_hand = float(self.scene.hand_geoms[contact.geom].any())
                rows.append([*np.concatenate([contact.pos, axes[0], force, torque]).tolist(), by_hand])
        return rows


class _LiftRecorder(_Recorder, Lift):
    """Lift that records its states."""

    def _rise(self, *grasp: Any) -> None:
        self._phase = "lifting"
        super()._rise(*grasp)

    def _hold(self, rollout: Rollout) -> Outcome:
        self._phase = "holding"
        return super()._hold(rollout)


def replay(store: Store, shard_id: str, row: int) -> dict[str, Any]:
    """Simulate the validation of a grasp; return its outcome and trajectory from standoff or pregrasp on.
    A point's `place` is that on the planned trajectory; all that follows the squeeze takes one unit."""
    manifest, shard = load_manifest(store, Stage.SYNTHESIZE, shard_id), load_shard(store, Stage.SYNTHESIZE, shard_id)
    hand, obj = assets.hand_of(store, manifest), assets.object_of(store, manifest)
    grasps = GraspSet.from_columns(shard.arrays).take(slice(row, row + 1))
    pieces, published = assets.load_pieces(store, obj), manifest.request.validation == "dexgraspbench"
    test: _Recorder
    outcome: Outcome | LiftOutcome
    if grasps.scene is None:
        test = _Recorder(scene_of(hand, obj, pieces, MujocoOptions()))
        rollout = test.dexgraspbench(grasps, 0) if published else test.standard(grasps, 0)
        outcome = next((one for one in rollout.outcomes if one > Outcome.HELD), Outcome.HELD)
    else:
        placed = assets.scenes_of(store, manifest, shard.arrays).placed(grasps.scene)
        test = lift = _LiftRecorder(
            scene_of(hand, obj, pieces, MujocoOptions(), placed.supports, placed.neighbours), placed
        )
        outcome = (lift.dexgraspbench(grasps, 0) if published else lift.lift(grasps, 0)).outcome
    way, found = trajectory_of(shard, row), []
    start = [point.name for point in way].index("pregrasp")
    for point, place in zip(way[: start + 1], slider_positions(way).tolist(), strict=False):
        posture = {"hand_pose": point.hand_pose.tolist(), "joint_positions": point.joint_positions.tolist()}
        at = {"name": point.name, "place": place, "phase": "approach", "object_pose": IDENTITY_POSE.tolist()}
        found.append(at | posture)
    names = {1.0: "grasp", 2.0: "squeeze", 3.0: "pushes" if grasps.scene is None else "lift"}
    tests = max(1, len(test.frames) - 2 * STAGES)
    for number, frame in enumerate(test.frames, 1):
        after = number / STAGES if number <= 2 * STAGES else 2 + (number - 2 * STAGES) / tests
        found.append({"name": names.get(after, ""), "place": found[start]["place"] + after, **frame})
    return {"outcome": outcome.name.lower().replace("_", " "), "way": found}


if __name__ == "__main__":
    made = replay(open_store(sys.argv[1], make=False), sys.argv[2], int(sys.argv[3]))
    # Six digits: micrometres.
    sys.stdout.write(json.dumps(json.loads(json.dumps(made), parse_float=lambda number: round(float(number), 6))))
