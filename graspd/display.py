"""Display of grasps: as a pandas table, as HTML in a notebook, and in the viewer of `graspd view`."""

from __future__ import annotations

import base64
import math
import time
from html import escape
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from graspd.service.model.errors import InputError
from graspd.service.model.transforms import POSE_PARTS

if TYPE_CHECKING:
    from graspd.grasps import Grasps
    from graspd.worker.viewing import Viewer

#: Number of grasps in a notebook's picture, edge of each [px], and time limit of path tracing [s].
PICTURED: Final = 4
EDGE: Final = 220
PICTURE_S: Final = 10.0
PICTURE_BYTES: Final = 300_000
#: Columns of the table shown if no picture can be drawn.
_FIGURES: Final = ("epsilon", "contact_area_cm2", "penetration_depth_mm")
#: Postures other than the grasp: prefix of their names, and their columns.
_MORE: Final = {
    "pregrasp.": ("pregrasp/hand_pose", "pregrasp/joint_positions"),
    "squeeze.": ("squeeze/hand_pose", "squeeze/joint_positions"),
    "lift.": ("grasp/lift", ""),
}


def data_frame_of(grasps: Grasps) -> Any:
    try:
        import pandas
    except ModuleNotFoundError:
        raise InputError("to_pandas needs pandas; install it: pip install 'graspd[pandas]'") from None
    columns = grasps.columns
    found: dict[str, Any] = {"object": columns["object"], "valid": grasps.is_valid}

    def add_columns(before: str, pose: str, joints: str) -> None:
        if pose in columns:
            found.update({before + part: columns[pose][:, k] for k, part in enumerate(POSE_PARTS)})
        for k, joint in enumerate(grasps.joint_names if joints in columns else ()):
            # A joint of a gantry may be named x, like a column of the pose.
            found[before + (joint if before + joint not in found else f"joint.{joint}")] = columns[joints][:, k]

    add_columns("", "grasp/hand_pose", "grasp/joint_positions")
    found |= {name: grasps.metric(name) for name in grasps.metrics}
    for path, data in columns.items():
        name = path.rpartition("/")[2]
        if path.startswith(("grasp/", "quality/")) and data.shape == (len(grasps),) and name not in found:
            found[name] = data
    for before, paths in _MORE.items():
        add_columns(before, *paths)
    return pandas.DataFrame(found)


def grasps_html(grasps: Grasps) -> str:
    """Return `repr` and a picture of the best grasps as HTML.
    A table of their metrics replaces a picture that is missing or too large."""
    head = f"<p>{escape(repr(grasps))}</p>"
    try:
        png = sheet_png(grasps, PICTURED, EDGE, PICTURE_S)
    # A notebook must display its grasps even if a file, engine or driver is missing.
    except Exception:
        png = b""
    if not 0 < len(png) <= PICTURE_BYTES:
        return head + _table(grasps)
    data = base64.b64encode(png).decode()
    return f'{head}<img alt="the best grasps" style="max-width:100%" src="data:image/png;base64,{data}">'


def start_viewer(grasps: Grasps, *, host: str, port: int) -> Viewer:
    try:
        from graspd.worker.files.provenance import hand_of_shard, neighbours_of_shard, object_of_shard
        from graspd.worker.viewing import Viewer, ViewerContent, missing_viewer_text
    except ModuleNotFoundError as error:
        raise ImportError(f"view needs {error.name}; run pip install 'graspd[worker,view]'") from error
    if said := missing_viewer_text():
        raise InputError(said)
    shard = grasps.shard()
    hand, obj = hand_of_shard(shard, None), object_of_shard(shard, None)
    return Viewer(ViewerContent(shard, hand, obj, neighbours_of_shard(shard, [])), host=host, port=port)


def sheet_png(grasps: Grasps, count: int, edge: int, limit_s: float = math.inf) -> bytes:
    """Return a PNG of the best grasps, `edge` pixels each; raise TaskCancelled after `limit_s`."""
    from graspd.commands.grasp_sheet import GraspSheet
    from graspd.worker.engines.devices import Device
    from graspd.worker.execution_context import ExecutionContext
    from graspd.worker.files.provenance import hand_of_shard, object_of_shard

    shard, until = grasps.shard(), time.monotonic() + limit_s
    rows = _best_rows(grasps, count)
    if not len(rows):
        raise InputError("there is no grasp to draw")
    hand, obj = hand_of_shard(shard, None), object_of_shard(shard, None)
    run = ExecutionContext(Device("auto").resolve(), cancelled=lambda: time.monotonic() > until)
    return GraspSheet(shard, hand, obj, rows, "one side", run, edge).png(subtitle=f"best {len(rows)} by epsilon")


def _table(grasps: Grasps) -> str:
    rows = _best_rows(grasps, PICTURED)
    names = [name for name in _FIGURES if name in grasps.metrics]
    head = "".join(f"<th>{escape(name)}</th>" for name in ("row", "valid", *names))
    values = {name: grasps.metric(name) for name in names}
    body = "".join(
        f"<tr><td>{row}</td><td>{'yes' if grasps.is_valid[row] else 'no'}</td>"
        + "".join(f"<td>{values[name][row]:.3g}</td>" for name in names)
        + "</tr>"
        for row in rows
    )
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def _best_rows(grasps: Grasps, count: int) -> np.ndarray:
    """Return rows of the best `count` grasps by epsilon, valid ones first."""
    epsilon = np.nan_to_num(np.asarray(grasps.metric("epsilon"), float), nan=-1.0)
    return np.lexsort((-epsilon, ~grasps.is_valid))[:count]
