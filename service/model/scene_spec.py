"""Scenes: a kind, or supports, neighbours and pose of the target. In the scene frame, z points up."""

import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

from pydantic import AfterValidator, Discriminator, Field, Tag, ValidationError, model_validator

from graspd.service.model.base import Digest, Model, Name, error_text, first_error
from graspd.service.model.errors import InputError, did_you_mean

#: Kinds of scenes. `free`: a floating object; `file`: supports from a file.
SceneKind = Literal["free", "table", "bin", "shelf", "file"]
KINDS: Final = ("free", "table", "bin", "shelf")
MOST_SUPPORTS: Final = 32
#: Clearance of fingertips from supports [mm]: lower limit, clearance of the whole hand, default.
LEAST_TOUCH: Final = -1.0
MOST_TOUCH: Final = 2.0
TOUCH: Final = 0.0
SCENE_FILES: Final = (".json", ".yaml", ".yml")
MOST_NEIGHBOURS: Final = 8
MOST_SCENES: Final = 4096
FARTHEST_M: Final = 10.0
MAX_FILE_BYTES: Final = 64 * 1024

_Metres = Annotated[float, Field(ge=-FARTHEST_M, le=FARTHEST_M, allow_inf_nan=False)]
_Extent = Annotated[float, Field(gt=1e-4, le=2 * FARTHEST_M, allow_inf_nan=False)]
_Number = Annotated[float, Field(ge=-2.0, le=2.0, allow_inf_nan=False)]
Touch = Annotated[float, Field(ge=LEAST_TOUCH, le=MOST_TOUCH, allow_inf_nan=False)]
Vector = tuple[_Metres, _Metres, _Metres]


def _check_rotation(pose: tuple[float, ...]) -> tuple[float, ...]:
    if abs(math.hypot(*pose[3:]) - 1.0) > 1e-3:
        raise ValueError("the quaternion w x y z of a pose must have unit length")
    return pose


Pose = Annotated[tuple[_Metres, _Metres, _Metres, _Number, _Number, _Number, _Number], AfterValidator(_check_rotation)]


class HalfSpace(Model):
    """Half-space below a plane."""

    kind: Literal["half_space"] = "half_space"
    normal: Vector = (0.0, 0.0, 1.0)
    """Outward normal of the support, of any length."""
    offset: _Metres = 0.0
    """Value of n.x on the plane [m], with n = `normal` as given."""

    @model_validator(mode="after")
    def _check_normal(self) -> Self:
        if math.hypot(*self.normal) < 1e-6:
            raise ValueError("a half-space needs a normal that is not zero")
        return self


class Box(Model):
    kind: Literal["box"] = "box"
    size: tuple[_Extent, _Extent, _Extent]
    """Full extents x y z [m]."""
    pose: Pose = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


class NeighbourSpec(Model):
    object: str = Field(min_length=1, max_length=1024)
    """A built-in object or a mesh file; relative paths in a scene file start at its folder."""
    pose: Pose | None = Field(None, description="pose in the scene: x y z [m], unit quaternion w x y z; none: dropped")
    digest: Digest | None = Field(
        None, exclude_if=lambda value: value is None, description="digest of the object's files; set by the service"
    )


Supports = tuple[Annotated[HalfSpace | Box, Field(discriminator="kind")], ...]


class SceneSpec(Model):
    """Environment of the target object: supports and neighbours."""

    kind: SceneKind = "free"
    supports: Supports = Field((), max_length=MOST_SUPPORTS)
    target: Pose | None = None
    """Pose of the object in the scene; None: drop onto the support below."""
    faces: Literal["drawn", "all"] = "drawn"
    """drawn: resting faces with their frequency after drops; all: one scene for each stable face."""
    touch: Touch = TOUCH
    """Clearance of fingertips to supports [mm]. 2: as for the rest of the hand; 0: contact; negative: pressed in."""
    neighbours: tuple[NeighbourSpec, ...] = Field((), max_length=MOST_NEIGHBOURS)

    @model_validator(mode="after")
    def _check_scene(self) -> Self:
        self._check_neighbours()
        if self.kind == "file" and not self.supports:
            raise ValueError("a scene file needs supports: at least one half_space or box")
        if self.kind != "file" and (self.supports or self.target is not None):
            raise ValueError(f"a {self.kind} scene has its own supports; give supports or a target with kind file")
        if self.kind == "free" and self.faces != "drawn":
            raise ValueError("a free object lies on no face: choose table, bin or shelf")
        if self.kind == "free" and self.touch != TOUCH:
            raise ValueError("a free object has no supports to touch: choose table, bin or shelf")
        if self.target is not None and self.faces == "all":
            raise ValueError("a target with a pose lies on one face: faces all requires a dropped target")
        return self

    def to_attribute(self) -> dict[str, Any]:
        """Return the scene for a shard's attribute; another attribute has the digests of the neighbours."""
        return self.model_dump(mode="json", exclude={"neighbours": {"__all__": {"digest"}}})

    def _check_neighbours(self) -> None:
        placed = {one.pose is not None for one in self.neighbours}
        if not placed:
            return
        if self.kind == "free":
            raise ValueError("neighbours need a scene: choose table, bin, shelf or a scene file, not free")
        if len(placed) > 1:
            raise ValueError("give all neighbours a pose, or none: neighbours without a pose are dropped together")
        if placed == {True} and self.kind != "file":
            raise ValueError("neighbours with poses need a scene file")
        if placed == {False} and self.target is not None:
            raise ValueError("neighbours without a pose are dropped with the target: give all of them poses")


