"""Dataset as a folder for dataset hubs: tables, tar files, card, Croissant file, checksums.

The folder is complete or absent: files are written below `.FOLDER.part`, each under a temporary name, and this folder
is renamed at the end. A repeated call continues an interrupted one. One shard or picture at a time is in memory."""

import json
import re
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np

from graspd.exchange import huggingface, webdataset
from graspd.exchange.opening import check_written_files
from graspd.exchange.plan import held_out_objects, plain_name
from graspd.exchange.training_export import object_families, shape_signature
from graspd.service import parquet
from graspd.service.model.digests import digest_json, file_sha256
from graspd.service.model.errors import ConflictError, InputError, NotFoundError, UnavailableError
from graspd.service.model.version import PACKAGE_VERSION
from graspd.service.readers import Pictures, ShardFile
from graspd.service.readers.clouds import COLUMNS
from graspd.service.store import validity
from graspd.service.store.integrity import CHECKSUMS
from graspd.service.store.shards import read_shard
from graspd.studies.cards.card import write_card
from graspd.studies.cards.contents import Contents
from graspd.studies.cards.page import render_croissant
from graspd.worker.files.provenance import object_of_shard
from graspd.worker.files.subsets import require_empty_folder

RECORD: Final = "publication.json"
#: Numbers of base shards, and of pictures, in a file.
SHARDS_A_FILE: Final = 200
PICTURES_A_FILE: Final = 1000
SPLITS: Final = ("train", "test")
_TABLES: Final = {"grasps": huggingface.GRASPS, "pictures": huggingface.PICTURES}
_TYPES: Final = {"text": "sc:Text", parquet.IMAGE: "sc:ImageObject"}
#: Folders of data files.
DATA: Final = (*_TABLES, "webdataset")
_STATED: Final = ("licence", "source", "digest")
_KINDS: Final = ("hands", "objects")
_REPOSITORY: Final = re.compile(r"[\w.-]+/[\w.-]+")
#: Called with the numbers of finished and of all parts of the current step, and the step.
Progress = Callable[[float, float, str], None]


@dataclass(frozen=True)
class PublicationOptions:
    """Options of `graspd datasets publish`."""

    licence: str = ""
    source: str = ""
    every: bool = False
    held_out: float = 0.2
    webdataset: bool = True
    accept_unknown_licences: bool = False


def publish(contents: Contents, folder: Path, options: PublicationOptions, progress: Progress, name: str = "") -> None:
    """Write the folder, unless it exists; its card tells readers to load `name`, by default the folder.
    Raises InputError: a licence is unknown, or pyarrow is missing. ConflictError: the folder has other content."""
    parquet.import_pyarrow()
    folder, unknown = folder.resolve(), _unknown_licences(contents, options)
    shards = digest_json(sorted(file.id for file in contents.shards))
    asked = {"dataset": contents.name, "shards": shards, "graspd": PACKAGE_VERSION, "name": name, **asdict(options)}
    if _read_record(folder, asked):
        return
    draft = folder.with_name(f".{folder.name}.part")
    require_empty_folder(folder)
    record = _read_record(draft, asked)
    if record is None:
        require_empty_folder(draft)
        draft.mkdir(parents=True, exist_ok=True)
        record = asked | {"test": sorted(_test_objects(contents, options.held_out))}
        _write_whole(draft / RECORD, lambda file: _write_json(file, record))
    with check_written_files(draft):
        _write_data(contents, draft, frozenset(record["test"]), options, progress)
        files = {table: sorted(draft.glob(f"{table}/*")) for table in DATA}
        splits = [split for split in SPLITS if any(file.name.startswith(split) for file in files["grasps"])]
        publication = {
            "name": name or folder.name,
            "configs": huggingface.table_configs([table for table in _TABLES if files[table]], splits),
            "tars": bool(files["webdataset"]),
            "unknown": unknown,
        }
        said: dict[str, Any] = {"licence": options.licence, "source": options.source, "publication": publication}
        card = write_card(contents, draft, progress=lambda done, total: progress(done, total, "card"), **said)
        assets = {
            kind: {one["name"]: {key: one[key] for key in _STATED} for one in card["composition"][kind]}
            for kind in _KINDS
        }
        _write_json(draft / "licences.json", {"dataset": options.licence or None, **assets})
        if contents.snapshot is not None:
            (draft / "snapshot.json").write_text(contents.snapshot.model_dump_json(indent=1) + "\n")
        sums = {file: file_sha256(file) for found in files.values() for file in found}
        facts = [{"name": str(f.relative_to(draft)), "size": f.stat().st_size, "sha256": s} for f, s in sums.items()]
        tables = {
            table: {name: _croissant_type(word) for name, word in columns.items()}
            for table, columns in _TABLES.items()
            if files[table]
        }
        (draft / "croissant.json").write_text(render_croissant(card, facts, tables))
    written = sorted(file for file in draft.rglob("*") if file.is_file() and file.name != CHECKSUMS)
    lines = (f"{sums.get(file) or file_sha256(file)}  {file.relative_to(draft)}\n" for file in written)
    (draft / CHECKSUMS).write_text("".join(lines))
    draft.rename(folder)


