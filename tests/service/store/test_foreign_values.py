"""A shard of a stranger holds its own values: none comes from another file, and none is made up."""

from __future__ import annotations

import resource
import zlib
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from graspd.service.model.errors import InputError, NotFoundError
from graspd.service.store.shards import read_shard
from tests.worker.files.test_curation import shard as base_shard


def external_link(file: h5py.File, secret: Path) -> None:
    file["grasp/hand_pose"] = h5py.ExternalLink(str(secret), "/secret")


def soft_link(file: h5py.File, _: Path) -> None:
    file["grasp/hand_pose"] = h5py.SoftLink("/pregrasp/hand_pose")


def external_storage(file: h5py.File, secret: Path) -> None:
    file.create_dataset("grasp/hand_pose", (4, 7), "f8", external=[(str(secret), 0, 4 * 7 * 8)])


def virtual(file: h5py.File, secret: Path) -> None:
    layout = h5py.VirtualLayout((4, 7), "f8")
    layout[:] = h5py.VirtualSource(str(secret), "secret", (4, 7))
    file.create_virtual_dataset("grasp/hand_pose", layout)


def made_up(file: h5py.File, _: Path) -> None:
    file.create_dataset("grasp/hand_pose", (50_000_000, 7), "f8", chunks=(4096, 7), fillvalue=1.0)


def deflated_zeros(file: h5py.File, _: Path) -> None:
    dataset = file.create_dataset("grasp/hand_pose", (50_000_000, 7), "f8", chunks=(1 << 20, 7), compression="gzip")
    piece = zlib.compress(bytes(dataset.chunks[0] * 7 * 8), 9)
    for start in range(0, 48 << 20, 1 << 20):
        dataset.id.write_direct_chunk((start, 0), piece)


def one_dataset_under_many_names(file: h5py.File, _: Path) -> None:
    file["grasp/hand_pose"] = np.zeros((1000, 7))
    for number in range(500):
        file[f"name{number}"] = file["grasp/hand_pose"]


def many(file: h5py.File, _: Path) -> None:
    for number in range(1200):
        file.create_group(f"g{number}")


@pytest.mark.parametrize(
    "change",
    [
        external_link,
        soft_link,
        external_storage,
        virtual,
        made_up,
        deflated_zeros,
        one_dataset_under_many_names,
        many,
    ],
)
@pytest.mark.parametrize("as_bytes", [False, True])
def test_values_from_elsewhere_are_refused(
    change: Callable[[h5py.File, Path], None], as_bytes: bool, tmp_path: Path
) -> None:
    secret, shard = tmp_path / "secret.h5", tmp_path / "shard.h5"
    with h5py.File(secret, "w") as file:
        file["secret"] = np.full((4, 7), 42.0)
    base_shard(shard, 1)
    with h5py.File(shard, "r+") as file:
        if "grasp/hand_pose" in file and change is not many:
            del file["grasp/hand_pose"]
        change(file, secret)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match=r"link|another file|claims|more than 1000"):
        read_shard(shard.read_bytes() if as_bytes else shard)
    # The file that makes values up claims 2.8 GB; KiB.
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 500 * 1024


def test_what_is_no_hdf5_is_told_in_our_words(tmp_path: Path) -> None:
    (tmp_path / "a.h5").write_text("no")
    with pytest.raises(InputError, match="not a readable HDF5 file; give a shard"):
        read_shard(tmp_path / "a.h5")
    for absent in (tmp_path / "absent.h5", tmp_path):
        with pytest.raises(NotFoundError, match="does not exist, or is no file"):
            read_shard(absent)
