"""Check of exported files: a library for each file's format opens the file."""

import csv
import json
import tarfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree

import h5py
import numpy as np
import yaml
from PIL import Image

from graspd.service.model.errors import GraspdError
from graspd.service.parquet import import_pyarrow


@contextmanager
def check_written_files(folder: Path) -> Iterator[None]:
    """Open all files that this context writes to a folder. Raises GraspdError: a library cannot read one."""
    before = _file_stamps(folder)
    yield
    for path, stamp in sorted(_file_stamps(folder).items()):
        if before.get(path) != stamp and (reader := READERS.get(path.suffix)):
            _open(path, *reader)


def _file_stamps(folder: Path) -> dict[Path, tuple[int, int]]:
    """Return time of change and size of each file."""
    found = ((path, path.stat()) for path in folder.rglob("*") if path.is_file())
    return {path: (stat.st_mtime_ns, stat.st_size) for path, stat in found}


def _open(path: Path, library: str, read: Callable[[Path], Any]) -> None:
    try:
        read(path)
    except ImportError:
        return  # an optional library that the writer did not need
    except Exception as error:  # libraries raise arbitrary exceptions
        why = " ".join(str(error).split())[:300]
        raise GraspdError(f"{path} was written but {library} cannot read it ({why}); report this") from error


def _check_usd(path: Path) -> None:
    from pxr import Usd

    stage = Usd.Stage.Open(str(path))
    if not stage.GetDefaultPrim().IsValid():
        raise ValueError("it has no default prim")


def _check_mesh(path: Path) -> None:
    import trimesh

    if trimesh.load_scene(path, process=False).is_empty:
        raise ValueError("it is empty")


def _check_csv(path: Path) -> None:
    with path.open(newline="", encoding="utf-8") as file:
        if len({len(row) for row in csv.reader(file)}) != 1:
            raise ValueError("its rows have different lengths")


def _check_hdf5(path: Path) -> None:
    with h5py.File(path) as file:
        file.visititems(lambda _, item: item[()] if isinstance(item, h5py.Dataset) else None)


def _check_tar(path: Path) -> None:
    with tarfile.open(path) as file:
        file.getnames()


def _check_png(path: Path) -> None:
    with Image.open(path) as image:
        image.verify()


def _check_exr(path: Path) -> None:
    import OpenEXR

    with OpenEXR.File(str(path)) as file:
        file.channels()


#: Library and function that open a file, by the suffix of the file's name.
READERS: Final[dict[str, tuple[str, Callable[[Path], Any]]]] = {
    ".xml": ("mujoco", lambda path: import_module("mujoco").MjModel.from_xml_path(str(path))),
    ".urdf": ("an XML parser", ElementTree.parse),
    ".usd": ("pxr", _check_usd),
    ".glb": ("trimesh", _check_mesh),
    ".obj": ("trimesh", _check_mesh),
    ".stl": ("trimesh", _check_mesh),
    ".yaml": ("PyYAML", lambda path: yaml.load(path.read_bytes(), getattr(yaml, "CSafeLoader", yaml.SafeLoader))),
    ".json": ("json", lambda path: json.loads(path.read_bytes())),
    ".jsonl": ("json", lambda path: [json.loads(line) for line in path.read_text().splitlines()]),
    ".csv": ("csv", _check_csv),
    # Pickles, which DexGraspBench has, are safe here, since graspd has just written the file.
    ".npy": ("NumPy", lambda path: np.load(path, allow_pickle=True)),
    ".npz": ("NumPy", np.load),
    ".h5": ("h5py", _check_hdf5),
    ".parquet": ("pyarrow", lambda path: import_pyarrow().parquet.ParquetFile(path).read_row_group(0)),
    ".tar": ("tarfile", _check_tar),
    ".png": ("Pillow", _check_png),
    ".exr": ("OpenEXR", _check_exr),
}