def _unknown_licences(contents: Contents, options: PublicationOptions) -> list[str]:
    kinds = {"hand": contents.hands, "object": contents.objects}
    unknown = [f"{kind} {one.name}" for kind, of in kinds.items() for one in of.values() if not one.licence]
    unknown = [*([] if options.licence else ["the dataset itself"]), *unknown]
    if unknown and not options.accept_unknown_licences:
        some = ", ".join(unknown[:5]) + (f" and {len(unknown) - 5} others" if len(unknown) > 5 else "")
        raise InputError(
            f"the licence is unknown of {some}; state it by --licence, and for assets by --assets FILE, or accept "
            "this by --accept-unknown-licences, which the card then says"
        )
    return unknown


def _read_record(folder: Path, asked: dict[str, Any]) -> dict[str, Any] | None:
    """Return the record of a publication with these contents and options; None if there is no publication."""
    if not (folder / RECORD).is_file():
        return None
    found: dict[str, Any] = json.loads((folder / RECORD).read_bytes())
    if other := [key for key, value in asked.items() if found.get(key) != value]:
        raise ConflictError(f"{folder} is a publication with another {', '.join(other)}; remove it, or name another")
    return found


def _test_objects(contents: Contents, share: float) -> frozenset[str]:
    """Return the objects of held-out families, from one base shard of each; none if the share is 0."""
    known = {}
    firsts = {file.object: file for file in reversed(contents.shards.of_kind("base"))} if share else {}
    for name, file in firsts.items():
        try:
            obj = object_of_shard(read_shard(contents.shards.path(file), kind="base"), None, contents.shards.store)
        except NotFoundError as error:
            raise NotFoundError(f"the split needs all objects, but {error}, or make no split: --held-out 0") from None
        known[name] = obj.digest, shape_signature(obj)
    return held_out_objects(object_families(known), share)


def _write_data(
    contents: Contents, draft: Path, test: frozenset[str], options: PublicationOptions, progress: Progress
) -> None:
    for split in SPLITS:
        mine = tuple(file for file in contents.shards if (file.object in test) == (split == "test"))
        base = [file for file in mine if file.kind == "base"]
        starts = range(0, len(base), SHARDS_A_FILE)
        for number, first in enumerate(starts):
            progress(number, len(starts), f"grasps of {split}")
            rows = _grasp_rows(contents, base[first : first + SHARDS_A_FILE], every=options.every)
            _write_table(draft / "grasps" / f"{split}-{number:05}.parquet", huggingface.GRASPS, rows)
        shards = replace(contents.shards, files=mine)
        if not shards.of_kind("views"):
            continue
        names = {file.id: plain_name(file.object) for file in base}
        seen = Pictures(shards, (*COLUMNS, "image/rgb"), grasp_quality=(), valid=not options.every)
        for number, some in enumerate(parts := _parts(seen)):
            progress(number, len(parts), f"pictures of {split}")
            rows = huggingface.picture_rows(seen, some, names)
            _write_table(draft / "pictures" / f"{split}-{number:05}.parquet", huggingface.PICTURES, rows)
        if options.webdataset:
            # Hugging Face's reader infers types from the first samples, and fails if their lists of grasps are empty.
            samples = webdataset.open_pictures(shards, valid=not options.every, with_grasps_only=True)
            for number, some in enumerate(parts := _parts(samples)):
                progress(number, len(parts), f"tar files of {split}")
                tar = draft / "webdataset" / f"{split}-{number:06}.tar"
                _write_whole(tar, partial(webdataset.write_tar, samples, some))


