"""Replay exported grasps in MuJoCo and validate them; needs mujoco and numpy, but not graspd.

    python replay.py scene.xml                 every grasp, one line each
    python replay.py scene.xml --view [NAME]   watch one grasp
    python replay.py scene.xml --json          results as JSON

Each grasp has six key frames in the scene: standoff, arrival, pregrasp, grasp, squeeze, lift. The hand must not touch
anything during its approach, and closes in 0.8 s. With gravity it then rises within 0.4 s and holds for 2 s. Without
gravity the object is pushed in six directions for 2 s each; the force [N] is ten times the object's mass [kg]. The
object may end up to 5 cm and 15 degrees from its goal. Without --full a test ends early if the object, at its present
velocities, would stay within half of these limits for the 2 s."""

import argparse
import json
import math
import time
from typing import Any

import mujoco
import numpy as np

STAGES, STAGE_S, HOLD_S, FIRST_LOOK_S, LOOK_S, SURE = 10, 0.04, 2.0, 0.08, 0.04, 0.5
MAX_MOVED_M, MAX_TURNED = 0.05, math.radians(15)
MAX_DEPTH_M, OVERHANG_M, WAY_LOOKS, CLOSING_LOOKS = 0.010, 0.002, 20, 4
NEIGHBOUR_MOVED_M = 0.02
PUSHES = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))


class Replay:
    """Simulation of a scene's grasps; `watch` is called after every step."""

    def __init__(self, path: Any, full: bool = False, watch: Any = None) -> None:
        self.model = mujoco.MjModel.from_xml_path(str(path))
        self.data = mujoco.MjData(self.model)
        self.full, self.watch = full, watch
        self.object = self.model.body("object").id
        self.at = int(self.model.jnt_qposadr[self.model.body("object").jntadr[0]])
        owner = self.model.body_rootid[self.model.geom_bodyid]
        self.of_object = owner == self.object
        self.of_hand = owner == self.model.jnt_bodyid[self.model.joint("root").id]
        self.neighbours = [
            int(self.model.jnt_qposadr[self.model.body(body).jntadr[0]])
            for body in range(self.model.nbody)
            if self.model.body(body).name.startswith("neighbour") and self.model.body(body).jntnum[0] == 1
        ]
        self.falls = bool(np.linalg.norm(self.model.opt.gravity) > 0)
        keys = [self.model.key(number).name for number in range(self.model.nkey)]
        self.grasps = list(dict.fromkeys(key.partition("/")[0] for key in keys))

    def key(self, grasp: str, posture: str) -> Any:
        return self.model.key(f"{grasp}/{posture}")

    def reset(self, grasp: str, posture: str) -> None:
        mujoco.mj_resetDataKeyframe(self.model, self.data, self.key(grasp, posture).id)

    def validate(self, grasp: str) -> str:
        """Return the result of a grasp: `held`, or the failure."""
        self.reset(grasp, "pregrasp")
        start = self.data.qpos[self.at : self.at + 7].copy()
        mujoco.mj_forward(self.model, self.data)
        if self.deepest_penetration() > MAX_DEPTH_M:
            return "penetration"
        if self.hand_penetrates(grasp):
            return "contact on the approach"
        self.reset(grasp, "pregrasp")
        self.move(grasp, "pregrasp", "grasp")
        self.move(grasp, "grasp", "squeeze")
        if self.falls:
            self.move(grasp, "squeeze", "lift")
            goal = start.copy()
            goal[:3] += self.key(grasp, "lift").mpos[:3] - self.key(grasp, "squeeze").mpos[:3]
            found = self.hold(goal)
            return "moved a neighbour" if found == "held" and self.moved_neighbour(grasp) else found
        size = mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_INTEGRATION)
        closed = np.empty(size)
        mujoco.mj_getState(self.model, self.data, closed, mujoco.mjtState.mjSTATE_INTEGRATION)
        for push in PUSHES:
            mujoco.mj_setState(self.model, self.data, closed, mujoco.mjtState.mjSTATE_INTEGRATION)
            force = 10 * self.model.body_mass[self.object]
            self.data.xfrc_applied[self.object, :3] = force * np.array(push)
            if (found := self.hold(start)) != "held":
                return f"{found} under a push {push}"
        return "held"

    def moved_neighbour(self, grasp: str) -> bool:
        """Check whether a neighbour moved or toppled; it may turn about the vertical."""
        up = np.array([0.0, 0.0, 1.0])
        for at in self.neighbours:
            then, now = self.key(grasp, "pregrasp").qpos[at : at + 7], self.data.qpos[at : at + 7]
            inverse, local, standing = np.empty(4), np.empty(3), np.empty(3)
            mujoco.mju_negQuat(inverse, then[3:])
            mujoco.mju_rotVecQuat(local, up, inverse)
            mujoco.mju_rotVecQuat(standing, local, now[3:])
            if np.linalg.norm(now[:3] - then[:3]) > NEIGHBOUR_MOVED_M or standing @ up < math.cos(MAX_TURNED):
                return True
        return False

    def move(self, grasp: str, a: str, b: str) -> None:
        """Command the straight path from the targets of key frame `a` to those of `b`."""
        first, last = self.key(grasp, a), self.key(grasp, b)
        for stage in range(1, STAGES + 1):
            share = stage / STAGES
            self.data.mocap_pos[0] = (1 - share) * first.mpos[:3] + share * last.mpos[:3]
            self.data.mocap_quat[0] = slerp(first.mquat[:4], last.mquat[:4], share)
            self.data.ctrl[:] = (1 - share) * first.ctrl + share * last.ctrl
            self.run(STAGE_S)

    def hold(self, goal: Any) -> str:
        """Wait for `HOLD_S` [s], or until the result is clear: `held`, `lost` or `turned`."""
        self.run(FIRST_LOOK_S - LOOK_S)
        elapsed, before = FIRST_LOOK_S - LOOK_S, self.offset(goal)
        while elapsed < HOLD_S - 1e-9:
            self.run(LOOK_S)
            elapsed += LOOK_S
            moved, turned = now = self.offset(goal)
            if not np.linalg.norm(moved) < MAX_MOVED_M:
                return "lost"
            if not turned < MAX_TURNED:
                return "turned"
            more = (HOLD_S - elapsed) / LOOK_S
            ahead = np.linalg.norm(moved + more * (moved - before[0]))
            turns = turned + more * (turned - before[1])
            if not self.full and ahead < SURE * MAX_MOVED_M and turns < SURE * MAX_TURNED:
                return "held"
            before = now
        return "held"

    def offset(self, goal: Any) -> tuple[Any, float]:
        """Return (3,) offset of the mesh frame from its goal [m], and its rotation [rad]."""
        origin = self.model.site("object_frame").pos
        now = self.data.qpos[self.at : self.at + 7]
        places = []
        for pose in (now, goal):
            place = np.empty(3)
            mujoco.mju_rotVecQuat(place, origin, pose[3:])
            places.append(pose[:3] + place)
        turn = np.empty(3)
        mujoco.mju_subQuat(turn, now[3:], goal[3:])
        return places[0] - places[1], float(np.linalg.norm(turn))

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / self.model.opt.timestep)):
            mujoco.mj_step(self.model, self.data)
            if self.watch:
                self.watch(self)

    def deepest_penetration(self) -> float:
        return max((-contact.dist for contact in self.data.contact if self.is_hand_contact(contact)), default=0.0)

    def is_hand_contact(self, contact: Any) -> bool:
        return bool(self.of_hand[contact.geom].any())

    def hand_penetrates(self, grasp: str) -> bool:
        """Check whether the open hand penetrates anything deeper than `allowed_depth` on its approach."""
        for a, b, looks in (("standoff", "arrival", WAY_LOOKS), ("arrival", "pregrasp", CLOSING_LOOKS)):
            first, last = self.key(grasp, a), self.key(grasp, b)
            for look in range(looks):
                share = look / looks
                qpos = (1 - share) * first.qpos + share * last.qpos
                root = self.model.jnt_qposadr[self.model.joint("root").id]
                turn = slice(root + 3, root + 7)
                qpos[turn] = slerp(first.qpos[turn], last.qpos[turn], share)
                self.data.qpos[:] = qpos
                mujoco.mj_kinematics(self.model, self.data)
                mujoco.mj_collision(self.model, self.data)
                if self.watch:
                    self.watch(self)
                for contact in self.data.contact:
                    ours = self.of_hand[contact.geom]
                    if ours.any() and not ours.all() and contact.dist < -self.allowed_depth(contact.geom):
                        return True
        return False

    def allowed_depth(self, pair: Any) -> float:
        """Return the allowed depth of a pair of geoms in the approach [m]; some supports allow fingertips."""
        if self.of_object[pair].any():
            return OVERHANG_M
        tips, pressing = self.model.geom_user[pair].T
        return float(pressing.max()) if tips.any() else 0.0


