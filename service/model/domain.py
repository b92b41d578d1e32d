"""Core domain types: jobs with their options, and stored hands, objects and networks.

Units are SI (metres, radians, kilograms, seconds). A pose is 7 numbers: position x y z, then unit quaternion w x y z.
"""

import re
import zlib
from collections.abc import Sequence
from typing import Annotated, Any, ClassVar, Final, Literal, Self, get_args

from pydantic import AfterValidator, ConfigDict, Field, field_validator, model_validator

from graspd.service.model.base import DIGEST, Digest, Model, Name
from graspd.service.model.contact_region import parse_cone, parse_pose, parse_region
from graspd.service.model.engines import ENGINES
from graspd.service.model.fidelity import AUTO, OFFERED, Fidelity, resolve_fidelity
from graspd.service.model.grasp_types import GraspTypeName
from graspd.service.model.matter import FRICTION, MASS_KG, MOST_KG, Density, Friction, Mass
from graspd.service.model.metrics import MIN_DISTANCE_M, MOST_ROBUST_MODELS, ROBUST_MODELS
from graspd.service.model.options import JOB, FormField, Option
from graspd.service.model.projects import Project
from graspd.service.model.scene_spec import (
    MOST_NEIGHBOURS,
    TOUCH,
    BesideOption,
    NamedNeighbour,
    SceneDocument,
    SceneOption,
    SceneSpec,
    Touch,
    build_scene_spec,
    has_table,
)
from graspd.service.model.states import AssetKind
from graspd.service.model.version import SCHEMA_OF_ENGINES, SCHEMA_OF_EPISODES

#: Grasps per batch, the unit of seeds and kernel launches.
BATCH_SIZE: Final = 32
#: Optional channels besides colour, depth and segmentation, in the order of shards and digests.
EXTRA_CHANNELS: Final = ("distance", "normals", "occlusion")

#: Default rechecks per job, and batches per recheck. One recheck takes as long as planning, validation and
#: measurement of two or three valid grasps.
RECHECKS: Final = 8
_RECHECK_EVERY: Final = 2

