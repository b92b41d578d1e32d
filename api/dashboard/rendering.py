"""Rendering of templates, and code snippets that load a job's files."""

from pathlib import Path
from typing import Any, Final

from fastapi import Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse
from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape

from graspd.api import formatting
from graspd.api.access.auth import is_allowed, may_change
from graspd.api.access.keys import Scope
from graspd.api.middleware.request_context import add_prefix
from graspd.api.models import GraspDetail, JobDetail
from graspd.service.model.version import PACKAGE_VERSION

_HERE: Final = Path(__file__).parent
STATIC: Final = _HERE / "static"
NAVIGATION: Final = (
    ("/", "Home"),
    ("/jobs", "Jobs"),
    ("/datasets", "Datasets"),
    ("/grasps", "Grasps"),
    ("/hands", "Hands"),
    ("/objects", "Objects"),
    ("/workers", "Workers"),
    ("/chart", "Chart"),
    ("/stability", "Stability"),
)
#: Keyboard shortcuts of pages.
KEYS: Final = {f"/{page}": page[0] for page in ("jobs", "datasets", "grasps", "hands", "objects", "workers")}
#: Pages shown only if requests need a key: usage belongs to the projects of keys.
_WITH_KEYS: Final = (("/usage", "Usage"),)


def environment() -> Environment:
    """Create the template environment: it escapes everything and rejects unknown names."""
    made = Environment(
        loader=FileSystemLoader(_HERE / "templates"),
        autoescape=select_autoescape(),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters.update(formatting.FILTERS)
    return made


def render(request: Request, template: str, *, status: int = 200, **context: Any) -> HTMLResponse:
    """Render a page; `page` is its navigation entry, `events` its update stream, `poll_s` an interval [s]."""
    defaults = {"page": "", "events": "", "refresh_s": 0, "poll_s": 0, "health": request.app.state.overview.health()}
    context = defaults | context
    context |= {
        "navigation": NAVIGATION if request.app.state.keys.is_open else NAVIGATION + _WITH_KEYS,
        "keys": KEYS,
        "version": PACKAGE_VERSION,
        "signed_in": not request.app.state.keys.is_open,
        # Actions that the key does not permit have no button; routes also refuse them.
        "may_submit": is_allowed(request, Scope.SUBMIT),
        "may_change": may_change,
        "grace_s": request.app.state.settings.shard_grace_s,
        "price_unit": request.app.state.settings.price_unit,
    }
    text = request.app.state.templates.get_template(template).render(context)
    text = add_prefix(text, request.app.state.settings.api_root_path or "")
    return HTMLResponse(text, status_code=status, headers={"Cache-Control": "no-store"})


def base_url(request: Request) -> str:
    """Return the address of the service in the visitor's browser, without a trailing slash."""
    return f"{str(request.base_url).rstrip('/')}{request.app.state.settings.api_root_path or ''}"


def problem_page(request: Request, problem: dict[str, Any]) -> Response:
    if problem["status"] == 401:
        return RedirectResponse("/login", status_code=303)
    return render(request, "problem.html", status=problem["status"], problem=problem, health=None)


def job_loader_code(job: JobDetail, base_url: str) -> str:
    if not any(shard.kind == "base" for shard in job.shards):
        return ""
    return f"""import graspd  # pip install 'graspd[api]'

with graspd.Client("{base_url}") as client:  # key="..." where the service asks for one
    grasps = client.job("{job.id}").grasps()
best = grasps.valid().top("epsilon", 10)
best.hand_pose        # (N, 7) x y z [m], quaternion w x y z
best.joint_positions  # (N, J) rad or m, in the order of best.joint_names
print(grasps)"""


def curl_commands(job: JobDetail, base_url: str) -> str:
    return "\n".join(f"curl -fL -o {shard.kind}-{shard.batch:04}.h5 {base_url}{shard.file}" for shard in job.shards)


def grasp_loader_code(grasp: GraspDetail, base_url: str) -> str:
    return f"""import graspd  # pip install 'graspd[api]'

with graspd.Client("{base_url}") as client:  # key="..." where the service asks for one
    grasp = client.shard("{grasp.shard_id}")[{grasp.row}]
grasp.hand_pose  # (7,) x y z [m], quaternion w x y z
grasp.joints     # position of each joint by its name, rad or m"""
