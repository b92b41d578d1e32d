"""Replay of the validation of one stored grasp: motion of hand and object, contact forces.

`python -m graspd.worker.stages.replay STORE SHARD ROW` writes the recording as JSON; the API runs it on demand. The
simulation is that of the validator at nominal friction, so a replay ends as the verdict does. Lengths are in metres,
forces in newtons; the frame is that of the object at rest."""

import json
import sys
from dataclasses import replace
from typing import Any, Final

import mujoco
import numpy as np

from graspd.service.model.states import Stage
from graspd.service.model.transforms import IDENTITY_POSE, Floats, quat_rotate
from graspd.service.readers.trajectories import slider_positions, trajectory_of
from graspd.service.store.manifests import load_manifest, load_shard
from graspd.service.store.store import Store, open_store
from graspd.worker.grasps import GraspSet
from graspd.worker.scenes.kinds import supports_of
from graspd.worker.scenes.placement import neighbour_of
from graspd.worker.simulation.environment import Scenes
from graspd.worker.stages import assets
from graspd.worker.validation.lift import Lift
from graspd.worker.validation.model import MujocoOptions, scene_of
from graspd.worker.validation.protocol import DIRECTIONS, STAGES, Outcome, Rollout, Test

#: Time between two recorded states [s]; the validator's stages are as long.
FRAME_S: Final = 0.04
_AXES: Final = ("+x", "−x", "+y", "−y", "+z", "−z")


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
        if self._since > FRAME_S - 1e-9:
            self._since = 0.0
            self.frames.append(self._frame())

    def _frame(self) -> dict[str, Any]:
        scene, data = self.scene, self.data
        root = data.qpos[scene.root_qpos : scene.root_qpos + 7]
        body, mass = scene.object_body, data.qpos[scene.object_qpos : scene.object_qpos + 7]
        contacts = self._contacts(mass[:3])
        of_hand = contacts[:, 9] > 0
        return {
            "phase": self._phase,
            "hand_pose": root.tolist(),
            "joint_positions": data.qpos[scene.joint_qpos].tolist(),
            "object_pose": [*(mass[:3] - quat_rotate(mass[3:], scene.centre)), *mass[3:]],
            "contacts": contacts[of_hand, :9].tolist(),
            "hand_force": contacts[of_hand, 6:9].sum(axis=0).tolist(),
            "support_force": contacts[~of_hand, 6:9].sum(axis=0).tolist(),
            "load": data.xfrc_applied[body, :3].tolist(),
            "torque": contacts[:, 10:].sum(axis=0).tolist(),
        }

    def _contacts(self, centre: Floats) -> Floats:
        """Return contacts (C, 13) of the object: position, inward normal, force on it, whether of the hand, torque."""
        model, data, rows = self.scene.model, self.data, []
        for number in range(data.ncon):
            contact, wrench = data.contact[number], np.zeros(6)
            ours = model.geom_bodyid[contact.geom] == self.scene.object_body
            if not ours.any() or contact.efc_address < 0:
                continue
            mujoco.mj_contactForce(model, data, number, wrench)
            axes = (1 if ours[1] else -1) * contact.frame.reshape(3, 3)  # the normal points from geom 0 to geom 1
            force, by_hand = wrench[:3] @ axes, bool(self.scene.hand_geoms[contact.geom].any())
            torque = np.cross(contact.pos - centre, force) + wrench[3:] @ axes
            rows.append([*contact.pos, *axes[0], *force, by_hand, *torque])
        return np.array(rows, float).reshape(-1, 13)


class _LiftRecorder(_Recorder, Lift):
    """Lift that records its states."""

    def _rise(self, *grasp: Any) -> None:
        self._phase = "lifting"
        super()._rise(*grasp)

    def _hold(self, rollout: Rollout) -> Outcome:
        self._phase = "holding"
        return super()._hold(rollout)


