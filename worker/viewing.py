"""Viewer: a viser server that shows the grasps of one file, with a slider over the trajectory.
Hand, object and scene are nodes. Lengths are in metres; poses are x y z, then quaternion w x y z."""

import contextlib
import io
import socket
import threading
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.errors import InputError
from graspd.service.model.scene_spec import Box, SceneSpec, scene_supports
from graspd.service.model.transforms import IDENTITY_POSE, Floats, quat_rotate
from graspd.service.readers import trajectories
from graspd.service.store.shards import Shard
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.formats.glb import from_linear
from graspd.worker.objects.model import ObjectModel
from graspd.worker.quality.probe import Probe, probe_of
from graspd.worker.rendering.hands import drawn_parts, drawn_poses
from graspd.worker.rendering.scenery import Supports, slab_poses, slabs, visible_share
from graspd.worker.rendering.sheets import metric_at_threshold
from graspd.worker.scenes.neighbours import Neighbours

#: Hand points whose distance from the object is shown, and the largest distance shown [m].
POINTS: Final = 3000
NEAR_M: Final = 0.005
_OBJECT: Final = (232, 184, 120)
_NEIGHBOUR: Final = (180, 174, 191)
_TABLE: Final = (207, 212, 214)
_WALL: Final = (143, 163, 176)
#: Signed distance [m] and colour: red inside, green touching, blue near, with different lightness.
_STOPS: Final = (-0.001, -0.0002, 0.0003, 0.002, NEAR_M)
_COLOURS: Final = np.array([(209, 38, 60), (240, 128, 60), (20, 184, 122), (53, 162, 240), (185, 212, 245)], np.float64)


class Models:
    """Nodes under `/grasp` (the frame of the object at rest) and `/scene`."""

    def __init__(self, scene: Any, hand: HandModel, obj: ObjectModel, *, mounted: bool = False) -> None:
        self._scene, self._hand = scene, hand
        self._probe: Probe = probe_of(hand, obj, hand_points=POINTS, object_points=64)
        scene.set_up_direction("+z")
        self.rest = scene.add_frame("/grasp", show_axes=False)
        self.thing = scene.add_frame("/grasp/object", show_axes=False)
        self._mesh("/grasp/object/mesh", obj, _OBJECT)
        self.bodies: list[Any] = []
        for number, part in enumerate(drawn_parts(hand, mounted=mounted)):
            colour = tuple(np.rint(255 * from_linear(np.array(part.look.base))).astype(int).tolist())
            self.bodies.append(self._mesh(f"/grasp/hand/{number}", part.solid, colour))
        self.contacts: Any = None
        self._around: list[Any] = []

    def _mesh(self, path: str, solid: Any, colour: tuple[int, ...]) -> Any:
        return self._scene.add_mesh_simple(path, solid.vertices, solid.faces, color=colour, flat_shading=True)

    def show_surroundings(
        self, supports: Supports, object_pose: Floats, neighbours: Neighbours | None, number: int
    ) -> None:
        """Rebuild the scene around an object at a pose (7,); `number` selects the scene's neighbour poses."""
        for node in self._around:
            node.remove()
        self._around = []
        _set_pose(self.rest, object_pose)
        poses = slab_poses(supports, object_pose[:3], 0.0)
        for k, (support, slab, pose) in enumerate(zip(supports, slabs(supports), poses, strict=True)):
            look = {"color": _WALL, "opacity": 0.35} if isinstance(support, Box) else {"color": _TABLE}
            node = self._scene.add_box(f"/scene/support{k}", dimensions=slab.size, cast_shadow=False, **look)
            _set_pose(node, pose)
            self._around.append(node)
        if neighbours is not None:
            for k, other in enumerate(neighbours.objects):
                node = self._mesh(f"/scene/neighbour{k}", other, _NEIGHBOUR)
                _set_pose(node, neighbours.poses[number, k])
                self._around.append(node)

    def show_scene(self, on: bool) -> None:
        for node in self._around:
            node.visible = on

    def pose(self, point: trajectories.Waypoint, *, wrist: Floats | None = None, contacts: bool) -> Floats:
        """Show a posture with wrist angles (1, U) of a mounted hand.
        Return distances (P,) of hand points from the object [m], at most the probe's reach."""
        posture = point.hand_pose[None], point.joint_positions[None]
        for node, pose in zip(self.bodies, drawn_poses(self._hand, *posture, wrist)[0], strict=True):
            _set_pose(node, pose)
        self.thing.position = point.carried
        # The probe's object stays at its rest pose.
        points = self._probe.posed_points(body_poses(self._hand, *posture))[0] - point.carried
        distance = np.asarray(self._probe.signed_distance(points)[0])
        near = distance < NEAR_M
        if self.contacts is not None:
            self.contacts.remove()
        shown = near & contacts
        self.contacts = self._scene.add_point_cloud(
            "/grasp/object/contacts",
            points[shown].astype(np.float32),
            _colours(distance[shown]),
            point_size=0.0022,
            point_shape="circle",
            precision="float32",
        )
        return distance