#: graspd's own methods that cannot plan in scenes; workers report further ones of other packages.
FREE_ONLY_METHODS: Final = ("autograsp", "dfc", "graspd2022", "graspit")
#: Methods that start from network proposals for an object on a table; the option `network` names the network.
NETWORK_METHODS: Final = ("learned",)
#: graspd's own methods; other packages can add methods.
METHODS: Final = ("fast_graspd", "graspit", "graspd2022", "dfc", *NETWORK_METHODS, "autograsp")
#: Default number of scenes of a batch planned in scenes.
SCENES: Final = 4
_LEVEL_LABELS: Final = {
    "standard": "standard",
    "fast": "fast screening",
    "dexgraspbench": "DexGraspBench protocol, slower",
    "none": "no validation",
}
_FACE_LABELS: Final = {"drawn": "as dropped", "all": "every stable face"}
_WANT_LABELS: Final = {"valid": "valid grasps", "candidates": "all candidates"}
_FIDELITY_HINT: Final = "draft: fastest; fine: most accurate; auto: meets the target"
_CARRIER_LABELS: Final = {"none": "none", "flying": "flying hand", "ur10e": "UR10e", "franka": "Franka"}
_SCENE_LABELS: Final = {"free": "free object", "table": "table", "bin": "bin", "shelf": "shelf"}
_ENGINE_LABELS: Final = {"none": "none", "physx": "PhysX", "drake": "Drake", "all": "PhysX and Drake"}
_TYPE_LABELS: Final = {name: name.replace("_", " ") for name in get_args(GraspTypeName)}
#: Input of each option in the forms of the dashboard.
FORM: Final[dict[str, FormField]] = {
    "grasps": FormField("", "Number of grasps", "in batches of 32"),
    "method": FormField("Planning", "Planner", "makes the candidates", {one: one for one in METHODS}),
    "fidelity": FormField("Planning", "Fidelity", _FIDELITY_HINT, {one: one for one in (*OFFERED, AUTO)}),
    "seed": FormField("Planning", "Seed", "same seed, same grasps"),
    "scene": FormField("", "Scene", "of planning and validation", choices=_SCENE_LABELS, cells=True),
    "faces": FormField("Scene", "Resting face", "of the object", _FACE_LABELS, cells=True),
    "neighbours": FormField(
        "Scene", "Neighbours", "up to 8 names; empty: none", placeholder="block, bottle", cells=True
    ),
    "touch": FormField(
        "Scene", "Fingertip clearance", "to supports; 0: contact allowed, 2: as for the hand", cells=True
    ),
    "scenes": FormField("Scene", "Scenes", "per batch; 0: none if the scene is free, else 4"),
    "views": FormField("Pictures", "Views", "camera placements per scene"),
    "stereo": FormField("Pictures", "Cameras", "Stereo: left and right eye"),
    "width": FormField("Pictures", "Width", "of each picture"),
    "height": FormField("Pictures", "Height", "of each picture"),
    "channels": FormField(
        "Pictures", "Further channels", "besides colour, depth and labels", placeholder="distance, normals"
    ),
    "episodes": FormField("Episodes", "Robot", "executes each valid grasp", _CARRIER_LABELS, cells=True),
    "film": FormField("Episodes", "Film", "cameras; empty: no film", placeholder="scene, wrist"),
    "episode_fps": FormField("Episodes", "Frame rate", "of states and films"),
    "type": FormField("Grasp", "Grasp type", "", _TYPE_LABELS, cells=True),
    "digits": FormField("Grasp", "Digits", "that may touch; empty: all", placeholder="thumb, index"),
    "touch_region": FormField("Grasp", "Contact region", "bounds, part or colour", placeholder="z > 0.05", cells=True),
    "avoid_region": FormField("Grasp", "Avoided region", "without contacts", placeholder="z > 0.1"),
    "approach_cone": FormField(
        "Grasp", "Approach cone", "axis and angle; empty: any", placeholder="0, 0, -1, 30", cells=True
    ),
    "like": FormField(
        "Grasp", "Wrist pose", "x, y, z, quaternion wxyz", placeholder="0, 0, 0.1, 1, 0, 0, 0", cells=True
    ),
    "friction": FormField("Object", "Friction of the metrics", "Coulomb coefficient"),
    "mass": FormField("Object", "Mass", "empty: its own, else 0.1 kg"),
    "density": FormField("Object", "Density", "instead of the mass"),
    "object_friction": FormField("Object", "Friction in simulation", "Coulomb; empty: its own, else 0.6"),
    "want": FormField("Planning", "Counted grasps", "", _WANT_LABELS),
    "budget": FormField("Planning", "Budget", "candidates per requested valid grasp"),
    "min_distance": FormField("Planning", "Least distance", "of two grasps of a batch; 0: no limit", cells=True),
    "validation": FormField("Validation", "Level", "of validation in MuJoCo", _LEVEL_LABELS),
    "rechecks": FormField("Validation", "Rechecks", "valid grasps, at level dexgraspbench"),
    "robust": FormField("Validation", "Robust share", "of perturbed models that must hold; 0: none", cells=True),
    "robust_models": FormField("Validation", "Perturbed models", "per valid grasp; 0: 8 if a share is given"),
    "payload": FormField("Validation", "Payload", "Measure it for each valid grasp"),
    "min_payload": FormField(
        "Validation", "Least payload", "mass that a grasp must lift to count; 0: no requirement", cells=True
    ),
    "shake": FormField("Validation", "After the lift", "Shake: 2 cm, 3 Hz", cells=True),
    "second_engine": FormField("Validation", "Second engine", "for a share of the grasps", _ENGINE_LABELS, cells=True),
    "second_engine_share": FormField("Validation", "Second engine's share", "of the valid grasps"),
    "options": FormField("Planning", "Options of the planner", "name=value; empty: none", placeholder="steps=20000"),
    "target": FormField("Planning", "Target", "of fidelity auto", placeholder="gsr>=0.6"),
}
NO_NEIGHBOURS: Final = "second engines simulate no neighbours: only mujoco does"
SHAKE_NEEDS_A_SCENE: Final = "shake needs a lift out of a scene: choose a scene, such as table"


