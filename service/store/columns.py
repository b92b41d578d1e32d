"""HDF5 schema of shards: shape, unit and meaning of datasets; type and meaning of root attributes."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal

from graspd.service.model.engines import ENGINES
from graspd.service.model.errors import InputError
from graspd.service.model.metrics import AXIS_MEANINGS, GRASP_METRICS, GraspMetric

ShardKind = Literal["base", "scene", "views", "episodes"]
#: Version of the columns of each kind. base@1 of graspd 0.2 has other names (`service.model.renamed`).
_VERSIONS: Final[dict[str, int]] = {"base": 2, "scene": 1, "views": 1, "episodes": 1}


def schema_name(kind: str) -> str:
    return f"graspd/{kind}@{_VERSIONS[kind]}"


@dataclass(frozen=True)
class Column:
    """Dataset of a shard. Equal letters in `shape` mean equal lengths in a shard; `*` is any length."""

    shape: str
    dtype: str
    units: str
    frame: str
    description: str
    optional: bool = False


_REST = "share of drops that come to rest on the same face of the convex hull"
_POSE = "position x y z [m] and unit quaternion w x y z of the hand's root link"
_NEIGHBOURS = "poses of the neighbours in each scene; names in attribute neighbours"
_HEIGHT = "height of the lowest point of hand and forearm above the table"
_STATE = "values of attribute state_names: joints of the arm or pose of the flying hand's root link, dofs of the hand"
_BOUNDS = "x_min y_min x_max y_max of the"
_REJECTIONS = "insufficient clearance: 0 none, 1 table at contact, 2 on approach, 3 neighbour at contact, 4 on approach"


def _posture_columns(prefix: str, what: str) -> dict[str, Column]:
    return {
        f"{prefix}/hand_pose": Column("N 7", "f8", "m, 1", "object", f"{what}: {_POSE}"),
        f"{prefix}/joint_positions": Column(
            "N J", "f8", "rad or m", "joint", f"{what}: all moving joints, order in attribute joint_names"
        ),
    }


def _optional_column(shape: str, dtype: str, units: str, frame: str, description: str) -> Column:
    return Column(shape, dtype, units, frame, description, optional=True)


def _flag_column(description: str, dtype: str = "i1") -> Column:
    return _optional_column("N", dtype, "bool", "none", description)


def _code_column(
    description: str, shape: str = "N", *, outcomes: Mapping[Any, str] | None = None, optional: bool = True
) -> Column:
    if outcomes:
        description += ", ".join(f"{int(code)} {meaning}" for code, meaning in outcomes.items())
    return Column(shape, "u1", "enum", "none", description, optional)


#: Meanings of the codes of a push and of a lift.
PUSH_OUTCOMES: Final = dict(
    enumerate(("not tested", "held", "penetration", "lost while closing", "displaced", "rotated", "diverged"))
)
_LIFT_OUTCOMES = ("not tested", "lifted", "penetration", "contact on the approach", "lost while closing", "not lifted")
LIFT_OUTCOMES: Final = dict(enumerate((*_LIFT_OUTCOMES, "rotated", "diverged", "neighbour moved")))
#: Meanings of `worker.episodes.episode.EpisodeOutcome`; grasps with the last four were not executed.
_EPISODE_OUTCOMES = ("succeeded", "touched", "not lifted", "dropped", "diverged", "out of reach")
EPISODE_OUTCOMES: Final = dict(enumerate((*_EPISODE_OUTCOMES, "no continuous motion", "collision", "no transit")))
EXECUTED: Final = _EPISODE_OUTCOMES[:5]
#: Meanings of the codes of phases, `worker.episodes.episode.PHASES`.
_PHASES = ("transit", "approach", "shape", "close", "squeeze", "lift", "hold")
EPISODE_PHASES: Final = dict(enumerate(_PHASES))
#: Cameras that film episodes.
CAMERAS: Final = ("scene", "wrist", "moving")
#: Videos of each camera.
VIDEOS: Final = {camera: (camera, f"{camera}_depth", f"{camera}_segmentation") for camera in CAMERAS}

_BITS: Final = ", ".join(f"{1 << bit} {name}" for bit, name in enumerate(ENGINES))


def _camera_columns(camera: str) -> dict[str, Column]:
    columns = {
        f"camera/{camera}_pose": _optional_column("F 7", "f4", "m, 1", "scene", "camera: x right, y down, z forward")
    }
    for name, about in zip(
        VIDEOS[camera], ("AV1 in MP4", "16-bit FFV1, depth [mm]", "8-bit FFV1, labels"), strict=True
    ):
        columns[f"video/{name}"] = _optional_column("*", "u1", "bytes", "none", f"videos in sequence: {about}")
        columns[f"video/{name}_bytes"] = _optional_column("E", "i8", "bytes", "none", "size of each video")
    return columns


def _wrist_column(rows: str) -> Column:
    description = "collision-free angles of wrist joints above the hand's root, order in attribute wrist_joint_names"
    return _optional_column(f"{rows} U", "f8", "rad", "joint", description)


def _metric_columns(*, optional: bool) -> dict[str, Column]:
    def metric_column(metric: GraspMetric) -> Column:
        shape, dtype = "N T" if metric.swept else "N", "i4" if metric.whole else "f8"
        return Column(shape, dtype, metric.units, "none", metric.meaning, optional)

    return {metric.path: metric_column(metric) for metric in GRASP_METRICS if metric.optional == optional}


SCHEMAS: Final[dict[ShardKind, dict[str, Column]]] = {
    "base": {
        **_posture_columns("grasp", "posture at contact"),
        **_posture_columns("pregrasp", "posture before contact, fingers clear of the object"),
        **_posture_columns("squeeze", "commanded posture that presses on the object"),
        "quality/thresholds_m": Column("T", "f8", "m", "none", "contact thresholds of the sweep"),
        **_metric_columns(optional=False),
        "quality/valid": Column("N", "u1", "bool", "none", "1: feasible, and held in validation; 0: other"),
        "quality/feasible": _flag_column("1: within the geometric limits of penetration and contact", "u1"),
        "quality/success": _flag_column(
            "verdict at the level of attribute verdict_level: 1 held, 0 dropped, -1 not tested"
        ),
        "quality/verdict_outcome": _code_column("outcome per push +x -x +y -y +z -z: ", "N D", outcomes=PUSH_OUTCOMES),
        "quality/verdict_margin": _optional_column(
            "N", "f8", "1", "none", "largest ratio of motion to its limit under the pushes; below 1: held"
        ),
        "quality/validated_by": _code_column("engine of `success`: 0 MuJoCo on the CPU, 1 MuJoCo Warp (the prefilter)"),
        "quality/recheck": _flag_column("verdict of unmodified DexGraspBench: 1 held, 0 dropped, -1 not rechecked"),
        "quality/published": _flag_column("published verdict of imported grasps: 1 held, 0 dropped, -1 none"),
        **_metric_columns(optional=True),
        "quality/robust_weakest": _code_column(
            "perturbed parameter of the first model in which the grasp does not hold: 0 none, ", outcomes=AXIS_MEANINGS
        ),
        "quality/held_in": _code_column(f"sum of the codes of the engines that hold the grasp: {_BITS}"),
        "quality/agreement": _optional_column(
            "N", "f8", "1", "none", "share of the engines that give the verdict of the majority; nan: only one"
        ),
        # Grasps planned in scenes also have the scene, the approach and the lift.
        "scene/object_pose": _optional_column("S 7", "f8", "m, 1", "scene", "object frame at rest; z points up"),
        "scene/rest_probability": _optional_column("S", "f8", "1", "none", _REST),
        "scene/neighbour_pose": _optional_column("S M 7", "f8", "m, 1", "scene", _NEIGHBOURS),
        "grasp/scene_index": _optional_column("N", "i4", "1", "none", "row of the grasp's scene in /scene"),
        "grasp/approach": _optional_column(
            "N W 7", "f8", "m, 1", "object", f"approach waypoints from standoff to pregrasp: {_POSE}"
        ),
        "grasp/approach_joint_positions": _optional_column(
            "N J", "f8", "rad or m", "joint", "joints of the open hand, order in joint_names"
        ),
        "grasp/lift": _optional_column("N 7", "f8", "m, 1", "object", f"squeeze posture raised by 10 cm: {_POSE}"),
        "grasp/wrist_positions": _wrist_column("N"),
        "quality/lift_outcome": _code_column("lift test: ", outcomes=LIFT_OUTCOMES),
        "quality/lift_hard": _flag_column("lift test at half the friction: 1 lifted, 0 not, -1 not tested"),
        "quality/pushes": _flag_column(
            "pushes without the scene, in files of graspd 0.2: 1 held, 0 dropped, -1 not tested"
        ),
    },
    "scene": {
        "scene/object_pose": Column("S 7", "f8", "m, 1", "table", "object frame at rest; table top is z = 0"),
        "scene/rest_probability": Column("S", "f8", "1", "none", _REST),
        "scene/drop_seconds": Column("S", "f8", "s", "none", "simulated time until rest"),
        "grasp/base_index": Column("K", "i4", "1", "none", "row of the grasp in the base shard"),
        "grasp/scene_index": Column("K", "i4", "1", "none", "row of the scene in /scene"),
        "grasp/hand_pose": Column("K 7", "f8", "m, 1", "table", f"posture at contact: {_POSE}"),
        "grasp/table_clearance_m": Column("K", "f8", "m", "table", f"{_HEIGHT}, from pregrasp to grasp"),
        "grasp/valid": Column("K", "u1", "bool", "none", "1: hand clear at contact and on the approach"),
        "grasp/rejection": _code_column(_REJECTIONS, "K"),
        "grasp/contact_table_clearance_m": _optional_column("K", "f8", "m", "table", f"{_HEIGHT}, at contact"),
        "grasp/neighbour_clearance_m": _optional_column(
            "K", "f8", "m", "table", "least signed distance of the hand from neighbours' convex hulls, at most 0.1"
        ),
        "grasp/wrist_positions": _wrist_column("K"),
        "scene/neighbour_pose": _optional_column("S M 7", "f8", "m, 1", "table", _NEIGHBOURS),
    },
    "views": {
        "camera/intrinsics": Column("V 3 3", "f8", "px", "image", "pinhole K; pixel centres at +0.5"),
        "camera/extrinsics": Column(
            "V 4 4", "f8", "m, 1", "table -> camera", "x_camera = E x_table; camera x right, y down, z forward"
        ),
        "camera/scene_index": Column("V", "i4", "1", "none", "row of the scene in the scene shard"),
        "camera/eye": Column("V", "u1", "enum", "none", "0 mono, 1 left, 2 right"),
        "camera/stereo_baseline_m": Column("V", "f8", "m", "camera", "distance of the cameras of a pair; 0: mono"),
        "image/rgb": Column("V H W 3", "u1", "sRGB", "image", "colour"),
        "image/depth": Column("V H W", "f4", "m", "camera", "distance along the optical axis; inf: no surface"),
        "image/segmentation": Column(
            "V H W", "u1", "enum", "image", "0 background, 1 table, 2 object, 3+m neighbour m"
        ),
        "box/bounding_box_2d_tight": Column("V 4", "f4", "px", "image", f"{_BOUNDS} visible object; nan: not visible"),
        "box/bounding_box_2d_loose": Column("V 4", "f4", "px", "image", f"{_BOUNDS} projected object, occluded or not"),
        "box/bounding_box_3d": Column("V 8 3", "f4", "m", "camera", "corners of the object-aligned box"),
        "box/occlusion_ratio": _optional_column("V", "f4", "1", "image", "occluded share of object; nan: not in view"),
        "image/distance": _optional_column("V H W", "f4", "m", "camera", "distance from optical centre; inf: none"),
        "image/normals": _optional_column("V H W 3", "f2", "1", "table", "outward unit normal; 0 0 0: no surface"),
        "image/rgb_hand": _optional_column("V H W 3", "u1", "sRGB", "image", "colour with the hand at its grasp"),
        "camera/hand_grasp": _optional_column("V", "i4", "1", "none", "row of the grasp in the scene shard; -1: none"),
    },
    "episodes": {
        "episode/row": Column("E", "i4", "1", "none", "row of the grasp in the base shard"),
        "episode/scene_index": Column("E", "i4", "1", "none", "row of the grasp's scene in /scene"),
        "episode/outcome": _code_column("outcome: ", "E", outcomes=EPISODE_OUTCOMES, optional=False),
        "episode/frames": Column("E", "i4", "1", "none", "number of frames; 0: not executed"),
        "frame/state": Column("F D", "f4", "m, 1, rad", "scene", f"measured state, {_STATE}"),
        "frame/action": Column("F D", "f4", "m, 1, rad", "scene", f"state commanded for the next frame, {_STATE}"),
        "frame/phase": _code_column("phase: ", "F", outcomes=EPISODE_PHASES, optional=False),
        "frame/object_pose": Column("F 7", "f4", "m, 1", "scene", "object frame"),
        "frame/neighbour_pose": _optional_column("F M 7", "f4", "m, 1", "scene", "frames of the neighbours"),
        "scene/object_pose": Column("S 7", "f8", "m, 1", "scene", "object frame at rest; z points up"),
        "scene/neighbour_pose": _optional_column("S M 7", "f8", "m, 1", "scene", _NEIGHBOURS),
        **{
            one.path: _optional_column("E", "i4" if one.whole else "f8", one.units, "none", one.meaning)
            for one in GRASP_METRICS
            if one.optional and not one.swept
        },
        **{path: column for camera in CAMERAS for path, column in _camera_columns(camera).items()},
    },
}

Attribute = str | int | float | list[str]


@dataclass(frozen=True)
class RootAttribute:
    type: str
    """text, integer, number or texts."""
    description: str
    kinds: tuple[str, ...] = ("base", "scene", "views", "episodes")


_TYPES: Final[dict[str, Any]] = {"text": str, "integer": int, "number": int | float, "texts": list}
_BASE: Final = ("base",)
_EXECUTED: Final = ("base", "episodes")
_EPISODES: Final = ("episodes",)

ATTRIBUTES: Final[dict[str, RootAttribute]] = {
    "schema": RootAttribute("text", "`graspd/base@2`, `graspd/scene@1`, `graspd/views@1` or `graspd/episodes@1`"),
    "hand": RootAttribute("text", "name of the hand"),
    "hand_digest": RootAttribute("text", "digest of the hand's files"),
    "hand_source": RootAttribute("text", "path from which a local command read the hand; absent: built in"),
    "object": RootAttribute("text", "name of the object"),
    "object_digest": RootAttribute("text", "digest of the object's files"),
    "object_source": RootAttribute("text", "path from which a local command read the object; absent: built in"),
    "object_options": RootAttribute("text", "options for reading the mesh, as JSON"),
    "object_mass_kg": RootAttribute("number", "mass of the object in simulation [kg]", _EXECUTED),
    "object_friction": RootAttribute("number", "Coulomb coefficient of the object's contacts in simulation", _EXECUTED),
    "object_scale": RootAttribute("number", "imported grasps: scale of the object's mesh", _BASE),
    "method": RootAttribute("text", "planner"),
    "fidelity": RootAttribute("text", "settings of the fidelity, as JSON"),
    "seed": RootAttribute("integer", "seed; with batch and digests it determines the result"),
    "batch": RootAttribute("integer", "number of the first batch of the shard in its job"),
    "batch_rows": RootAttribute("text", "JSON: number of rows of each batch; absent: one batch", _BASE),
    "device": RootAttribute("text", "device of the computation"),
    "seconds": RootAttribute("number", "computing time [s]"),
    "created": RootAttribute("text", "time of creation, RFC 3339"),
    "code_version": RootAttribute("text", "version of graspd that made the shard"),
    "shard_id": RootAttribute("text", "name of the shard in the store"),
    "inputs": RootAttribute("texts", "names of the shards from which this shard was made"),
    "joint_names": RootAttribute("texts", "order of the hand's joints", _BASE),
    "wrist_joint_names": RootAttribute("texts", "joints of `grasp/wrist_positions`; absent: none", ("base", "scene")),
    "root_link": RootAttribute("text", "link of the hand to which poses refer"),
    "mu": RootAttribute("number", "Coulomb coefficient of `quality/epsilon` and `quality/wrench_volume`", _BASE),
    "want": RootAttribute("text", "requested grasps: valid (without validation: feasible) or candidates (all)", _BASE),
    "candidates": RootAttribute("integer", "candidates planned until the last stored grasp", _BASE),
    "outcomes": RootAttribute("text", "JSON: rejected candidates by outcome", _BASE),
    "reason": RootAttribute("text", "why a command found fewer grasps than requested; absent: none are missing", _BASE),
    "grasps_wanted": RootAttribute("integer", "number of requested grasps, if the command was interrupted", _BASE),
    "requirements": RootAttribute("text", "JSON: required type, digits, region and approach; absent: none", _EXECUTED),
    "robust": RootAttribute("text", "JSON: perturbed models per valid grasp, required share; absent: none", _BASE),
    "engines": RootAttribute("text", "engines of `quality/held_in`, separated by commas; absent: none", _BASE),
    "verdict_level": RootAttribute("text", "level of validation; `none`: not validated", _BASE),
    "verdict_key": RootAttribute("text", "digest of all settings that affect verdicts; average only equal keys", _BASE),
    "scene": RootAttribute("text", "scene of the grasps, as JSON; absent: planned around a free object"),
    "transferred_from": RootAttribute("text", "JSON: shard and rows that the grasps were transferred from", _BASE),
    "source": RootAttribute("text", "imported grasps: address or citation of the source", _BASE),
    "licence": RootAttribute("text", "imported grasps: terms of use", _BASE),
    "base_shard": RootAttribute("text", "base shard of the grasps in the scenes", ("scene", "views", "episodes")),
    "scene_shard": RootAttribute("text", "scene shard of the grasps or pictures", ("base", "views", "episodes")),
    "neighbours": RootAttribute("texts", "names of the neighbours"),
    "neighbour_digests": RootAttribute("texts", "digests of the neighbours' files"),
    "neighbour_sources": RootAttribute("texts", "paths from which a local command read neighbours; empty: built in"),
    "state_names": RootAttribute("texts", "order of the values of states and actions", _EPISODES),
    "fps": RootAttribute("number", "frames per second", _EPISODES),
    "arm": RootAttribute("text", "name of the arm; absent: the hand flies", _EPISODES),
    "arm_digest": RootAttribute("text", "digest of the arm's files", _EPISODES),
    "arm_source": RootAttribute("text", "path from which a local command read the arm; absent: built in", _EPISODES),
    "arm_mount": RootAttribute("text", "link of the arm that carries the hand", _EPISODES),
    "arm_mount_pose": RootAttribute("text", "pose of the hand's root link in the frame of this link", _EPISODES),
    "arm_base": RootAttribute("text", "pose of the arm's root link in the scene", _EPISODES),
    "cameras": RootAttribute("text", "JSON: size, intrinsics and codec of each camera; absent: none", _EPISODES),
}


def check_column_names(kind: ShardKind, columns: Iterable[str]) -> None:
    if unknown := set(columns) - set(SCHEMAS[kind]):
        raise InputError(f"{kind} shards have no column {sorted(unknown)[0]!r}; docs/reference/dataset.md lists them")


def check_attributes(kind: str, attributes: Mapping[str, Attribute]) -> None:
    for name, value in attributes.items():
        known = ATTRIBUTES.get(name)
        if known is None or kind not in known.kinds:
            raise InputError(f"a {kind} shard has no root attribute {name!r}")
        if not isinstance(value, _TYPES[known.type]):
            raise InputError(f"root attribute {name} is {value!r}; the schema says {known.type}")