def parse_scene(
    text: str, *, faces: str = "drawn", touch: float | None = None, beside: Sequence[str] = ()
) -> SceneSpec:
    """Parse a scene: one of `KINDS` or a file. `touch` replaces the file's value. InputError if invalid."""
    path = Path(text)
    if text not in KINDS and path.suffix.lower() not in SCENE_FILES:
        hint = did_you_mean(text, KINDS)
        raise InputError(f"unknown scene {text!r}; choose one of {', '.join(KINDS)}, or give a JSON or YAML file{hint}")
    found = SceneSpec(kind=text) if text in KINDS else read_scene(path)
    neighbours = [*found.neighbours, *({"object": name} for name in beside)]
    changed = {"faces": faces, "touch": found.touch if touch is None else touch, "neighbours": neighbours}
    try:
        return SceneSpec(**{**dict(found), **changed})
    except ValidationError as error:
        raise InputError(f"scene {text}: {first_error(error)}") from None


def read_scene(path: Path) -> SceneSpec:
    """Read a scene file of at most `MAX_FILE_BYTES`; InputError if it is unreadable or invalid."""
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise InputError(f"the scene file {path} is larger than {MAX_FILE_BYTES // 1024} KiB")
        text = path.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"the scene file {path} cannot be read: {error_text(error)}") from None
    found = _parse_document(text, path)
    if not isinstance(found, dict):
        raise InputError(f"the scene file {path} must be one mapping with supports")
    try:
        spec = SceneSpec(**{"kind": "file", **found})
    except (ValidationError, TypeError) as error:
        reason = first_error(error) if isinstance(error, ValidationError) else str(error)
        raise InputError(f"the scene file {path} is wrong: {reason}") from None
    neighbours = tuple(
        one.model_copy(update={"object": str(file)}) if (file := path.parent / one.object).is_file() else one
        for one in spec.neighbours
    )
    return spec.model_copy(update={"neighbours": neighbours})


def _parse_document(text: str, path: Path) -> object:
    try:
        if path.suffix.lower() == ".json":
            return json.loads(text)
        import yaml

        return yaml.safe_load(text)
    except Exception as error:
        mark, reason = getattr(error, "problem_mark", None), " ".join(str(error).split())
        reason = f"{getattr(error, 'problem', None) or reason} (line {mark.line + 1})" if mark else reason
        raise InputError(f"the scene file {path} is not {path.suffix[1:].upper()}: {reason[:200]}") from None


#: Inner size of a bin, height and thickness of its walls [m].
BIN_SIZE: Final = (0.40, 0.30)
BIN_HEIGHT: Final = 0.15
WALL: Final = 0.02
#: Width and depth of a shelf's boards, and the height between the boards [m]; the side towards -x is open.
SHELF_SIZE: Final = (0.80, 0.35)
SHELF_HEIGHT: Final = 0.35
UPRIGHT: Final = 1 - 1e-6


def scene_supports(spec: SceneSpec) -> tuple[HalfSpace | Box, ...]:
    if spec.kind == "free":
        return ()
    if spec.kind == "file":
        return spec.supports
    if spec.kind == "table":
        return (HalfSpace(),)
    return _bin_supports() if spec.kind == "bin" else _shelf_supports()


def has_table(spec: SceneSpec) -> bool:
    """Check whether a support is a level half-space."""
    flat = (one for one in scene_supports(spec) if isinstance(one, HalfSpace))
    return any(one.normal[2] / math.hypot(*one.normal) > UPRIGHT for one in flat)


def _box(x: float, y: float, z: float, size: tuple[float, float, float]) -> Box:
    return Box(size=size, pose=(x, y, z, 1.0, 0.0, 0.0, 0.0))