def _parts(pictures: Pictures) -> list[range]:
    starts = range(0, len(pictures), PICTURES_A_FILE)
    return [range(first, min(first + PICTURES_A_FILE, len(pictures))) for first in starts]


def _grasp_rows(contents: Contents, files: list[ShardFile], *, every: bool) -> Iterator[list[dict[str, Any]]]:
    for file in files:
        shard = read_shard(contents.shards.path(file), kind="base")
        rows = np.flatnonzero(validity.valid_mask(shard.arrays) | every)
        if len(rows):
            yield huggingface.grasp_rows(shard, file.id, plain_name(file.object), rows)


def _write_table(file: Path, columns: dict[str, str], groups: Iterator[list[dict[str, Any]]]) -> None:
    if (first := next(groups, None)) is not None:
        schema = parquet.arrow_schema(columns)
        _write_whole(file, lambda part: parquet.write(part, schema, chain([first], groups)))


def _write_whole(file: Path, write: Callable[[Path], Any]) -> None:
    """Write a file under a temporary name, unless it exists."""
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        part = file.with_name(f".{file.name}")
        write(part)
        part.replace(file)


def _write_json(file: Path, value: Any) -> None:
    file.write_text(json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def _croissant_type(word: str) -> tuple[str, str]:
    """Return Croissant's type and shape of a column; the last suffix of a type's name is the outer list."""
    kind, lengths = word.split("[")[0], re.findall(r"\[(\d*)\]", word)
    return _TYPES.get(kind, f"cr:{kind.capitalize()}"), ",".join(length or "-1" for length in reversed(lengths))


class Hub:
    """A dataset repository of Hugging Face's hub, or of a server with its API at HF_ENDPOINT."""

    def __init__(self, repository: str) -> None:
        """Raises InputError: name or huggingface_hub is missing; UnavailableError: the login is refused."""
        if not _REPOSITORY.fullmatch(repository):
            raise InputError(f"{repository!r} is no repository; give --to hf://ORGANISATION/NAME")
        try:
            from huggingface_hub import HfApi
        except ModuleNotFoundError:
            raise InputError("uploads need huggingface_hub; install it: pip install 'graspd[hub]'") from None
        self.repository, self._api = repository, HfApi()
        self._call(self._api.whoami)

    def upload(self, folder: Path, *, public: bool) -> str:
        """Upload a folder as one commit; return its address. Data files of an earlier upload are replaced."""
        name, kind = self.repository, "dataset"
        self._call(self._api.create_repo, name, repo_type=kind, private=not public, exist_ok=True)
        options = {"repo_type": kind, "delete_patterns": [f"{table}/*" for table in DATA]}
        said = f"graspd {PACKAGE_VERSION}: {folder.name}"
        done = self._call(self._api.upload_folder, repo_id=name, folder_path=folder, commit_message=said, **options)
        return str(done.commit_url)

    def _call(self, method: Callable[..., Any], *args: Any, **options: Any) -> Any:
        try:
            return method(*args, **options)
        except Exception as error:  # its errors, and those of its HTTP library
            problem = f"{self.repository} cannot be published: {' '.join(str(error).split())[:300]}"
            raise UnavailableError(f"{problem}; repeat the command to go on") from None