def replay(store: Store, shard_id: str, row: int) -> dict[str, Any]:
    """Simulate the validation of a grasp; return its outcome and its trajectory from standoff or pregrasp on.
    Positions of waypoints are those of the planned trajectory; the tests after closing take the last unit."""
    manifest, shard = load_manifest(store, Stage.SYNTHESIZE, shard_id), load_shard(store, Stage.SYNTHESIZE, shard_id)
    hand, obj = assets.hand_of(store, manifest), assets.object_of(store, manifest)
    grasps = GraspSet.from_columns(shard.arrays).take(slice(row, row + 1)).moved(np.negative(obj.centre))
    published, request = manifest.request.validation == "dexgraspbench", manifest.request
    pieces = assets.load_pieces(store, obj.centred)
    test: _Recorder
    if grasps.scene is None:
        test = _Recorder(scene_of(hand, obj.centred, pieces, MujocoOptions()))
        rollout = test.dexgraspbench(grasps, 0) if published else test.standard(grasps, 0)
        bad = [k for k in range(len(DIRECTIONS)) if rollout.outcomes[k] not in (Outcome.HELD, Outcome.NOT_TRIED)]
        outcome = rollout.outcomes[bad[0]] if bad else Outcome.HELD
    else:
        scenes = Scenes(supports_of(request.scene_spec), np.asarray(shard["scene/object_pose"], float))
        if others := assets.neighbours_of(store, manifest):
            beside = tuple(neighbour_of(other) for other in others)
            scenes = replace(scenes, neighbours=beside, neighbour_pose=np.asarray(shard["scene/neighbour_pose"]))
        placed = scenes.centred(obj).placed(grasps.scene)
        physics = scene_of(hand, obj.centred, pieces, MujocoOptions(), placed.supports, placed.neighbours)
        test = lift = _LiftRecorder(physics, placed)
        outcome = (lift.dexgraspbench(grasps, 0) if published else lift.lift(grasps, 0)).outcome
    way = trajectory_of(shard, row)
    places = slider_positions(way).tolist()
    start = [point.name for point in way].index("pregrasp")
    found = [
        {
            "name": point.name,
            "place": place,
            "phase": "approach",
            "hand_pose": point.hand_pose.tolist(),
            "joint_positions": point.joint_positions.tolist(),
            "object_pose": IDENTITY_POSE.tolist(),
        }
        for point, place in zip(way[: start + 1], places, strict=False)
    ]
    later = len(test.frames) - 2 * STAGES
    for number, frame in enumerate(test.frames, 1):
        share = number / STAGES if number <= 2 * STAGES else 2 + (number - 2 * STAGES) / later
        name = {1.0: "grasp", 2.0: "squeeze", 3.0: "lift" if grasps.scene is not None else "pushes"}.get(share, "")
        found.append({"name": name, "place": places[start] + share, **_moved(frame, np.array(obj.centre))})
    return {"outcome": outcome.name.lower().replace("_", " "), "way": found}


def _moved(frame: dict[str, Any], centre: Floats) -> dict[str, Any]:
    """Return a state in the frame of the mesh; simulations have their origin at the mesh's `centre` (3,)."""
    hand, thing = np.array(frame["hand_pose"]), np.array(frame["object_pose"])
    hand[:3] += centre
    thing[:3] += centre - quat_rotate(thing[3:], centre)
    contacts = [[*(np.array(one[:3]) + centre), *one[3:]] for one in frame["contacts"]]
    return frame | {"hand_pose": hand.tolist(), "object_pose": thing.tolist(), "contacts": contacts}


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _rounded(part) for key, part in value.items()}
    if isinstance(value, list):
        return [_rounded(part) for part in value]
    return round(float(value), 6) if isinstance(value, float) else value


if __name__ == "__main__":
    sys.stdout.write(json.dumps(_rounded(replay(open_store(sys.argv[1], make=False), sys.argv[2], int(sys.argv[3])))))
