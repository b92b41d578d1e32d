"""`graspd demo`: run the whole service in this folder, send it one job, and write a page of results."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Annotated, Any, Final

import typer
from rich.console import Console

from graspd.api.formatting import count, duration
from graspd.api.models import JobDetail
from graspd.client.client import Client
from graspd.client.reports import JobDisplay, job_summary, mean_metrics, yield_of
from graspd.display import sheet_png
from graspd.grasps import open as open_grasps
from graspd.service.cli import CommandGroup, JsonFlag, load_settings, plain_console, print_json, write_output
from graspd.service.command_options import validate_options
from graspd.service.model.domain import JobRequest
from graspd.service.model.errors import TaskError
from graspd.service.model.states import State
from graspd.service.run.supervisor import Supervisor
from graspd.service.store.shards import read_shard

app = CommandGroup()
_SHOWN_GRASPS: Final = 12
#: Edge of a grasp's picture [px].
_EDGE: Final = 300


@app.command("demo", epilog="graspd demo --out demo-out --grasps 32 --scenes 2 --views 3")
def demo(
    out: Annotated[Path, typer.Option(help="Folder for the service's data and the results.")] = Path("demo-out"),
    hand: Annotated[str, typer.Option(help="Built-in hand.")] = "allegro",
    object: Annotated[str, typer.Option(help="Built-in object.")] = "mug",
    grasps: Annotated[int, typer.Option("--grasps", "-n", help="Number of grasps.")] = 32,
    scenes: Annotated[int, typer.Option(help="Scenes per batch of grasps.")] = 2,
    views: Annotated[int, typer.Option(help="Stereo pairs per scene.")] = 3,
    fidelity: Annotated[str, typer.Option(help="Fidelity: draft, standard or fine.")] = "standard",
    seed: Annotated[int, typer.Option(help="The same seed gives the same grasps.")] = 0,
    json: JsonFlag = False,
) -> None:
    """Make grasps, scenes and pictures of built-in data, and a results page."""
    asked: dict[str, Any] = {"hand": hand, "object": object, "grasps": grasps, "fidelity": fidelity, "seed": seed}
    request = validate_options(JobRequest, asked | {"scenes": scenes, "views": views, "stereo": views > 0})
    console = plain_console(stderr=json)
    out.mkdir(parents=True, exist_ok=True)
    settings = load_settings(data_dir=out / "service", host="127.0.0.1", port=0)
    with Supervisor(settings, workers=1) as service:
        with console.status("starting Redis, API, controller and a worker"):
            service.wait_ready(say=lambda line: console.print(line, soft_wrap=True))
        console.print(f"the service runs at {service.api_url} until the job is done")
        with Client(service.api_url) as client:
            job, files = run_job(client, request, out, console)
    results = write_pages(out, job, files)
    if json:
        print_json(job_summary(job) | results)
    else:
        print_results(console, job, results)


def run_job(client: Client, request: JobRequest, out: Path, console: Console) -> tuple[JobDetail, list[Path]]:
    """Submit the job, watch it, and fetch its files; return the job and its shards."""
    job = client.submit(request)
    console.print(f"job {job.id[:12]}: {request.grasps} grasps of {request.hand} on {request.object}")
    with JobDisplay(console) as display:
        job = client.wait(job.id, display.show)
    if job.state is not State.SUCCEEDED:
        raise TaskError(f"the job {job.state.value}: {job.reason or 'no reason recorded'}")
    folder = out / "shards"
    folder.mkdir(exist_ok=True)
    files = [client.save(shard.file, folder / f"{shard.kind}-{shard.batch:04}.h5") for shard in job.shards]
    return job, sorted(files)


def print_results(console: Console, job: JobDetail, paths: dict[str, list[str] | str]) -> None:
    console.print(f"{yield_of(job)}; {mean_metrics(job)}")
    for stage in job.stages:
        console.print(f"{stage.stage.value:<11} {count(stage.tasks)} × {duration(stage.seconds / stage.tasks)}")
    console.print()
    for what, some in paths.items():
        for path in some if isinstance(some, list) else [some]:
            console.print(f"{what.removesuffix('s'):<8} {path}", soft_wrap=True)


def write_pages(out: Path, job: JobDetail, shards: list[Path]) -> dict[str, list[str] | str]:
    """Write a sheet of the best grasps, views of the first batch, and index.html; return all paths."""
    from graspd.worker.rendering.sheets import views_page

    pages: dict[str, bytes] = {}
    bases = [path for path in shards if path.name.startswith("base")]
    views = [path for path in shards if path.name.startswith("views")]
    if bases and len(grasps := open_grasps(bases[0])):
        pages["grasps.png"] = sheet_png(grasps, _SHOWN_GRASPS, _EDGE)
    if views:
        title = f"Views of the {job.object}"
        data = read_shard(views[0], kind="views")
        subtitle = f"{len(data['image/rgb'])} pictures of {job.request.scenes} scenes; depth in metres"
        pages["views.png"] = views_page(data.arrays, title=title, subtitle=subtitle)
    pictures = [out / name for name in pages]
    pages["index.html"] = html_page(job, pictures, shards, out).encode()
    for name, content in pages.items():
        write_output(out / name, content)
    return {"shards": [*map(str, shards)], "pictures": [*map(str, pictures)], "page": str(out / "index.html")}


def html_page(job: JobDetail, pictures: list[Path], shards: list[Path], out: Path) -> str:
    """Return an HTML page that works without server or script."""
    title = f"{escape(job.hand)} × {escape(job.object)}"
    figure = '<figure><a href="{0}"><img src="{0}" alt="{1}"></a></figure>'
    images = "".join(figure.format(picture.name, _ALT[picture.stem]) for picture in pictures)
    files = "".join(f"<li><a href='{p.relative_to(out)}'>{p.relative_to(out)}</a></li>" for p in shards)
    return _HTML.format(title=title, yields=escape(yield_of(job)), job=job.id, images=images, files=files)


_ALT: Final = {"grasps": "The best grasps with their quality", "views": "Rendered views with depth and segmentation"}
_HTML: Final = """<!doctype html>
<html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{title}</title>
<style>
:root {{ color-scheme: light dark; font: 16px/1.5 system-ui, sans-serif; }}
body {{ max-width: 1180px; margin: 40px auto; padding: 0 20px; }}
figure {{ margin: 24px 0; }} img {{ max-width: 100%; border-radius: 8px; }} code {{ overflow-wrap: anywhere; }}
</style>
<h1>{title}</h1>
<p>{yields}. Job <code>{job}</code>.</p>
{images}
<h2>Files</h2><ul>{files}</ul>
</html>
"""