def _set_pose(node: Any, pose: Floats) -> None:
    node.position = pose[:3]
    node.wxyz = pose[3:] / np.linalg.norm(pose[3:])


def _colours(distance: Floats) -> NDArray[np.uint8]:
    parts = [np.interp(distance, _STOPS, _COLOURS[:, k]) for k in range(3)]
    return np.stack(parts, axis=-1).astype(np.uint8)


#: Distance of the first view from the object [m], and the angle between candidate views [rad].
_EYE_M: Final = 0.7
_STEP: Final = np.pi / 8


def missing_viewer_text() -> str:
    """Return instructions to install the viewer; empty if nothing is missing."""
    try:
        import viser  # noqa: F401
    except ImportError:
        return "graspd view needs viser, which is not part of this install; run pip install 'graspd[view]'"
    return ""


@dataclass(frozen=True)
class ViewerContent:
    """A base shard with its hand, object and neighbours."""

    shard: Shard
    hand: HandModel
    obj: ObjectModel
    neighbours: Neighbours | None = None


class Viewer:
    """Server of one file until it is closed. `url` is its address; `row` is the grasp shown."""

    def __init__(self, shown: ViewerContent, *, host: str = "127.0.0.1", port: int = 8080) -> None:
        """Start the server on the first free port from number `port` on; 0 takes any free port.
        Raises InputError: the file holds no grasps, or the address cannot be used."""
        self._shown, self._arrays = shown, shown.shard.arrays
        found: dict[str, NDArray[np.intp]] = {}
        for name in ("valid", "lift_hard", "feasible"):
            column = shown.shard.arrays.get(f"quality/{name}")
            if column is not None and (rows := np.flatnonzero(np.asarray(column) > 0)).size:
                found["lifts at half friction" if name == "lift_hard" else f"{name} only"] = rows
        count = len(shown.shard["grasp/hand_pose"])
        if not count:
            raise InputError("the file holds no grasps")
        self._choices = found | {"all": np.arange(count)}
        self._rows = next(iter(self._choices.values()))
        self._at, self._lock = 0, threading.RLock()
        spec = trajectories.scene_spec_of(shown.shard) or SceneSpec()
        self._supports: Supports = scene_supports(spec)
        self.server = _start_server(host, port)
        self.models = Models(self.server.scene, shown.hand, shown.obj, mounted=self._wrist is not None)
        self._way = trajectories.trajectory_of(shown.shard, self.row)
        self._controls()
        self._load_grasp()
        pose = np.concatenate([self.models.rest.position, self.models.rest.wxyz])
        points = quat_rotate(pose[3:], self._shown.obj.hull_vertices) + pose[:3]
        middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
        palm = quat_rotate(pose[3:], quat_rotate(self._way[-1].hand_pose[3:], self._shown.hand.palm.approach))
        first = float(np.arctan2(palm[1], palm[0]) + 0.5 * np.pi)
        eyes = [
            middle + _EYE_M * np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
            for e in (0.45, 0.8)
            for a in (first + _STEP * ((k + 1) // 2) * (-1) ** k for k in range(16))
        ]
        eye = next((eye for eye in eyes if visible_share(self._supports, eye, points) > 0.8), eyes[0])
        camera = self.server.initial_camera
        camera.position, camera.look_at, camera.up, camera.fov = eye, middle, (0.0, 0.0, 1.0), 0.75

    def __repr__(self) -> str:
        return f"<viewer at {self.url}>"

    @property
    def _wrist(self) -> Floats | None:
        return trajectories.wrist_angles(self._shown.shard, np.array([self.row]))

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    @property
    def row(self) -> int:
        """Row of the shown grasp."""
        return int(self._rows[self._at])

    def close(self) -> None:
        """Stop the server."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def step(self, by: int) -> None:
        """Advance by `by` grasps, cyclically."""
        with self._lock:
            self._at = (self._at + by) % len(self._rows)
            self._load_grasp()

    def choose(self, name: str) -> None:
        """Show only one kind of grasps, named in `Viewer.filters`."""
        with self._lock:
            self._rows, self._at = self._choices[name], 0
            self._load_grasp()

    @property
    def filters(self) -> tuple[str, ...]:
        """Kinds of grasps in the file."""
        return tuple(self._choices)

    def show(self) -> None:
        """Draw the posture at the slider's position."""
        with self._lock:
            place = float(self.slider.value)
            point, contacts = trajectories.waypoint_at(self._way, place), bool(self._contacts.value)
            distance = self.models.pose(point, wrist=self._wrist, contacts=contacts)
            self.models.show_scene(bool(self._scene.value))
            touching, least = int((distance < 0.001).sum()), 1e3 * float(distance.min())
            self._said.content = (
                f"**{_motion_label(self._way, place)}**: {touching} points of the hand within 1 mm, "
                + (
                    f"deepest {-least:.2f} mm inside"
                    if least < 0
                    else f"nearest {least:.1f} mm away"
                    if least < 10
                    else "free"
                )
            )
            self.server.flush()

    def _controls(self) -> None:
        gui = self.server.gui
        gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        self._title = gui.add_markdown("")
        turn = gui.add_button_group("grasp", ("previous", "next"))
        choice = gui.add_dropdown("show", self.filters, initial_value=self.filters[0])
        places = trajectories.slider_positions(self._way)
        marks = tuple((float(place), point.name) for place, point in zip(places, self._way, strict=True) if point.name)
        start = next(place for place, name in marks if name == "grasp")
        self.slider = gui.add_slider("trajectory", 0.0, float(places[-1]), 0.01, start, marks=marks)
        self._said = gui.add_markdown("")
        self._contacts = gui.add_checkbox("contacts", True)
        self._scene = gui.add_checkbox("scene", True, visible=bool(self._supports))
        self._figures = gui.add_markdown("")
        turn.on_click(lambda event: self.step(1 if event.target.value == "next" else -1))
        choice.on_update(lambda event: self.choose(str(event.target.value)))
        for control in (self.slider, self._contacts, self._scene):
            control.on_update(lambda _: self.show())

    def _load_grasp(self) -> None:
        shard, row = self._shown.shard, self.row
        self._way = trajectories.trajectory_of(shard, row)
        number = int(self._arrays["grasp/scene_index"][row]) if "grasp/scene_index" in self._arrays else 0
        pose = np.asarray(self._arrays["scene/object_pose"][number], float) if self._supports else IDENTITY_POSE
        self.models.show_surroundings(self._supports, pose, self._shown.neighbours, number)
        said = shard.attributes
        self._title.content = (
            f"**{said.get('hand')} × {said.get('object')}**, grasp {self._at + 1} of {len(self._rows)} (row {row})"
        )
        self._figures.content = _metrics_text(shard, row)
        self.show()


def _start_server(host: str, port: int) -> Any:
    import viser

    try:
        if port == 0:
            with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
                probe.bind((host, 0))
                port = int(probe.getsockname()[1])
        # viser's greeting is suppressed: graspd prints the address itself.
        with contextlib.redirect_stdout(io.StringIO()):
            return viser.ViserServer(host=host, port=port, label="graspd view", verbose=False)
    except OSError as error:
        raise InputError(f"cannot serve on {host}: {error.strerror or error}") from None


def _metrics_text(shard: Shard, row: int) -> str:
    arrays = shard.arrays
    rows = [("ε at 5 mm", f"{metric_at_threshold(arrays, 'quality/epsilon')[row]:.3f}")]
    rows.append(("penetration", f"{float(arrays['quality/penetration_depth_mm'][row]):.2f} mm"))
    verdicts = {
        "success": "lift" if "quality/lift_outcome" in arrays else "verdict",
        "lift_hard": "lift at half friction",
        "pushes": "six pushes",
    }
    for name, words in verdicts.items():
        if (known := arrays.get(f"quality/{name}")) is not None and known[row] >= 0:
            rows.append((words, "holds" if known[row] else "fails"))
    if (payload := arrays.get("quality/payload_kg")) is not None and np.isfinite(payload[row]):
        rows.append(("payload", f"{float(payload[row]):.2f} kg"))
    if (shaken := arrays.get("quality/shake_margin")) is not None and np.isfinite(shaken[row]):
        rows.append(("shaken", "holds" if shaken[row] < 1 else "fails"))
    if (clearance := arrays.get("quality/clearance_m")) is not None:
        rows.append(("clearance", f"{1e3 * float(clearance[row]):.1f} mm"))
    return "\n".join(["| | |", "| --- | --- |", *(f"| {name} | {value} |" for name, value in rows)])


def _motion_label(way: Any, place: float) -> str:
    places = trajectories.slider_positions(way)
    names = [(float(at), point.name) for at, point in zip(places, way, strict=True) if point.name]
    near = next((name for at, name in names if abs(at - place) < 0.02), "")
    if near:
        return near
    after = next(k for k, (at, _) in enumerate(names) if at > place)
    return f"{names[after - 1][1]} to {names[after][1]}"
