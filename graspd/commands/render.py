"""Command line: `graspd render`, `graspd pictures` and `graspd view`."""

from __future__ import annotations

import getpass
import os
import socket
from contextlib import closing
from pathlib import Path
from time import perf_counter
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray

from graspd.commands.grasp_sheet import GraspAnimation, GraspSheet, Kind
from graspd.service.cli import CommandGroup, JsonFlag, print_result, progress_bar, write_output
from graspd.service.model.errors import InputError
from graspd.service.model.scene_spec import scene_supports
from graspd.service.readers.trajectories import scene_spec_of, wrist_angles
from graspd.service.run.commands import stop_on_signals
from graspd.service.store import validity
from graspd.service.store.shards import Shard, read_shard, write_shard
from graspd.worker.engines.devices import Device
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.files.provenance import (
    INHERITED,
    hand_of_shard,
    id_of_columns,
    neighbours_of_shard,
    object_of_shard,
    source_attributes,
)
from graspd.worker.files.subsets import EveryOption, UnvalidatedOption, select_grasps
from graspd.worker.rendering import sheets
from graspd.worker.rendering.annotate import parse_channels
from graspd.worker.rendering.cameras import BASELINE_M, SAMPLED, read_cameras
from graspd.worker.rendering.hands import DrawnHand
from graspd.worker.rendering.scenery import TABLE
from graspd.worker.rendering.trajectory_pictures import animation_kind
from graspd.worker.rendering.views import Extras
from graspd.worker.rendering.views import render as render_views

app = CommandGroup(add_completion=False)

_Device = Annotated[str, typer.Option(help="Warp device: cpu, cuda:0, or auto.")]
_Object = Annotated[str | None, typer.Option(help="Object file; default: found by its digest.")]


@app.command(epilog="graspd render scenes.h5 --views 3 --stereo -o views.h5 --page views.png")
def render(
    scenes: Annotated[Path, typer.Argument(help="Scene shard, or base shard of grasps in scenes.")],
    views: Annotated[int, typer.Option(min=1, max=4096, help="Camera placements per scene.")] = 3,
    stereo: Annotated[bool, typer.Option("--stereo", help="Render a left and a right picture per placement.")] = False,
    baseline: Annotated[float, typer.Option(help="Stereo baseline [m].")] = BASELINE_M,
    width: Annotated[int | None, typer.Option(min=16, max=4096, help="Picture width [px]; default: 320.")] = None,
    height: Annotated[int | None, typer.Option(min=16, max=4096, help="Picture height [px]; default: 240.")] = None,
    channels: Annotated[str, typer.Option(help="More channels: distance, normals, occlusion, or all.")] = "",
    cameras: Annotated[Path | None, typer.Option(help="JSON file with intrinsics, poses, or both, of cameras.")] = None,
    with_hand: Annotated[Path | None, typer.Option(help="Base shard, to draw the best grasp of each scene.")] = None,
    hand: Annotated[str | None, typer.Option(help="Hand file; default: found by its digest.")] = None,
    with_: Annotated[list[str] | None, typer.Option("--with", help="File of a neighbour; default: built-in.")] = None,
    object: _Object = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of the cameras; default: that of the scenes.")] = None,
    device: _Device = "auto",
    output: Annotated[Path, typer.Option("--output", "-o", help="Views shard to write.")] = Path("views.h5"),
    page: Annotated[Path | None, typer.Option(help="Contact sheet of the views to write (PNG).")] = None,
    json: JsonFlag = False,
) -> None:
    """Render pictures of scenes: colour, depth, segmentation, boxes, and the `--channels` requested."""
    started = perf_counter()
    scene = _load_scenes(scenes)
    obj = object_of_shard(scene, object)
    number = int(scene.attributes.get("seed", 0)) if seed is None else seed  # type: ignore[arg-type]
    used = Device(device).resolve()
    given = read_cameras(cameras) if cameras is not None else SAMPLED
    size = (width or given.width or 320, height or given.height or 240)
    spec = scene_spec_of(scene)
    extras = Extras(
        channels=parse_channels(channels.split(",")),
        cameras=given,
        neighbours=neighbours_of_shard(scene, with_ or []),
        drawn=_drawn_hand(scene, with_hand, hand),
        supports=TABLE if spec is None else scene_supports(spec),
    )
    with progress_bar(quiet=json) as progress:
        result = render_views(
            obj,
            np.asarray(scene["scene/object_pose"], float),
            views=views,
            stereo=stereo,
            width=size[0],
            height=size[1],
            seed=number,
            baseline_m=baseline,
            extras=extras,
            run=ExecutionContext(used, progress=progress),
        )
    seconds = perf_counter() - started
    inherited = (*INHERITED, "neighbours", "neighbour_digests", "neighbour_sources")
    kept = {key: scene.attributes[key] for key in (*inherited, "scene") if key in scene.attributes}
    kept |= source_attributes(scene) | {"seed": number, "device": used, "seconds": round(seconds, 4)}
    write_output(output, write_shard("views", result, {**kept, "shard_id": id_of_columns(result)}))
    count = len(result["image/rgb"])
    if page is not None:
        title = f"Views of {scene.attributes.get('object', 'the object')}"
        subtitle = f"{count} pictures, {size[0]} x {size[1]} pixels"
        write_output(page, sheets.views_page(result, title=title, subtitle=subtitle))
    told = {"file": str(output), "pictures": count, "seconds": round(seconds, 2), "device": used}
    print_result(told, f"{output}: {count} pictures, {seconds:.1f} s on {used}", json=json)


