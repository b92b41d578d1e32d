"""The scene as a request over HTTP says it: a kind, or a document of supports and neighbours; neighbours by name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Discriminator, Field, Tag, ValidationError, model_validator

from service.model.errors import InputError
from service.model.labels import Name
from service.model.scene_spec import (
    KINDS,
    MOST_NEIGHBOURS,
    MOST_SUPPORTS,
    SCENE_FILES,
    TOUCH,
    NeighbourSpec,
    Part,
    Pose,
    SceneSpec,
    Supports,
    Touch,
    check_quaternion,
    first_mistake,
    parse_scene,
    read_scene,
)


class NamedNeighbour(NeighbourSpec):
    """Another object in the scene, known to the service."""

    object: Name = Field(description="name of an object known to the service")


def _beside_form(value: object) -> str:
    return "name" if isinstance(value, str) else "neighbour"


def _whole(value: str | NamedNeighbour) -> NamedNeighbour:
    return NamedNeighbour(object=value) if isinstance(value, str) else value


#: A neighbour as a request says it: a name, or the name with a pose.
BesideOption = Annotated[
    Annotated[Name, Tag("name")] | Annotated[NamedNeighbour, Tag("neighbour")],
    Discriminator(_beside_form),
    AfterValidator(_whole),
]


class SceneDocument(Part):
    """A scene that a request holds whole."""

    supports: Supports = Field(
        min_length=1, max_length=MOST_SUPPORTS, description="what the object stands on and among, scene frame, z up [m]"
    )
    target: Pose | None = Field(
        None, description="frame of the object in the scene: x y z [m], unit quaternion w x y z; absent: it is dropped"
    )
    neighbours: tuple[NamedNeighbour, ...] = Field(
        (),
        max_length=MOST_NEIGHBOURS,
        exclude_if=lambda value: not value,
        description="other objects: all with their poses, or all without, to be dropped around the target",
    )
    touch: Touch = Field(
        TOUCH,
        exclude_if=lambda value: value == TOUCH,
        description="distance that fingertips keep from the supports [mm], unless the request says so itself",
    )

    @model_validator(mode="after")
    def _turned(self) -> Self:
        if self.target is not None:
            check_quaternion(self.target)
        return self


def _form(value: object) -> str:
    return "document" if isinstance(value, dict | SceneDocument) else "kind"


#: A scene as a request says it: a kind, or a document. One of two forms, so that a mistake is told of the one meant.
SceneOption = Annotated[
    Annotated[Literal["free", "table", "bin", "shelf"], Tag("kind")] | Annotated[SceneDocument, Tag("document")],
    Discriminator(_form),
]


def scene_of(
    option: str | SceneDocument,
    *,
    faces: Literal["drawn", "all"] = "drawn",
    touch: float = TOUCH,
    beside: Sequence[NeighbourSpec] = (),
) -> SceneSpec:
    """The scene that a request means, with more neighbours than its document has.

    Raises:
        ValueError: the faces, the touch or the neighbours do not go with it, in one line.
    """
    try:
        if isinstance(option, SceneDocument):
            touch = option.touch if touch == TOUCH else touch
            return SceneSpec(
                kind="file",
                supports=option.supports,
                target=option.target,
                faces=faces,
                touch=touch,
                neighbours=(*option.neighbours, *beside),
            )
        return SceneSpec(kind=option, faces=faces, touch=touch, neighbours=tuple(beside))
    except ValidationError as error:
        raise ValueError(first_mistake(error)) from None


def known_name(text: str) -> str:
    """The name of an object; InputError for a file, which the service does not know yet."""
    if "/" in text or Path(text).is_file():
        raise InputError(f"the neighbour {text} is a file: `graspd objects add {text}` first, then give its name")
    return text


def scene_option(
    text: str, *, beside: Path | None = None, named: Callable[[str], str] = known_name
) -> str | dict[str, Any]:
    """What a request says for a scene that a user names: the kind, or the document in a file.

    Args:
        text: one of `KINDS`, or a JSON or YAML file.
        beside: folder in which the file lies; None: this one.
        named: from a neighbour as the file says it, a name or a path, to a name that the service knows.

    Raises:
        InputError: as `parse_scene`.
    """
    if text in KINDS:
        return text
    is_file = Path(text).suffix.lower() in SCENE_FILES
    found = read_scene(Path(text) if beside is None else beside / text) if is_file else parse_scene(text)
    said = found.model_dump(mode="json", include={"supports", "target", "neighbours"}, exclude_none=True)
    if found.touch != TOUCH:
        said["touch"] = found.touch
    for one in said["neighbours"]:
        one["object"] = named(one["object"])
    return said if said["neighbours"] else {key: value for key, value in said.items() if key != "neighbours"}
