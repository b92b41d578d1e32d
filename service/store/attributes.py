"""The root attributes of shards: each one's type and meaning, and which kinds have it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from service.model.errors import InputError

Attribute = str | int | float | list[str]


@dataclass(frozen=True)
class RootAttribute:
    """One root attribute of a shard."""

    type: str
    """text, integer, number or texts."""
    description: str
    kinds: tuple[str, ...] = ("base", "scene", "views")


_TYPES: Final[Mapping[str, tuple[type, ...]]] = {
    "text": (str,),
    "integer": (int,),
    "number": (int, float),
    "texts": (list,),
}
_BASE: Final = ("base",)

ATTRIBUTES: Final[dict[str, RootAttribute]] = {
    "schema": RootAttribute("text", "`graspd/base@1`, `graspd/scene@1` or `graspd/views@1`"),
    "hand": RootAttribute("text", "name of the hand"),
    "hand_digest": RootAttribute("text", "digest of the files it came from"),
    "hand_source": RootAttribute("text", "where a command of this machine read it, if it is not built in"),
    "object": RootAttribute("text", "name of the object"),
    "object_digest": RootAttribute("text", "digest of the files it came from"),
    "object_source": RootAttribute("text", "where a command of this machine read it, if it is not built in"),
    "object_options": RootAttribute("text", "with which options the mesh was read, as JSON"),
    "object_mass_kg": RootAttribute("number", "mass that the object has in simulation [kg]", _BASE),
    "object_friction": RootAttribute("number", "Coulomb coefficient of its contacts in simulation", _BASE),
    "object_scale": RootAttribute("number", "imported grasps: scale of the object's mesh", _BASE),
    "method": RootAttribute("text", "planner"),
    "fidelity": RootAttribute("text", "its knobs, as JSON"),
    "seed": RootAttribute("integer", "with the batch and the digests, all that decides the result"),
    "batch": RootAttribute("integer", "number of the batch in its job, or of the first of several"),
    "batch_rows": RootAttribute("text", "JSON: rows of each of several batches, in order; absent: there is one", _BASE),
    "device": RootAttribute("text", "on what it was made"),
    "seconds": RootAttribute("number", "in how long"),
    "created": RootAttribute("text", "when, RFC 3339"),
    "code_version": RootAttribute("text", "by which graspd"),
    "shard_id": RootAttribute("text", "its name in the store"),
    "inputs": RootAttribute("texts", "names of the shards it was made from"),
    "joint_names": RootAttribute("texts", "order of the hand's joints", _BASE),
    "wrist_joint_names": RootAttribute(
        "texts",
        "joints of the wrist above the hand's root, order of `grasp/wrist_positions`; absent: none",
        ("base", "scene"),
    ),
    "root_link": RootAttribute("text", "link of the hand whose pose is given"),
    "mu": RootAttribute("number", "Coulomb coefficient of `quality/epsilon` and `quality/wrench_volume`", _BASE),
    "want": RootAttribute(
        "text", "valid: valid grasps were asked for (sound ones where nobody judges); raw: of any kind", _BASE
    ),
    "tried": RootAttribute("integer", "grasps tried until the last one kept", _BASE),
    "outcomes": RootAttribute("text", "JSON: tries that were not kept, by what became of them", _BASE),
    "reason": RootAttribute("text", "why a command found fewer grasps than asked for; absent: it did not", _BASE),
    "grasps_wanted": RootAttribute("integer", "grasps asked for, where a command was interrupted before", _BASE),
    "robust": RootAttribute(
        "text",
        "JSON: models around the nominal one in which each valid grasp was judged, and the wanted share; absent: none",
        _BASE,
    ),
    "verdict_level": RootAttribute("text", "level of the referee, or `none` where nobody judged", _BASE),
    "verdict_key": RootAttribute(
        "text",
        "digest of all that its verdicts follow from; verdicts of different keys must not be mixed in one number",
        _BASE,
    ),
    "scene": RootAttribute(
        "text", "where the grasps were planned, if not around a free object, as JSON", ("base", "scene", "views")
    ),
    "source": RootAttribute("text", "imported grasps: an address or a citation", _BASE),
    "licence": RootAttribute("text", "imported grasps: the terms on which they may be used", _BASE),
    "base_shard": RootAttribute(
        "text",
        "the shard whose grasps were carried over, or were planned in the scenes that are shown",
        ("scene", "views"),
    ),
    "scene_shard": RootAttribute("text", "the shard whose scenes are shown, or hold the grasps", ("base", "views")),
    "neighbours": RootAttribute("texts", "names of the objects beside it"),
    "neighbour_digests": RootAttribute("texts", "digests of their files"),
    "neighbour_sources": RootAttribute("texts", "where a command of this machine read them; empty: built in"),
}


def check_attributes(kind: str, said: Mapping[str, Attribute]) -> None:
    """Raises InputError for an attribute that a shard of this kind does not have, or whose type is another."""
    for name, value in said.items():
        known = ATTRIBUTES.get(name)
        if known is None or kind not in known.kinds:
            raise InputError(f"a {kind} shard has no root attribute {name!r}")
        if not isinstance(value, _TYPES[known.type]):
            raise InputError(f"root attribute {name} is {value!r}; the schema says {known.type}")