@app.command(epilog="graspd pictures grasps.h5 -o sheet.png --three-sides")
def pictures(
    grasps: Annotated[Path, typer.Argument(help="Base shard, as written by `graspd synth`.")],
    count: Annotated[
        int | None,
        typer.Option("--count", "-n", min=1, max=400, help="Best grasps; default: 12, --trajectory 4, --animate 1."),
    ] = None,
    three: Annotated[bool, typer.Option("--three-sides", help="Draw each grasp from three sides.")] = False,
    trajectory: Annotated[bool, typer.Option("--trajectory", help="Draw the postures of each trajectory.")] = False,
    animate: Annotated[bool, typer.Option("--animate", help="Animate trajectories: .gif, .webp or .png.")] = False,
    row: Annotated[list[int] | None, typer.Option(min=0, help="Row of a grasp in the file; repeatable.")] = None,
    palette: Annotated[bool, typer.Option("--palette", help="Use 256 colours, for a third of the file size.")] = False,
    size: Annotated[
        int | None,
        typer.Option(min=32, max=2048, help="Edge of a picture [px]; default: 300, --three-sides 160, --animate 480."),
    ] = None,
    hand: Annotated[str | None, typer.Option(help="Hand file; default: found by its digest.")] = None,
    object: _Object = None,
    unvalidated: UnvalidatedOption = False,
    every: EveryOption = False,
    device: _Device = "auto",
    output: Annotated[Path, typer.Option("--output", "-o", help="PNG or animation to write.")] = Path("grasps.png"),
    json: JsonFlag = False,
) -> None:
    """Draw the best valid grasps by epsilon with their metrics on one sheet, in their scenes if any."""
    if trajectory + three + animate > 1:
        raise InputError("--trajectory, --three-sides and --animate exclude one another")
    if animate:
        animation_kind(output.suffix)
    base = read_shard(grasps, kind="base")
    chosen, word = select_grasps(base, unvalidated=unvalidated, every=every)
    if row:
        rows = _named_rows(base, row, chosen, word)
    else:
        rows = sheets.best_rows(base.arrays, count or (1 if animate else 4 if trajectory else 12), chosen)
    among = int(chosen.sum())
    models = (hand_of_shard(base, hand), object_of_shard(base, object), rows)
    run = ExecutionContext(Device(device).resolve())
    if animate:
        page = GraspAnimation(base, *models, run, size).encode(output.suffix)
    else:
        kind: Kind = "trajectory" if trajectory else "three sides" if three else "one side"
        subtitle = f"{len(rows)} of {among} {word}{'' if row else ', by epsilon at 5 mm'}"
        page = GraspSheet(base, *models, kind, run, size).png(subtitle=subtitle)
    write_output(output, sheets.reduce_to_palette(page) if palette and not animate else page)
    told = {"file": str(output), "grasps": len(rows), "of": among, "kind": word, "rows": rows.tolist()}
    print_result(told, f"{output}: {'' if row else 'the best '}{len(rows)} of {among} {word}", json=json)


