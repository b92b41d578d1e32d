"""GraspGen's data: a JSON record per object in tar files, with an index, object lists and meshes.

Murali et al., GraspGen, ICRA 2026. docs/how-to/exchange/graspgen.md describes files and fields. `transforms` are poses
of the gripper's base link in the frame of the object, whose mesh is multiplied by `scale`. Further fields, which
GraspGen ignores, restore grasps of multi-fingered hands."""

import io
import json
import tarfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.baselines.autograsp import kernels
from graspd.baselines.autograsp.method import HandCloser
from graspd.baselines.common import load_pair
from graspd.exchange.imported import ImportedGrasps, add_postures, joints_by_name, scaled_object, write_mesh
from graspd.exchange.plan import ExportPart, ExportSummary, plain_name
from graspd.service.model.errors import InputError
from graspd.service.model.transforms import Floats, apply, pose_from_matrix, pose_to_matrix, quat_from_matrix
from graspd.service.store import validity
from graspd.worker.grasps import GraspSet, Posture
from graspd.worker.hands.jaws import jaws_of
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.planners.fast_graspd.candidates import posture_of
from graspd.worker.simulation.data import HandState

MEMBER: Final = "grasps.json"
INDEX: Final = "uuid_index.json"
POSTURES: Final = ("pregrasp", "grasp", "squeeze")
PER_SHARD: Final = 64  # number of objects in a tar file
LARGEST: Final = 256 * 2**20  # largest size of a record [bytes]; 2,000 grasps have half a megabyte
FEWEST: Final = 5  # number of good grasps below which GraspGen's generator skips an object
_ROTATION: Final = 1e-3  # tolerance of rotation matrices, which files have with six digits or more
_AT_ONCE: Final = 256  # number of hands in a batch of closing


def write(lots: Sequence[ExportPart], folder: Path, out: frozenset[str]) -> ExportSummary:
    """Write all validated grasps, failed ones included, in a folder per hand.
    `valid.txt` has the held-out objects, or all objects if none is held out."""
    if (folder / "grasps").exists():
        raise InputError(f"{folder} holds grasps already; give another folder as --output")
    done = ExportSummary({"grasps": 0, "good": 0, "objects": 0, "files": 0})
    meshes = {uuid_of(lot): lot.obj for lot in lots}
    (folder / "objects").mkdir(parents=True, exist_ok=True)
    for uuid, obj in meshes.items():
        write_mesh(obj, folder / "objects" / f"{uuid}.obj")
    _write_json(folder / "objects" / "map_uuid_to_path.json", {uuid: f"{uuid}.obj" for uuid in meshes})
    held = {uuid_of(lot) for lot in lots if lot.name in out}
    for hand in {lot.hand.digest: lot.hand for lot in lots}.values():
        _write_hand(hand, [lot for lot in lots if lot.hand.digest == hand.digest], folder, held, done)
    done.counts["objects"] = len(meshes)
    return done


def uuid_of(lot: ExportPart) -> str:
    """Return the object's name without dots, because WebDataset ends a key at the first dot."""
    return lot.name.replace(".", "-")


def _write_hand(hand: HandModel, lots: list[ExportPart], folder: Path, out: set[str], done: ExportSummary) -> None:
    name = plain_name(hand.name)
    uuids = sorted({uuid_of(lot) for lot in lots})
    records = {uuid: _record(hand, [lot for lot in lots if uuid_of(lot) == uuid]) for uuid in uuids}
    (folder / "grasps" / name).mkdir(parents=True)
    index: dict[str, int] = {}
    for number, first in enumerate(range(0, len(uuids), PER_SHARD)):
        with tarfile.open(folder / "grasps" / name / f"shard_{number:03}.tar", "w") as tar:
            for uuid in uuids[first : first + PER_SHARD]:
                data = json.dumps(records[uuid], allow_nan=False).encode()
                entry = tarfile.TarInfo(f"{uuid}.{MEMBER}")
                entry.size = len(data)
                tar.addfile(entry, io.BytesIO(data))
                index[uuid] = number
        done.counts["files"] += 1
    _write_json(folder / "grasps" / name / INDEX, index)
    (folder / "splits" / name).mkdir(parents=True, exist_ok=True)
    if not out:
        done.notes.append("only one object, in both train.txt and valid.txt")
    for split, some in (("train", set(uuids) - out), ("valid", set(uuids) & out if out else set(uuids))):
        (folder / "splits" / name / f"{split}.txt").write_text("".join(f"{uuid}\n" for uuid in sorted(some)))
    (folder / "grippers").mkdir(exist_ok=True)
    text = "".join(f"{key}: {json.dumps(value)}\n" for key, value in gripper_convention(hand).items())
    (folder / "grippers" / f"{name}.yaml").write_text(text)
    good = {uuid: sum(record["grasps"]["object_in_gripper"]) for uuid, record in records.items()}
    done.counts["grasps"] += sum(len(record["grasps"]["transforms"]) for record in records.values())
    done.counts["good"] += sum(good.values())
    if few := sorted(uuid for uuid, count in good.items() if count < FEWEST):
        done.notes.append(f"GraspGen's generator omits objects with fewer than {FEWEST} good grasps, such as {few[0]}")


