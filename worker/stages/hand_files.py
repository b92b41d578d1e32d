"""Files of a hand in the store, its xacro expanded once: what a later expansion would give is another hand."""

from __future__ import annotations

from service.model import names
from service.model.states import AssetKind
from service.store.hand_files import format_of
from service.store.integrity import get_document, put_document
from service.store.library import load_asset_files
from service.store.store import Store
from worker.hands.load import main_file
from worker.hands.options import parse_options
from worker.hands.xacro import expand


def load_hand_files(store: Store, digest: str) -> dict[str, bytes]:
    """All files of a hand; in place of a xacro file the URDF that it expanded to at its first use.

    Raises:
        HandError: the options or the xacro file cannot be used.
        NotFoundError, DamagedError: see `load_asset_files`.
    """
    files = load_asset_files(store, AssetKind.HAND, digest)
    settings = parse_options(files)
    main = main_file(files, settings)
    if format_of(main, files[main]) != "xacro":
        return files
    key = names.hand_expanded(digest)
    if not store.exists(key):
        put_document(store, key, {"urdf": expand(files, main, settings.xacro).decode()})
    return {**files, main: str(get_document(store, key)["urdf"]).encode()}
