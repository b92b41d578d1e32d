"""The viewer: a viser server that shows the grasps of one file, with a slider over the trajectory.
Hand, object and scene are nodes. Metres; poses x y z, w x y z."""

from __future__ import annotations

import contextlib
import io
import socket
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.errors import InputError
from graspd.service.model.scene_spec import Box, HalfSpace, SceneSpec, supports_in
from graspd.service.model.transforms import IDENTITY_POSE, Floats, quat_rotate
from graspd.service.readers.trajectories import Waypoint, point_at, scene_spec_of, stop_places, way_of, wrists_of
from graspd.service.store.shards import Shard
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.quality.probe import Probe, probe_of
from graspd.worker.rendering.hands import drawn_parts, drawn_poses, without_visuals
from graspd.worker.rendering.scenery import seen_share
from graspd.worker.scenes.neighbours import Neighbours

#: Hand points whose distance from the object is shown, and the largest distance shown [m].
POINTS: Final = 3000
NEAR_M: Final = 0.005
_OBJECT: Final = (232, 184, 120)
_NEIGHBOUR: Final = (180, 174, 191)
_TABLE: Final = (207, 212, 214)
_WALL: Final = (143, 163, 176)
_DISC_M: Final = 0.32
#: Signed distance [m] and colour: red inside, green touching, blue near; lightness varies too.
_STOPS: Final = (-0.001, -0.0002, 0.0003, 0.002, NEAR_M)
_COLOURS: Final = np.array([(209, 38, 60), (240, 128, 60), (20, 184, 122), (53, 162, 240), (185, 212, 245)], np.float64)

Supports = Sequence[HalfSpace | Box]


class Models:
    """Nodes under `/grasp` (the frame of the object at rest) and `/scene`."""

    def __init__(self, scene: Any, hand: HandModel, obj: ObjectModel, *, mounted: bool = False) -> None:
        self._scene, self._hand, self._mounted = scene, hand, mounted
        self._probe: Probe = probe_of(hand, obj, hand_points=POINTS, object_points=64)
        scene.set_up_direction("+z")
        self.rest = scene.add_frame("/grasp", show_axes=False)
        self.thing = scene.add_frame("/grasp/object", show_axes=False)
        self._mesh("/grasp/object/mesh", obj, _OBJECT)
        self.bodies = self._nodes(hand, "hand")
        # The hand's collision shapes, where its visual meshes differ from them.
        self._bare = without_visuals(hand) if hand.visuals.meshes else None
        self.collisions = self._nodes(self._bare, "collision") if self._bare else []
        self.show_collision(False)
        self.contacts: Any = None
        self._around: list[Any] = []

    def _mesh(self, path: str, solid: Any, colour: tuple[int, ...]) -> Any:
        return self._scene.add_mesh_simple(path, solid.vertices, solid.faces, color=colour, flat_shading=True)

    def _nodes(self, hand: HandModel, name: str) -> list[Any]:
        nodes = []
        for number, part in enumerate(drawn_parts(hand, mounted=self._mounted)):
            colour = tuple(round(255 * _srgb(share)) for share in part.look.base)
            nodes.append(self._mesh(f"/grasp/{name}/{number}", part.solid, colour))
        return nodes

    def show_collision(self, on: bool) -> None:
        if self.collisions:
            for nodes, shown in ((self.bodies, not on), (self.collisions, on)):
                for node in nodes:
                    node.visible = shown

    def surround(self, supports: Supports, object_pose: Floats, neighbours: Neighbours | None, number: int) -> None:
        """Rebuild the scene around an object at a pose (7,); `number` selects the scene's neighbour poses."""
        for node in self._around:
            node.remove()
        self._around = []
        _place(self.rest, object_pose)
        for k, support in enumerate(supports):
            if isinstance(support, Box):
                node = self._scene.add_box(
                    f"/scene/support{k}", color=_WALL, dimensions=support.size, opacity=0.35, cast_shadow=False
                )
                _place(node, np.asarray(support.pose, float))
            else:
                node = self._scene.add_mesh_simple(
                    f"/scene/support{k}", *_disc(support, object_pose[:3]), color=_TABLE, side="front"
                )
            self._around.append(node)
        if neighbours is not None:
            for k, other in enumerate(neighbours.objects):
                node = self._mesh(f"/scene/neighbour{k}", other, _NEIGHBOUR)
                _place(node, neighbours.poses[number, k])
                self._around.append(node)

    def show_scene(self, on: bool) -> None:
        for node in self._around:
            node.visible = on

    def pose(self, point: Waypoint, *, wrist: Floats | None = None, contacts: bool) -> Floats:
        """Show a posture with wrist angles (1, U) of a mounted hand.
        Return distances (P,) of hand points from the object [m], at most the probe's reach."""
        posture = point.hand_pose[None], point.joint_positions[None]
        for hand, nodes in ((self._hand, self.bodies), (self._bare, self.collisions)):
            if hand is not None:
                for node, pose in zip(nodes, drawn_poses(hand, *posture, wrist)[0], strict=True):
                    _place(node, pose)
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