def _record(hand: HandModel, lots: list[ExportPart]) -> dict[str, Any]:
    parts: dict[str, Any] = {}
    for name in POSTURES:
        some: list[Posture] = [getattr(lot.grasps, name).take(lot.rows) for lot in lots]
        parts[f"{name}_pose"] = np.concatenate([part.hand_pose for part in some])
        parts[f"{name}_joints"] = np.concatenate([part.joint_positions for part in some])
    held = np.concatenate([validity.valid_mask(lot.shard.arrays)[lot.rows] for lot in lots])
    grasps = {"transforms": pose_to_matrix(parts["grasp_pose"]).tolist(), "object_in_gripper": held.tolist()}
    return {
        "object": {"file": f"{uuid_of(lots[0])}.obj", "scale": 1.0},
        "grasps": grasps | {name: values.tolist() for name, values in parts.items()},
        "gripper": {"name": hand.name, "base_link": hand.root_link, "joint_names": list(hand.joint_names)},
    }


def gripper_convention(hand: HandModel) -> dict[str, Any]:
    """Return opening [m], reach along the approach [m], and GraspGen's frame, for a gripper's YAML file.
    The frame is a pose [[x, y, z], [x, y, z, w]] in the base link's frame, with z along the approach and x across the
    jaws. Without jaws, x is the direction across the approach in which open fingertips are farthest apart."""
    z, jaws = hand.palm.approach, jaws_of(hand)
    if jaws is not None:
        widest = int(np.argmax(jaws.width))
        x, width, depth = jaws.axis[widest], jaws.opening, float(jaws.middle[widest] @ z)
    else:
        poses = body_poses(hand, np.array([[0.0, 0, 0, 1, 0, 0, 0]]), hand.expand(hand.preshape[None]))[0]
        tips = poses[list(hand.fingertips), :3] if hand.fingertips else hand.palm.centre[None]
        apart = (tips[:, None] - tips).reshape(-1, 3)
        apart = apart - np.outer(apart @ z, z)
        x = apart[int(np.argmax(np.linalg.norm(apart, axis=1)))]
        width, depth = float(np.linalg.norm(x)), float((tips @ z).mean())
    x = x - (x @ z) * z
    if np.linalg.norm(x) < 1e-6:
        x = np.eye(3)[int(np.argmin(np.abs(z)))]
        x = x - (x @ z) * z
    x = x / np.linalg.norm(x)
    w, *xyz = quat_from_matrix(np.stack([x, np.cross(z, x), z], axis=1)).tolist()
    return {
        "width": width,
        "depth": depth,
        "transform_offset_from_asset_to_graspgen_convention": [[0.0, 0.0, 0.0], [*xyz, w]],
    }


def read(path: Path, *, hand: str, obj: str, object_name: str = "") -> list[ImportedGrasps]:
    """Read an object's record from a JSON file, a tar or a folder of tars.
    Fingers of a record without joints close until contact. Raises InputError: the record is missing or invalid."""
    file, record = _find_record(path, object_name)
    try:
        scale, grasps = float(record["object"]["scale"]), record["grasps"]
        matrices = np.asarray(grasps["transforms"], float)
        held = np.ravel(np.asarray(grasps["object_in_gripper"])).astype(bool)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{file} is no record of GraspGen: {error!r}") from None
    if matrices.shape != (len(held), 4, 4) or not len(held):
        raise InputError(f"{file} has transforms of shape {matrices.shape} for {len(held)} grasps")
    turns = matrices[:, :3, :3]
    if not np.abs(turns @ np.swapaxes(turns, 1, 2) - np.eye(3)).max() < _ROTATION or np.linalg.det(turns).min() < 0:
        raise InputError(f"{file} has transforms that are not poses")
    if not 0 < scale < np.inf:
        raise InputError(f"{file} has an object of scale {scale:g}")
    model, thing = hand_from_path(hand), scaled_object(obj, scale)
    pose = pose_from_matrix(matrices)
    made = _stored_grasps(file, model, record, pose) or add_postures(model, thing, close_hands_at(model, thing, pose))
    name = object_name or Path(str(record["object"].get("file", ""))).stem or thing.name
    return [ImportedGrasps(model, thing, made, name, scale, held.astype(np.int8))]