def _named_rows(base: Shard, rows: list[int], chosen: NDArray[np.bool_], word: str) -> NDArray[np.intp]:
    for row in rows:
        if row >= len(chosen):
            raise InputError(f"{base.path} has the rows 0 to {len(chosen) - 1}: there is no row {row}")
        if not chosen[row]:
            raise InputError(f"row {row} of {base.path} is not among its {word}; --all permits every row")
    return np.array(rows, np.intp)


def _load_scenes(path: Path) -> Shard:
    shard = read_shard(path)
    if shard.kind == "base" and "scene/object_pose" not in shard.arrays:
        raise InputError(f"{path} has free grasps: a scene shard is needed here; make one: graspd scene")
    if shard.kind == "views":
        raise InputError(f"{path} is a views shard; a scene shard is needed here")
    return shard


def _drawn_hand(scene: Shard, base_file: Path | None, hand: str | None) -> DrawnHand | None:
    """Return the best grasp of each scene: a valid one, or for `--with-hand` a clear one."""
    if scene.kind == "base":
        unvalidated = not validity.valid_mask(scene.arrays).any()
        return sheets.best_grasps_drawn(scene, hand_of_shard(scene, hand), unvalidated=unvalidated)
    source = np.asarray(scene["grasp/base_index"])
    if base_file is None or not len(source):
        return None
    base = read_shard(base_file, kind="base")
    model = hand_of_shard(scene, hand)
    hand_of_shard(base, hand)
    if source.max() >= len(base["grasp/joint_positions"]):
        raise InputError(f"{base_file} has fewer grasps than its scenes refer to; give the base shard of these scenes")
    rows = sheets.best_transferred_rows(scene.arrays, base.arrays)
    joints = np.asarray(base["grasp/joint_positions"], float)[source[rows]]
    poses = np.asarray(scene["grasp/hand_pose"], float)[rows]
    return DrawnHand(model, rows, poses, joints, wrist_angles(scene, rows))


@app.command(epilog="graspd view grasps.h5")
def view(
    grasps: Annotated[Path, typer.Argument(help="Base shard, as written by `graspd synth`.")],
    host: Annotated[str, typer.Option(help="Address to bind; all who reach it see the grasps.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="First port to try; 0: any free port.")] = 8080,
    hand: Annotated[str | None, typer.Option(help="Hand file; default: found by its digest.")] = None,
    object: _Object = None,
) -> None:
    """Show grasps in 3D in the browser: hand, object, scene, contacts, trajectory. Ends with Ctrl-C."""
    from graspd.worker.viewing import Viewer, ViewerContent, missing_viewer_text

    if said := missing_viewer_text():
        raise InputError(said)
    base = read_shard(grasps, kind="base")
    shown = ViewerContent(base, hand_of_shard(base, hand), object_of_shard(base, object), neighbours_of_shard(base, []))
    ended = stop_on_signals()
    with closing(Viewer(shown, host=host, port=port)) as viewer:
        typer.echo(f"{grasps}: {viewer.url}")
        command = forwarding_command(viewer.server.get_port())
        typer.echo(f"from another machine: run {command}, then open the same address; Ctrl-C ends the viewer")
        ended.wait()


def forwarding_command(port: int) -> str:
    """Return the ssh command that forwards a port of this machine's loopback to the user's machine."""
    # Third word: address at which sshd was reached.
    connection = os.environ.get("SSH_CONNECTION", "").split()
    host = connection[2] if len(connection) == 4 else socket.gethostname()
    return f"ssh -L {port}:127.0.0.1:{port} {getpass.getuser()}@{host}"
