"""Options of grasps made in this process: job options with files instead of names, and run options."""

import re
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import Field, field_validator, model_validator

from graspd.service.model.contact_region import parse_pose
from graspd.service.model.domain import SCENES, JobOptions
from graspd.service.model.errors import choices_text
from graspd.service.model.fidelity import FIDELITIES, Fidelity
from graspd.service.model.object_options import MeshOptions
from graspd.service.model.options import Option, Place, validate
from graspd.service.model.scene_spec import MOST_NEIGHBOURS, MOST_SCENES, SceneSpec, Touch, parse_scene

_LOCAL: Final[tuple[Place, ...]] = ("synth", "python")
_COMMAND: Final[tuple[Place, ...]] = ("synth",)
#: Grasp file, and optionally the row of a grasp.
GRASP_FILE: Final = re.compile(r"(.+\.(?:h5|hdf5))(?::(\d+))?")
#: Scene fields of a job; local commands use a `SceneSpec` instead.
_OF_PLACE: Final = {"scene", "faces", "neighbours", "touch", "scenes"}


class LocalOptions(MeshOptions, JobOptions):
    """Options of `graspd synth` and `graspd.synthesize` besides hand and object."""

    fidelity: Annotated[str, Option("basic", _LOCAL)] = Field("standard", description=f"one of {', '.join(FIDELITIES)}")
    contact_solver: Annotated[Literal["direct", "gauss_seidel"] | None, Option(places=_COMMAND)] = Field(
        None, description="contact solver; default: that of the fidelity"
    )
    scene: Annotated[str | Path, Option("basic", _LOCAL)] = Field(  # type: ignore[assignment]
        "free", description="scene of the grasps: free, table, bin, shelf, or a JSON or YAML file"
    )
    scenes: Annotated[int, Option("basic", _LOCAL)] = Field(
        SCENES, ge=1, le=MOST_SCENES, description="scenes over which the grasps are distributed"
    )
    neighbours: Annotated[tuple[str | Path, ...], Option("basic", _LOCAL, "--with")] = Field(  # type: ignore[assignment]
        (), max_length=MOST_NEIGHBOURS, description="neighbour in the scene: a file or a built-in object; up to eight"
    )
    touch: Annotated[Touch | None, Option(places=_LOCAL)] = Field(  # type: ignore[assignment]
        None,
        description="clearance of fingertips to supports [mm]; default: that of the scene file, else 0. 2: as for "
        "the rest of the hand; 0: contact allowed; negative: fingertips may press into the support",
    )
    like: Annotated[str | Path, Option(places=_LOCAL)] = Field(  # type: ignore[assignment]
        "",
        description="demonstrated wrist pose x, y, z, qw, qx, qy, qz in the object's frame [m], or a grasp file of the "
        "same hand: grasps.h5 (first valid grasp) or grasps.h5:ROW. Grasps stay within 4 cm and 30 degrees",
    )
    payload: Annotated[bool, Option("advanced", _LOCAL, "--payload/--no-payload")] = Field(
        False,
        description="measure the payload of each valid grasp; default of graspd synth in scenes with a given mass",
    )
    # A value may be a path of a file; a job has the digest of the file instead.
    options: Annotated[dict[str, Any], Option("advanced", _LOCAL, "--option")] = Field(
        default_factory=dict, description="option of the planner, such as steps=20000 or network=net.npz"
    )
    device: Annotated[str, Option(places=_LOCAL)] = Field("auto", description="device: cpu, cuda:0 or auto")
    threads: Annotated[int, Option(places=_LOCAL)] = Field(0, ge=0, description="CPU threads; 0: one per core")
    join: Annotated[int | Literal["auto"], Option(places=_LOCAL)] = Field(
        "auto",
        description="batches of 32 per kernel launch, without effect on grasps; auto: enough to fill a GPU, 1 on a CPU",
    )

    @field_validator("fidelity")
    @classmethod
    def _check_fidelity(cls, value: str | Fidelity) -> str | Fidelity:
        if not isinstance(value, str) or value not in FIDELITIES:
            raise ValueError(f"unknown fidelity {value!r}; choose one of {choices_text(str(value), FIDELITIES)}")
        return value

    @field_validator("like")
    @classmethod
    def _check_like(cls, value: str | Path) -> str:
        if (text := str(value)) and not GRASP_FILE.fullmatch(text):
            parse_pose(text)
        return text

    @field_validator("join", mode="before")
    @classmethod
    def _batches(cls, value: object) -> object:
        if not re.fullmatch(r"auto|[1-9][0-9]{0,3}", str(value)):
            raise ValueError(f"must be a number of batches from 1 to 9999, or auto; got {value!r}")
        return value

    @model_validator(mode="before")
    @classmethod
    def _set_scenes(cls, data: Any) -> Any:
        return data

    @property
    def resolved_fidelity(self) -> Fidelity:
        knobs, solver = FIDELITIES[self.fidelity], self.contact_solver
        if solver is None:
            return knobs
        return knobs.model_copy(update={"contact_solver": solver, "name": f"{knobs.name}+{solver}"})

    @property
    def scene_spec(self) -> SceneSpec:
        """The scene; InputError if a file cannot be used."""
        return parse_scene(str(self.scene), faces=self.faces, touch=self.touch, beside=[*map(str, self.neighbours)])

    @property
    def mesh_options(self) -> dict[str, Any]:
        given = self.model_fields_set & MeshOptions.model_fields.keys()
        return {name: value for name in sorted(given) if (value := getattr(self, name))}

    def job_options(self, options: dict[str, Any], like: str = "") -> JobOptions:
        """Return job options without scene and rechecks; `options` has digests of files, `like` a pose.
        Raise InputError."""
        shared = {name: getattr(self, name) for name in JobOptions.model_fields.keys() - _OF_PLACE}
        # Rechecks sample many jobs; a single file can be validated completely at level `dexgraspbench`.
        return validate(
            JobOptions, shared | {"fidelity": self.resolved_fidelity, "options": options, "rechecks": 0, "like": like}
        )