def slerp(a: Any, b: Any, share: float) -> Any:
    """Return the quaternion at a share of the path from a to b."""
    b = b if a @ b >= 0 else -b
    angle = math.acos(min(1.0, float(a @ b)))
    if angle < 1e-6:
        mixed = (1 - share) * a + share * b
    else:
        mixed = (math.sin((1 - share) * angle) * a + math.sin(share * angle) * b) / math.sin(angle)
    return mixed / np.linalg.norm(mixed)


def view(path: str, name: str) -> None:
    """Play one grasp repeatedly in MuJoCo's window."""
    import mujoco.viewer

    replay = Replay(path, full=True)
    grasp = name or replay.grasps[0]
    with mujoco.viewer.launch_passive(replay.model, replay.data) as window:

        def watch(state: Any) -> None:
            window.sync()
            time.sleep(state.model.opt.timestep)

        replay.watch = watch
        while window.is_running():
            replay.validate(grasp)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene")
    parser.add_argument("--view", nargs="?", const="", help="watch a grasp, by default the first")
    parser.add_argument("--full", action="store_true", help="hold for the full 2 s even if the result is clear earlier")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if options.view is not None:
        view(options.scene, options.view)
        return
    replay = Replay(options.scene, options.full)
    found = {grasp: replay.validate(grasp) for grasp in replay.grasps}
    if options.json:
        print(json.dumps(found))
    else:
        print("\n".join(f"{grasp}: {what}" for grasp, what in found.items()))


if __name__ == "__main__":
    main()