def _place(node: Any, pose: Floats) -> None:
    node.position = pose[:3]
    node.wxyz = pose[3:] / np.linalg.norm(pose[3:])


def _disc(plane: HalfSpace, middle: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """Return a disc in the plane of a half-space around the foot of a point, visible from outside only."""
    corners, normal = 96, np.asarray(plane.normal, float)
    length = float(np.linalg.norm(normal))
    normal = normal / length
    beside = np.cross(normal, [1.0, 0, 0] if abs(normal[0]) < 0.9 else [0, 1.0, 0])
    beside /= np.linalg.norm(beside)
    foot = middle + (plane.offset / length - normal @ middle) * normal
    angle = np.linspace(0, 2 * np.pi, corners, endpoint=False)[:, None]
    ring = foot + _DISC_M * (np.cos(angle) * beside + np.sin(angle) * np.cross(normal, beside))
    turn = np.arange(corners)
    return np.concatenate([foot[None], ring]), np.stack([0 * turn, 1 + turn, 1 + (turn + 1) % corners], axis=1)


def _colours(distance: Floats) -> NDArray[np.uint8]:
    parts = [np.interp(distance, _STOPS, _COLOURS[:, k]) for k in range(3)]
    return np.stack(parts, axis=-1).astype(np.uint8)


def _srgb(linear: float) -> float:
    return 12.92 * linear if linear <= 0.0031308 else 1.055 * linear ** (1 / 2.4) - 0.055


#: Playback: seconds between two named postures, and between two frames.
STOP_S: Final = 1.2
FRAME_S: Final = 0.04
_QUOTED_M: Final = 0.005  # contact threshold at which epsilon is quoted [m]
#: Distance of the first view from the object [m], and the angle between candidate views [rad].
_EYE_M: Final = 0.7
_STEP: Final = np.pi / 8


def missing() -> str:
    """Return instructions to install the viewer; empty: nothing is missing."""
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
        """Start the server on a port (0: any free one; else the first free one from there on).
        Raises InputError: viser is not installed, the file holds no grasps, or the address cannot be used."""
        if said := missing():
            raise InputError(said)
        self._shown, self._arrays = shown, shown.shard.arrays
        self._choices = _choices(shown.shard)
        self._rows = next(iter(self._choices.values()))
        self._at, self._lock, self._ended = 0, threading.RLock(), threading.Event()
        self._playing: threading.Thread | None = None
        spec = scene_spec_of(shown.shard) or SceneSpec()
        self._supports: Supports = supports_in(spec)
        self.server = _served(host, port)
        self.models = Models(self.server.scene, shown.hand, shown.obj, mounted=self._wrist is not None)
        self._way = way_of(shown.shard, self.row)
        self._controls()
        self._load()
        self._aim()

    def __repr__(self) -> str:
        return f"<viewer at {self.url}>"

    @property
    def _wrist(self) -> Floats | None:
        return wrists_of(self._shown.shard, np.array([self.row]))

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
        self._ended.set()
        if self._playing is not None:
            self._playing.join()
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def step(self, by: int) -> None:
        """Advance by `by` grasps, cyclically."""
        with self._lock:
            self._at = (self._at + by) % len(self._rows)
            self._load()

    def choose(self, name: str) -> None:
        """Show only one kind of grasps, named in `Viewer.filters`."""
        with self._lock:
            self._rows, self._at = self._choices[name], 0
            self._load()

    @property
    def filters(self) -> tuple[str, ...]:
        """Kinds of grasps in the file."""
        return tuple(self._choices)

    def show(self) -> None:
        """Draw the posture at the slider's position."""
        with self._lock:
            place = float(self.slider.value)
            point, contacts = point_at(self._way, place), bool(self._contacts.value)
            distance = self.models.pose(point, wrist=self._wrist, contacts=contacts)
            self.models.show_scene(bool(self._scene.value))
            self.models.show_collision(bool(self._collision.value))
            touching, least = int((distance < 0.001).sum()), 1e3 * float(distance.min())
            self._said.content = f"**{_doing(self._way, place)}**: {touching} points of the hand within 1 mm, " + (
                f"deepest {-least:.2f} mm inside"
                if least < 0
                else f"nearest {least:.1f} mm away"
                if least < 10
                else "free"
            )
            self.server.flush()

    def play(self) -> None:
        """Run the slider once over the trajectory, in its own thread."""
        with self._lock:
            if self._playing is not None and self._playing.is_alive():
                return
            self._playing = threading.Thread(target=self._run, daemon=True)
            self._playing.start()

    def _run(self) -> None:
        last = float(stop_places(self._way)[-1])
        for place in np.linspace(0, last, max(2, round(last * STOP_S / FRAME_S))):
            self.slider.value = float(place)
            if self._ended.wait(FRAME_S):
                return

    def _controls(self) -> None:
        gui = self.server.gui
        gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        self._title = gui.add_markdown("")
        turn = gui.add_button_group("grasp", ("previous", "next"))
        choice = gui.add_dropdown("show", self.filters, initial_value=self.filters[0])
        places = stop_places(self._way)
        marks = tuple((float(place), point.name) for place, point in zip(places, self._way, strict=True) if point.name)
        start = next(place for place, name in marks if name == "grasp")
        self.slider = gui.add_slider("way", 0.0, float(places[-1]), 0.01, start, marks=marks)
        play = gui.add_button("play")
        self._said = gui.add_markdown("")
        self._contacts = gui.add_checkbox("contacts", True)
        self._scene = gui.add_checkbox("scene", True, visible=bool(self._supports))
        self._collision = gui.add_checkbox("collision shapes", False, visible=bool(self.models.collisions))
        self._figures = gui.add_markdown("")
        turn.on_click(lambda event: self.step(1 if event.target.value == "next" else -1))
        choice.on_update(lambda event: self.choose(str(event.target.value)))
        play.on_click(lambda _: self.play())
        for control in (self.slider, self._contacts, self._scene, self._collision):
            control.on_update(lambda _: self.show())

    def _load(self) -> None:
        shard, row = self._shown.shard, self.row
        self._way = way_of(shard, row)
        number = int(self._arrays["grasp/scene_index"][row]) if "grasp/scene_index" in self._arrays else 0
        pose = np.asarray(self._arrays["scene/object_pose"][number], float) if self._supports else IDENTITY_POSE
        self.models.surround(self._supports, pose, self._shown.neighbours, number)
        said = shard.attributes
        self._title.content = (
            f"**{said.get('hand')} × {said.get('object')}**, grasp {self._at + 1} of {len(self._rows)} (row {row})"
        )
        self._figures.content = _figures(shard, row)
        self.show()

    def _aim(self) -> None:
        """Look at the object from a side that no support hides, if possible perpendicular to the approach."""
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
        eye = next((eye for eye in eyes if seen_share(self._supports, eye, points) > 0.8), eyes[0])
        camera = self.server.initial_camera
        camera.position, camera.look_at, camera.up, camera.fov = eye, middle, (0.0, 0.0, 1.0), 0.75


def _served(host: str, port: int) -> Any:
    import viser

    try:
        if port == 0:
            with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
                probe.bind((host, 0))
                port = int(probe.getsockname()[1])
        # viser prints a greeting with the address, which graspd prints itself.
        with contextlib.redirect_stdout(io.StringIO()):
            return viser.ViserServer(host=host, port=port, label="graspd view", verbose=False)
    except OSError as error:
        raise InputError(f"cannot serve on {host}: {error.strerror or error}") from None


def _choices(shard: Shard) -> dict[str, NDArray[np.intp]]:
    found: dict[str, NDArray[np.intp]] = {}
    for name in ("valid", "lift_hard", "feasible"):
        column = shard.arrays.get(f"quality/{name}")
        if column is not None and (rows := np.flatnonzero(np.asarray(column) > 0)).size:
            found["lifts at half friction" if name == "lift_hard" else f"{name} only"] = rows
    count = len(shard["grasp/hand_pose"])
    if not count:
        raise InputError("the file holds no grasps")
    return found | {"all": np.arange(count)}


def _figures(shard: Shard, row: int) -> str:
    arrays = shard.arrays
    column = int(np.argmin(np.abs(np.asarray(arrays["quality/thresholds_m"], float) - _QUOTED_M)))
    rows = [("ε at 5 mm", f"{float(arrays['quality/epsilon'][row, column]):.3f}")]
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
        rows.append(("nearest to the scene", f"{1e3 * float(clearance[row]):.1f} mm"))
    return "\n".join(["| | |", "| --- | --- |", *(f"| {name} | {value} |" for name, value in rows)])


def _doing(way: Any, place: float) -> str:
    places = stop_places(way)
    names = [(float(at), point.name) for at, point in zip(places, way, strict=True) if point.name]
    near = next((name for at, name in names if abs(at - place) < 0.02), "")
    if near:
        return near
    after = next(k for k, (at, _) in enumerate(names) if at > place)
    return f"{names[after - 1][1]} to {names[after][1]}"