#: Options that state requirements on grasps.
REQUIREMENTS: Final = ("type", "digits", "touch_region", "avoid_region", "approach_cone", "like")
SecondEngine = Literal["none", "physx", "drake", "all"]
DigitName = Literal["thumb", "index", "middle", "ring", "little", "sixth"]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Region = Annotated[str, Field(max_length=200), AfterValidator(lambda text: text and parse_region(text) and text)]
Cone = Annotated[str, Field(max_length=80), AfterValidator(lambda text: text and parse_cone(text) and text)]
WristPose = Annotated[str, Field(max_length=160), AfterValidator(lambda text: text and parse_pose(text) and text)]


def _field(default: Any, description: str, **bounds: Any) -> Any:
    return Field(default, description=description, **bounds)


def _sparse_field(default: Any, description: str, **bounds: Any) -> Any:
    """Return a field that JSON omits at its default: new fields change no ids and records of old jobs."""
    return _field(default, description, exclude_if=lambda value: value == default, **bounds)


class JobOptions(Model):
    """Options of a job besides hand and object: number of grasps, planning, scenes and views."""

    SUBMITTED: ClassVar[bool] = False
    """True for jobs of a service; False for work in this process."""

    grasps: Annotated[int, Option("basic", flags="--grasps -n")] = _field(
        32, "number of grasps; in a dataset, for each pair of hand and object", ge=1, le=1_000_000
    )
    method: Annotated[Name, Option("basic")] = _field(
        "fast_graspd", f"planner: {', '.join(METHODS)}, or one of another package"
    )
    fidelity: Annotated[str | Fidelity, Option("basic")] = _field(
        "standard", f"{', '.join(OFFERED)}, or auto with a target"
    )
    seed: Annotated[int, Option("basic")] = _field(0, "the same seed gives the same grasps", ge=0, lt=2**31)
    scene: Annotated[
        SceneOption, Option("basic", typed="scene of the grasps: free, table, bin, shelf, or a JSON or YAML file")
    ] = _sparse_field(
        "free",
        "scene in which grasps are planned, validated, rendered and counted: free (a floating object), "
        "table, bin, shelf, or JSON with supports",
    )
    faces: Annotated[Literal["drawn", "all"], Option()] = _sparse_field(
        "drawn",
        "resting faces of the object. drawn: with their frequency after drops; all: one scene for each "
        "stable face, regardless of `scenes`",
    )
    neighbours: Annotated[
        tuple[BesideOption, ...],
        Option("basic", flags="--with", typed="neighbour in each scene: a name, or for graspd submit a mesh; up to 8"),
    ] = _sparse_field(
        (),
        "names of up to eight neighbours, dropped around the object; a scene with supports places its own",
        max_length=MOST_NEIGHBOURS,
    )
    touch: Annotated[Touch, Option()] = _sparse_field(
        TOUCH,
        "clearance of fingertips to supports [mm]. 2: as for the rest of the hand; 0: contact allowed; "
        "negative: fingertips may press into the support, for flat objects",
    )
    scenes: Annotated[int, Option("basic")] = _field(
        0, f"scenes per batch; 0: none if the scene is free, else {SCENES}", ge=0, le=64
    )
    views: Annotated[int, Option("basic", places=JOB)] = _field(0, "camera placements per scene", ge=0, le=256)
    stereo: Annotated[bool, Option(places=JOB)] = _field(False, "render a left and a right picture per placement")
    width: Annotated[int, Option(places=JOB)] = _field(320, "picture width [px]", ge=16, le=4096)
    height: Annotated[int, Option(places=JOB)] = _field(240, "picture height [px]", ge=16, le=4096)
    channels: Annotated[tuple[Literal["distance", "normals", "occlusion"], ...], Option(places=JOB)] = _field(
        (), "image channels besides colour, depth and segmentation: distance, normals or occlusion"
    )
    episodes: Annotated[
        Literal["none", "flying", "ur10e", "franka"], Option("basic", JOB, schema=SCHEMA_OF_EPISODES)
    ] = _sparse_field(
        "none", "robot that executes each valid grasp in its scene: flying (the hand alone), ur10e or franka"
    )
    film: Annotated[tuple[Literal["scene", "wrist"], ...], Option(places=JOB, schema=SCHEMA_OF_EPISODES)] = (
        _sparse_field((), "cameras that film the episodes: scene or wrist")
    )
    episode_fps: Annotated[int, Option(places=JOB, schema=SCHEMA_OF_EPISODES)] = _sparse_field(
        15, "frames of an episode [1/s]", ge=10, le=30
    )
    type: Annotated[GraspTypeName, Option("basic", schema=7)] = _sparse_field(
        "any",
        "type of the grasps by contact: power, precision, pinch, lateral, or a type of the GRASP taxonomy. "
        "balanced: power, precision and pinch in turn, one per batch",
    )
    digits: Annotated[
        tuple[DigitName, ...], Option(schema=7, typed="digit that may touch, such as thumb; the others stay open")
    ] = _sparse_field((), "digits that may touch: thumb, index, middle, ring, little", max_length=6)
    touch_region: Annotated[Region, Option(schema=7)] = _sparse_field(
        "",
        "region of all contacts: bounds in the object's frame [m], such as z > 0.05, x < 0.02. part NAME: "
        "a group, object or material of an OBJ; a node, mesh or material of a GLB. color #rrggbb: faces of this colour",
    )
    avoid_region: Annotated[Region, Option(schema=7)] = _sparse_field(
        "", "region without contacts: bounds [m] such as z > 0.1, part NAME or color #rrggbb"
    )
    approach_cone: Annotated[Cone, Option(schema=7)] = _sparse_field(
        "",
        "cone of the palm's approach: axis and largest angle [deg], such as 0, 0, -1, 30. The axis is in "
        "the frame of the scene, or of a free object",
    )
    like: Annotated[WristPose, Option(schema=7)] = _sparse_field(
        "",
        "demonstrated wrist pose x, y, z, qw, qx, qy, qz in the object's frame [m]. Grasps start around it "
        "and stay within 4 cm and 30 degrees",
    )
    friction: Annotated[float, Option()] = _field(1.0, "Coulomb coefficient of the quality metrics", gt=0, le=3)
    mass: Annotated[Mass | None, Option("basic", schema=5)] = _sparse_field(
        None, f"mass of the object [kg]; default: its own, else {MASS_KG:g} kg"
    )
    density: Annotated[Density | None, Option(schema=5)] = _sparse_field(
        None, "density of the object [kg/m^3], instead of the mass"
    )
    object_friction: Annotated[Friction | None, Option(schema=5)] = _sparse_field(
        None, f"Coulomb coefficient of contacts in simulation; default: the object's own, else {FRICTION:g}"
    )
    want: Annotated[Literal["valid", "candidates"], Option("basic")] = _field(
        "valid", "grasps that count: valid (without validation: feasible) ones, or all candidates"
    )
    budget: Annotated[float, Option()] = _field(
        4.0, "maximum number of candidates per requested valid grasp", ge=1, le=100
    )
    min_distance: Annotated[Finite, Option()] = _sparse_field(
        MIN_DISTANCE_M,
        "least distance to earlier grasps of the batch [m]: mean over corresponding points of the hand, in "
        "the object's frame. With want valid, nearer grasps are rejected; 0: no limit",
        ge=0,
        le=0.1,
    )
    validation: Annotated[Literal["dexgraspbench", "standard", "fast", "none"], Option("basic")] = _field(
        "standard", "level of validation in MuJoCo. fast: MuJoCo Warp on a GPU decides clear cases; none: no verdicts"
    )
    rechecks: Annotated[int, Option(places=JOB)] = _field(
        RECHECKS,
        "number of valid grasps validated again at level dexgraspbench. The default checks one grasp in "
        f"64, at most {RECHECKS}, in a twentieth of the job's time; other numbers check the first valid grasps",
        ge=0,
        le=10_000,
    )
    robust: Annotated[Finite, Option("basic")] = _sparse_field(
        0.0,
        "share of perturbed models in which a grasp must hold to count; 0: no requirement. With want "
        "candidates, all grasps are stored",
        ge=0,
        le=1,
    )
    robust_models: Annotated[int, Option()] = _sparse_field(
        0,
        f"number of perturbed models per valid grasp; 0: {ROBUST_MODELS} if `robust` is given, else none",
        ge=0,
        le=MOST_ROBUST_MODELS,
    )
    payload: Annotated[bool, Option(schema=5)] = _sparse_field(False, "measure the payload of valid grasps")
    min_payload: Annotated[Finite, Option(schema=5)] = _sparse_field(
        0.0, "mass that a grasp must lift to count [kg], which implies `payload`; 0: no requirement", ge=0, le=MOST_KG
    )
    shake: Annotated[bool, Option(schema=5)] = _sparse_field(
        False, "shake each valid grasp after its lift: 2 cm, 3 Hz, along x and y"
    )
    second_engine: Annotated[SecondEngine, Option("basic", schema=SCHEMA_OF_ENGINES)] = _sparse_field(
        "none",
        "engine besides MuJoCo that validates a share of the valid grasps: physx, drake, or all. With "
        "`robust`, only grasps that all named engines hold count",
    )
    second_engine_share: Annotated[Finite, Option(schema=SCHEMA_OF_ENGINES)] = _sparse_field(
        0.1, "share of a batch's valid grasps that the second engine validates; with `robust` all", gt=0, le=1
    )
    options: Annotated[
        dict[
            Annotated[str, Field(max_length=40)],
            Annotated[int, Field(ge=-(2**53), le=2**53)] | Finite | Annotated[str, Field(max_length=80)],
        ],
        Option(flags="--option", typed="option of the planner, such as steps=20000"),
    ] = Field(default_factory=dict, max_length=16, description="options of the planner; see docs/how-to/planners.md")
    target: Annotated[str, Option(places=JOB)] = _field(
        "",
        "required accuracy, for which fidelity `auto` selects the cheapest one in the published chart: "
        "gsr>=0.6, dexgraspbench>=0.9, pd_mm<=1; in a scene lift>=0.9, lift_hard or robust",
        max_length=40,
    )

    @field_validator("fidelity")
    @classmethod
    def _check_fidelity(cls, value: str | Fidelity) -> str | Fidelity:
        if value != AUTO:
            resolve_fidelity(value)
        return value

    @field_validator("channels", "film")
    @classmethod
    def _sort_channels(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        # The order of channels or cameras must not change the id of the job.
        return tuple(name for name in (*EXTRA_CHANNELS, "scene", "wrist") if name in value)

    @model_validator(mode="before")
    @classmethod
    def _set_scenes(cls, data: Any) -> Any:
        if isinstance(data, dict) and data.get("scene", "free") != "free" and data.get("scenes", 0) in (0, "0", ""):
            return {**data, "scenes": SCENES}
        return data

    @model_validator(mode="after")
    def _check_consistency(self) -> Self:
        if self.fidelity == AUTO and not self.target:
            example = "lift>=0.9" if self.in_scene else "gsr>=0.6"
            raise ValueError(f"fidelity auto needs a target, such as {example}")
        if self.target and self.fidelity != AUTO:
            raise ValueError("a target requires fidelity auto")
        if self.mass is not None and self.density is not None:
            raise ValueError("mass and density exclude each other: give one")
        if self.validation == "dexgraspbench" and self.object_properties:
            raise ValueError(
                f"validation dexgraspbench gives all objects {MASS_KG:g} kg and friction {FRICTION:g}: "
                f"{', '.join(self.object_properties)} requires standard, fast or none"
            )
        self._check_scene()
        if self.requirements and self.method != "fast_graspd":
            name = next(iter(self.requirements)).replace("_", "-")
            raise ValueError(f"method {self.method} plans any grasps: {name} requires method fast_graspd")
        if self.views and not self.scenes:
            raise ValueError("views need scenes: set scenes >= 1")
        if self.has_episodes and not self.in_scene:
            raise ValueError("free grasps have no episodes: choose a scene, such as table")
        if self.film and not self.has_episodes:
            raise ValueError("film shows episodes: choose a robot for them, such as flying")
        if self.film and (self.width % 2 or self.height % 2):
            raise ValueError(f"a film of {self.width} x {self.height} cannot be encoded: choose even numbers")
        if self.validation == "none":
            self._check_without_validation()
        return self

    def _check_scene(self) -> None:
        if self.scene_spec.kind != "free" and self.method in FREE_ONLY_METHODS:
            raise ValueError(f"method {self.method} plans around free objects only: in a scene use fast_graspd")
        if self.second_engines and self.all_neighbours:
            raise ValueError(NO_NEIGHBOURS)
        if not self.SUBMITTED:
            return
        if self.shake and not self.in_scene:
            raise ValueError(SHAKE_NEEDS_A_SCENE)
        if self.method in NETWORK_METHODS and not self.network:
            raise ValueError(f"method {self.method} needs the option network: the name of a network in the service")
        if self.method in NETWORK_METHODS and not has_table(self.scene_spec):
            raise ValueError(f"method {self.method} is for objects on a table: choose table, bin or a half-space")

    def _check_without_validation(self) -> None:
        if self.second_engines:
            raise ValueError("a second engine validates grasps that MuJoCo holds: choose a validator")
        if self.model_count:
            raise ValueError("robust counts verdicts: choose a validator")
        if self.measures_payload:
            raise ValueError("payload is measured by a validator: choose one")
        if self.shake:
            raise ValueError("shake is simulated by a validator: choose one")
        if self.has_episodes:
            raise ValueError("episodes execute valid grasps: choose a validator")

    @property
    def requirements(self) -> dict[str, Any]:
        """Requirements on type, digits, region, approach and wrist pose, without those that are not given."""
        given = {name: getattr(self, name) for name in REQUIREMENTS}
        return {name: value for name, value in given.items() if value not in ("any", "", ())}

    @property
    def measures_payload(self) -> bool:
        return self.payload or self.min_payload > 0

    @property
    def object_properties(self) -> dict[str, float]:
        """Mass, density and friction of the object, without those that are not given."""
        said = {"mass": self.mass, "density": self.density, "object_friction": self.object_friction}
        return {name: value for name, value in said.items() if value is not None}

    @property
    def model_count(self) -> int:
        """Number of perturbed models in which each valid grasp is validated; 0: only the nominal model."""
        return self.robust_models or (ROBUST_MODELS if self.robust else 0)

    @property
    def second_engines(self) -> tuple[str, ...]:
        """Names of the engines besides MuJoCo."""
        return tuple(one for one in ENGINES[1:] if self.second_engine in (one, "all"))

    @property
    def scene_spec(self) -> SceneSpec:
        return build_scene_spec(self.scene, faces=self.faces, touch=self.touch, beside=self._named_neighbours)

    @property
    def _named_neighbours(self) -> tuple[NamedNeighbour, ...]:
        # Validation of the field has converted names to `NamedNeighbour`.
        return tuple(one for one in self.neighbours if isinstance(one, NamedNeighbour))

    @property
    def all_neighbours(self) -> tuple[NamedNeighbour, ...]:
        """Neighbours of a `SceneDocument`, then dropped neighbours."""
        placed = self.scene.neighbours if isinstance(self.scene, SceneDocument) else ()
        return (*placed, *self._named_neighbours)

    def replace_neighbours(self, found: Sequence[NamedNeighbour]) -> Self:
        if not found:
            return self
        first = len(self.all_neighbours) - len(self.neighbours)
        changed: dict[str, Any] = {"neighbours": tuple(found[first:])}
        if isinstance(self.scene, SceneDocument):
            changed["scene"] = self.scene.model_copy(update={"neighbours": tuple(found[:first])})
        return self.model_copy(update=changed)

    @property
    def network(self) -> str:
        return str(self.options.get("network", "")) if self.method in NETWORK_METHODS else ""

    @property
    def in_scene(self) -> bool:
        return self.scene != "free"

    @property
    def has_episodes(self) -> bool:
        return self.episodes != "none"

    @property
    def resolved_fidelity(self) -> Fidelity:
        """Settings of the fidelity; ValueError for `auto`, which a chart must resolve first."""
        return resolve_fidelity(self.fidelity)

    @property
    def counted_status(self) -> Literal["valid", "feasible"]:
        """Status of the grasps that count towards the requested number: valid, or without validation feasible."""
        return "feasible" if self.validation == "none" else "valid"

    @property
    def displayed_status(self) -> Literal["valid", "feasible", "kept"]:
        """Status of the grasps that tables count: `counted_status`; for unvalidated candidates all stored."""
        return "kept" if self.counted_status == "feasible" and self.want == "candidates" else self.counted_status

    def rechecks_of(self, batch: int) -> int:
        """Return the number of rechecks of a batch; by default, every other of the first batches has one."""
        if self.validation in ("none", "dexgraspbench"):
            return 0
        if self.rechecks == RECHECKS:
            turn = batch + self._recheck_offset
            return int(turn % _RECHECK_EVERY == 0 and batch // _RECHECK_EVERY < RECHECKS)
        return min(BATCH_SIZE, max(0, self.rechecks - batch * BATCH_SIZE))

    @property
    def _recheck_offset(self) -> int:
        named = [getattr(self, name, "") for name in ("hand", "object")]
        return zlib.crc32("/".join([*named, str(self.seed)]).encode()) % _RECHECK_EVERY


class JobRequest(JobOptions):
    """Request for grasps of one hand on one object, with method, fidelity, scenes and views."""

    SUBMITTED = True

    hand: Name = Field(description="name of a hand known to the service")
    object: Name = Field(description="name of an object known to the service")


def count_batches(grasps: int) -> int:
    return -(-grasps // BATCH_SIZE)


def check_digests(options: JobOptions) -> None:
    """Raise ValueError if a neighbour or the network has no digest: a name may later refer to other files."""
    if any(one.digest is None for one in options.all_neighbours):
        raise ValueError("each neighbour of a stored job has the digest of its files")
    if options.network and not re.fullmatch(DIGEST, options.network):
        raise ValueError("the network of a stored job has the digest of its files")


class Asset(Model):
    """A stored hand, object or network: immutable bytes under the digest of their content."""

    kind: AssetKind
    name: Name
    digest: Digest
    filename: str = Field(description="main file in the archive: URDF, mesh or network")
    files: tuple[str, ...] = Field(description="relative paths of all files in the archive")
    size_bytes: int
    created: str = Field(description="RFC 3339, UTC")
    builtin: bool = False
    owner: str = Field("", max_length=64, description="id of the API key that uploaded it; empty: none or unknown")
    project: Project = Field("", description="project of that key; empty: the unnamed project")
    shared: bool = Field(False, description="whether all projects may use it")
    facts: dict[str, object] = Field(default_factory=dict, description="measurements of ingest")
    self_test: bool = Field(False, description="for a hand: whether its check includes the self-test")

    # Ignore further fields of a newer graspd.
    model_config = ConfigDict(frozen=True, extra="ignore")
