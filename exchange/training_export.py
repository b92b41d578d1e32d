"""Export of shards as training folders of other projects: grasps, pictures, splits by object family.

Objects of a family have similar distributions of the distance between two random surface points (D2 of Osada et al.,
"Shape distributions", 2002), relative to its root mean square. Moved, mirrored, scaled or remeshed copies are equal."""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Final

import numpy as np

from graspd.exchange.inputs import case_of_shard
from graspd.exchange.lerobot import EpisodesPart
from graspd.exchange.plan import ExportOptions, ExportPart, ExportSummary, held_out_objects, plain_name
from graspd.service.model.errors import InputError
from graspd.service.model.transforms import Floats
from graspd.service.readers import Pictures, Shards
from graspd.service.readers.clouds import COLUMNS
from graspd.service.readers.depth_noise import parse_depth_noise
from graspd.service.store import validity
from graspd.service.store.shards import Shard, read_shard
from graspd.worker.files.provenance import hand_of_shard, object_of_shard
from graspd.worker.files.subsets import open_source, select_grasps
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel


def export_training(source: str, format_: str, wishes: ExportOptions, folder: Path) -> ExportSummary:
    """Write the grasps of all shards of a folder or a dataset in a training format.
    Raises InputError: the share is invalid, no shard has suitable grasps, or the format refuses them."""
    from graspd.exchange import dexlearn, graspgen, huggingface, lerobot

    shards = open_source(source)
    if format_ == "lerobot":
        episodes = lerobot.episode_parts(shards, wishes.obj, every=wishes.every)
        return lerobot.write(episodes, folder, split_objects(episodes, wishes.held_out))
    lots = list(export_parts(shards, format_, wishes))
    out = split_objects(lots, wishes.held_out)
    if format_ == "graspgen":
        return graspgen.write(lots, folder, out)
    columns = COLUMNS if format_ == "dexlearn" else (*COLUMNS, "image/rgb")
    pictures = Pictures(shards, columns, grasp_quality=(), valid=not wishes.every, unvalidated=wishes.unvalidated)
    writer = dexlearn.write if format_ == "dexlearn" else huggingface.write
    return writer(lots, pictures, folder, out, parse_depth_noise(wishes.noise or None))


def export_bench(source: str, wishes: ExportOptions, split: str, folder: Path) -> ExportSummary:
    """Write grasps of a split (`train`, `test`; "": all) in DexGraspBench's layout, shard by shard.
    Raises InputError like `export_training`, or the split is empty."""
    from graspd.exchange.dexgraspbench import BenchExport

    shards, format_ = open_source(source), "dexgraspbench"
    out = split_objects(export_parts(shards, format_, wishes), wishes.held_out) if split else frozenset()
    writer, count = BenchExport(folder), 0
    for lot in export_parts(shards, format_, wishes):
        if not split or (lot.name in out) == (split == "test"):
            prefix = f"{lot.id_hash}-" if len(shards.of_kind("base")) > 1 else ""
            writer.write(lot.hand, lot.obj, lot.grasps, lot.rows.tolist(), lot.placed, name=lot.name, prefix=prefix)
            count += len(lot.rows)
    if not count:
        raise InputError(f"no object is in the split {split}, since all objects are of one family")
    return ExportSummary({"grasps": count, "objects": len(writer.objects), "files": count})


