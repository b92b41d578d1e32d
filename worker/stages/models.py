"""The models that viewers show: made beside the check of an upload, or when a task first loads a hand or an object.

``python -m worker.stages.models`` writes those of the built-in hands and objects into `service/builtin/models/`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

from service.model import names
from service.model.fidelity import Fidelity
from service.model.states import AssetKind
from service.store.assets import builtin_files, builtin_names
from service.store.integrity import put_sealed
from service.store.store import Store
from worker.hands.load import load_hand
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.objects.prepare import load_object
from worker.stages.glb import hand_glb, object_glb

#: Simplification of a shown object [m]: that of the standard fidelity, so that people see what is grasped.
SHOWN_ERROR_M: Final = Fidelity().face_error_m
_BUILTIN: Final = Path(__file__).parents[2] / "service" / "builtin" / "models"


def model_of(kind: AssetKind, name: str, files: dict[str, bytes]) -> bytes:
    """Binary glTF of the hand or object that files describe; raises what loading it raises."""
    if kind is AssetKind.HAND:
        return hand_glb(load_hand(files, name=name, digest=""))
    return object_glb(load_object(files, name=name, digest="", face_error_m=SHOWN_ERROR_M))


def publish_model(store: Store, kind: AssetKind, model: HandModel | ObjectModel) -> None:
    """Put the glTF of a loaded hand or object into the store if it is not there."""
    key = names.asset_model(kind, model.digest)
    if not store.exists(key):
        put_sealed(store, key, hand_glb(model) if isinstance(model, HandModel) else object_glb(model))


def write_builtins(folder: Path = _BUILTIN) -> None:
    """Write the models of all built-in hands and objects."""
    folder.mkdir(exist_ok=True)
    for kind in AssetKind:
        for name in builtin_names(kind):
            (folder / f"{kind.value}-{name}.glb").write_bytes(model_of(kind, name, builtin_files(kind, name)))


if __name__ == "__main__":
    write_builtins()