def _bin_supports() -> tuple[HalfSpace | Box, ...]:
    (x, y), z = BIN_SIZE, BIN_HEIGHT / 2
    along, across = (WALL, y + 2 * WALL, BIN_HEIGHT), (x, WALL, BIN_HEIGHT)
    ends = [_box(s * (x + WALL) / 2, 0, z, along) for s in (-1, 1)]
    sides = [_box(0, s * (y + WALL) / 2, z, across) for s in (-1, 1)]
    return (HalfSpace(), *ends, *sides)


def _shelf_supports() -> tuple[HalfSpace | Box, ...]:
    width, depth = SHELF_SIZE
    board = (depth, width, WALL)
    return (
        _box(0, 0, -WALL / 2, board),
        _box((depth + WALL) / 2, 0, SHELF_HEIGHT / 2, (WALL, width, SHELF_HEIGHT + 2 * WALL)),
        _box(0, 0, SHELF_HEIGHT + WALL / 2, board),
    )


class NamedNeighbour(NeighbourSpec):
    """Object in the scene, by its name in the service."""

    object: Name = Field(description="name of an object known to the service")


#: Neighbour in a request: a name, or a name with a pose.
BesideOption = Annotated[
    Annotated[Name, Tag("name")] | Annotated[NamedNeighbour, Tag("neighbour")],
    Discriminator(lambda value: "name" if isinstance(value, str) else "neighbour"),
    AfterValidator(lambda value: NamedNeighbour(object=value) if isinstance(value, str) else value),
]


class SceneDocument(Model):
    """Complete scene within a request."""

    supports: Supports = Field(
        min_length=1, max_length=MOST_SUPPORTS, description="supports around the object, in the scene frame, z up [m]"
    )
    target: Pose | None = Field(
        None, description="pose of the object in the scene: x y z [m], unit quaternion w x y z; none: dropped"
    )
    neighbours: tuple[NamedNeighbour, ...] = Field(
        (),
        max_length=MOST_NEIGHBOURS,
        exclude_if=lambda value: not value,
        description="neighbours: all with poses, or all without, to be dropped around the target",
    )
    touch: Touch = Field(
        TOUCH,
        exclude_if=lambda value: value == TOUCH,
        description="clearance of fingertips to the supports [mm], unless the request has its own",
    )


#: Scene in a request: a kind or a `SceneDocument`, discriminated so that errors refer to the intended type.
SceneOption = Annotated[
    Annotated[Literal["free", "table", "bin", "shelf"], Tag("kind")] | Annotated[SceneDocument, Tag("document")],
    Discriminator(lambda value: "document" if isinstance(value, dict | SceneDocument) else "kind"),
]


def build_scene_spec(
    option: str | SceneDocument,
    *,
    faces: Literal["drawn", "all"] = "drawn",
    touch: float = TOUCH,
    beside: Sequence[NeighbourSpec] = (),
) -> SceneSpec:
    """Return the scene of a request, with the neighbours `beside` added; ValueError if it is invalid."""
    try:
        if not isinstance(option, SceneDocument):
            return SceneSpec(kind=option, faces=faces, touch=touch, neighbours=tuple(beside))
        touch = option.touch if touch == TOUCH else touch
        others = (*option.neighbours, *beside)
        spec = {"kind": "file", "supports": option.supports, "target": option.target, "neighbours": others}
        return SceneSpec(**spec, faces=faces, touch=touch)
    except ValidationError as error:
        raise ValueError(first_error(error)) from None


def check_object_name(text: str) -> str:
    """Return the name of an object; InputError for a file, because jobs need names known to the service."""
    if "/" in text or Path(text).is_file():
        raise InputError(f"the neighbour {text} is a file: run `graspd objects add {text}` first, then give its name")
    return text


def parse_scene_option(
    text: str, *, beside: Path | None = None, named: Callable[[str], str] = check_object_name
) -> str | dict[str, Any]:
    """Return the scene of a request: a kind, or the content of a scene file relative to folder `beside`.

    `named` maps the neighbours of the file to names in the service.
    """
    if text in KINDS:
        return text
    is_file = Path(text).suffix.lower() in SCENE_FILES
    found = read_scene((beside or Path()) / text) if is_file else parse_scene(text)
    document = found.model_dump(mode="json", include={"supports", "target", "neighbours"}, exclude_none=True)
    if found.touch != TOUCH:
        document["touch"] = found.touch
    for one in document["neighbours"]:
        one["object"] = named(one["object"])
    return document if document["neighbours"] else {key: document[key] for key in document if key != "neighbours"}