def export_parts(shards: Shards, format_: str, wishes: ExportOptions) -> Iterator[ExportPart]:
    """Yield the selected grasps of each base shard; hands and one object at a time stay in memory.
    Raises InputError: no shard has such grasps."""
    digests: dict[str, str] = {}
    hands: dict[str, HandModel] = {}
    last: tuple[list[str], ObjectModel] | None = None
    refused = InputError("there is no base shard, so there are no grasps")
    for file in shards.of_kind("base"):
        shard = read_shard(shards.path(file), kind="base")
        try:
            rows = np.flatnonzero(_exported_rows(shard, format_, wishes))
        except InputError as error:
            refused = error
            continue
        hand, *which = (str(shard.attributes.get(key)) for key in _MODELS)
        if hand not in hands:
            hands[hand] = hand_of_shard(shard, wishes.hand)
        if last is None or last[0] != which:
            last = which, object_of_shard(shard, wishes.obj)
        case = case_of_shard(shard, hands[hand], last[1])
        name = plain_name(case.obj.name)
        if digests.setdefault(name, case.obj.digest) != case.obj.digest:
            name = f"{name}-{case.obj.digest[:8]}"
        verdict = np.asarray(shard.arrays.get("quality/success", np.full(len(case.grasps), -1)), np.int8)
        yield ExportPart(file.id, name, case.hand, case.obj, case.grasps, rows, verdict, shard, case.placed)
    if not digests:
        raise refused


#: Attributes that select a shard's hand, and its object.
_MODELS: Final = ("hand_digest", "object_digest", "object_mass_kg", "object_friction", "fidelity")


def _exported_rows(shard: Shard, format_: str, wishes: ExportOptions) -> np.ndarray:
    """Return a mask (N,) of exported grasps: with failed ones for GraspGen, whose format has labels."""
    if format_ != "graspgen":
        return select_grasps(shard, unvalidated=wishes.unvalidated, every=wishes.every)[0]
    validated = validity.validated_mask(shard.arrays)
    if wishes.unvalidated or not validated.any():
        raise InputError(f"{format_} needs a verdict on each grasp: make grasps without --validation none")
    return validated


#: Number of point pairs, and compared quantiles of their distances.
PAIRS: Final = 40_000
QUANTILES: Final = np.linspace(0.01, 0.99, 50)
#: Root mean square difference of quantiles below which two shapes are similar. Turned, mirrored, scaled and simplified
#: (3 mm) copies of 14 scanned objects differ by at most 0.0043, the two most similar objects by 0.0095. Too large
#: families hardly affect a split; too small ones put copies into both of its parts.
SAME: Final = 0.006


def shape_signature(obj: ObjectModel) -> Floats:
    """Return (50,) quantiles of the distance between two surface points, divided by its root mean square."""
    corners = np.asarray(obj.vertices, float)[np.asarray(obj.faces)]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    rng = np.random.default_rng(0)
    face = rng.choice(len(area), size=(2, PAIRS), p=area / area.sum())
    weights = rng.dirichlet((1.0, 1.0, 1.0), size=(2, PAIRS))
    first, second = np.einsum("spk,spkx->spx", weights, corners[face])
    distance = np.linalg.norm(first - second, axis=1)
    return np.asarray(np.quantile(distance, QUANTILES) / np.sqrt(np.mean(distance**2)))


def split_objects(lots: Iterable[ExportPart | EpisodesPart], share: float) -> frozenset[str]:
    """Return the names of the held-out objects. Raises InputError: the share is not between 0 and 1."""
    if not 0 < share < 1:
        raise InputError(f"--held-out is {share:g}; give a share of the objects between 0 and 1")
    known: dict[str, tuple[str, Floats]] = {}
    for lot in lots:
        if lot.name not in known:
            known[lot.name] = lot.obj.digest, shape_signature(lot.obj)
    return held_out_objects(object_families(known), share)


def object_families(known: Mapping[str, tuple[str, Floats]]) -> dict[str, str]:
    """Return each object's family: the least digest of all objects that a chain of similar ones connects.
    `known` has the digest and the `shape_signature` of each object."""
    names = sorted(known, key=lambda name: known[name][0])
    found = np.array([known[name][1] for name in names]).reshape(len(names), len(QUANTILES))
    family: dict[str, str] = {}
    for k, name in enumerate(names):
        apart = np.sqrt(np.mean((found[:k] - found[k]) ** 2, axis=1))
        like = {family[names[j]] for j in np.flatnonzero(apart < SAME)} | {known[name][0]}
        family[name] = min(like)
        family = {other: min(like) if of in like else of for other, of in family.items()}
    return family
