"""What is found of an uploaded network: whose grasps it proposes, and that its file can be read at all.

Reading one is arithmetic on bounded arrays, so the front door does it before anything is kept; no worker is needed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from service.model.digests import digest_bytes
from service.model.errors import InputError
from service.store.assets import asset_json
from service.store.descriptions import parse_description
from service.store.network_file import from_bytes

#: Name of the file in its archive, whatever the user called it: the same network is the same asset.
NETWORK_FILE: Final = "network.npz"


def network_bytes(files: Mapping[str, bytes], what: str) -> bytes:
    """The network's file among those of an asset; that it is one is for `from_bytes` to say.

    Args:
        files: the file and `asset.json`.
        what: what errors call it.

    Raises:
        InputError: it is not there, or `asset.json` says what a network does not have.
    """
    described = parse_description(asset_json(files), what)
    if described.file not in files:
        raise InputError(f"{what}: the main file {described.file!r} is not among its files")
    if extra := sorted(described.model_extra or {}):
        raise InputError(f"{what}: a network has no {extra[0]!r}; it may have a description, a licence and a source")
    return files[described.file]


def network_report(files: Mapping[str, bytes], name: str) -> dict[str, Any]:
    """What is found of a network that can be used, as a check says it.

    Raises:
        LimitError: larger than any network.
        InputError: no network.
    """
    data = network_bytes(files, name)
    network = from_bytes(data, name)
    joints = len(network.joint_names)
    facts = {
        "hand": network.hand,
        "hand_digest": network.hand_digest,
        "joints": joints,
        "points": network.points,
        "steps": network.steps,
        "about": "".join(letter for letter in " ".join(network.about.split()) if letter.isprintable()),
        # What shards of `graspd synth` name, which knows the file alone.
        "file_digest": digest_bytes(data),
    }
    message = f"{name}: proposes grasps of {network.hand} ({network.hand_digest[:12]}), {joints} joints"
    return {"verdict": "accept", "message": message, "repairs": [], "facts": facts}


def check_network(files: Mapping[str, bytes], name: str) -> dict[str, Any]:
    """The same, or a refusal."""
    try:
        return network_report(files, name)
    except InputError as error:
        return {"verdict": "refuse", "message": str(error), "repairs": [], "facts": {}}