def _stored_grasps(file: str, hand: HandModel, record: dict[str, Any], pose: Floats) -> GraspSet | None:
    grasps, names = record["grasps"], record.get("gripper", {}).get("joint_names")
    if not names or not all(f"{name}_joints" in grasps for name in POSTURES):
        return None
    parts = []
    for name in POSTURES:
        joints = joints_by_name(hand, names, grasps[f"{name}_joints"], what=file)
        place = pose if name == "grasp" else np.asarray(grasps[f"{name}_pose"], float)
        if place.shape != pose.shape or len(joints) != len(pose):
            raise InputError(f"{file}: the numbers of pregrasps, grasps and squeezes differ")
        parts.append(Posture(place, joints))
    return GraspSet(parts[1], parts[0], parts[2], np.full(len(pose), np.nan))


def _find_record(path: Path, uuid: str) -> tuple[str, dict[str, Any]]:
    if path.suffix == ".json":
        try:
            with path.open("rb") as stream:
                return str(path), _parse_record(str(path), stream.read(LARGEST + 1))
        except OSError as error:
            raise InputError(f"{path} cannot be read: {error.strerror}") from None
    files = sorted(path.glob("*.tar")) if path.is_dir() else [path]
    names: list[str] = []
    found: tuple[str, dict[str, Any]] | None = None
    for file in files:
        try:
            # `r:` opens only uncompressed files, whose members cannot be larger than the file.
            with tarfile.open(file, "r:") as tar:
                for member in tar:
                    key, _, what = Path(member.name).name.partition(".")
                    if what != MEMBER or not member.isfile():
                        continue
                    names.append(key)
                    if found is None and uuid in ("", key):
                        content = tar.extractfile(member)
                        assert content is not None, "a plain file has content"
                        found = f"{file}: {key}", _parse_record(f"{file}: {key}", content.read(LARGEST + 1))
        except (OSError, tarfile.TarError) as error:
            raise InputError(f"{file} is no tar file: {error}") from None
    if found is None or (not uuid and len(names) > 1):
        there = f"it has {len(names)}, such as {', '.join(names[:5])}" if names else "it has none"
        raise InputError(f"{path}: {uuid!r} selects no single object; name one with --name: {there}")
    return found


def _parse_record(what: str, data: bytes) -> dict[str, Any]:
    if len(data) > LARGEST:
        raise InputError(f"{what} is larger than {LARGEST >> 20} MiB, too large for a record")
    try:
        record = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{what} is no JSON: {error}") from None
    if not isinstance(record, dict):
        raise InputError(f"{what} is no record of GraspGen: it is no JSON object")
    return record


def _write_json(path: Path, value: Any) -> None:
    path.write_text(json.dumps(value, indent=1) + "\n")


def close_hands_at(hand: HandModel, obj: ObjectModel, hand_pose: NDArray[np.float64]) -> Posture:
    """Return hands at poses (N, 7) in the object frame, closed from the preshape to contact or limits."""
    pair = load_pair(hand, obj, "cpu", kernels)
    joints = np.zeros((len(hand_pose), len(hand.joint_names)))
    for first in range(0, len(hand_pose), _AT_ONCE):
        pose = hand_pose[first : first + _AT_ONCE]
        palm = apply(pose, hand.palm.centre) - obj.centre_of_mass
        state = HandState(palm, pose[:, 3:], np.tile(hand.preshape, (len(pose), 1)))
        closed = HandCloser(pair, len(pose)).close(state)
        joints[first : first + len(pose)] = posture_of(hand, obj, closed).joint_positions
    return Posture(hand_pose, joints)
