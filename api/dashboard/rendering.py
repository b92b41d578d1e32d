"""Rendering of templates, and redirects with a message."""

import time
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote, unquote

from fastapi import Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse
from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape

from graspd.api import formatting
from graspd.api.access.auth import is_allowed, may_change
from graspd.api.access.keys import Scope
from graspd.api.middleware.request_context import add_prefix
from graspd.service.model.version import PACKAGE_VERSION

_HERE: Final = Path(__file__).parent
STATIC: Final = _HERE / "static"
#: Pages with keyboard shortcuts, their first letters; then all pages of the navigation.
_WITH_KEYS: Final = ("jobs", "datasets", "grasps", "hands", "objects", "workers")
NAVIGATION: Final = (("/", "Home"), *((f"/{name}", name.capitalize()) for name in (*_WITH_KEYS, "usage", "engine")))
#: Cookie with a message for the next page.
_TOAST: Final = "graspd_toast"
#: Parameters of pages that the API does not have.
_NO_FILTERS: Final = ("view", "cursor", "done")
#: Cookie with the number of the last end of a job or dataset that the visitor has seen.
SEEN: Final = "graspd_seen"
MOST_UNREAD: Final = 100
#: Keyboard shortcuts of pages.
KEYS: Final = {f"/{page}": page[0] for page in _WITH_KEYS}


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
    """Render a page; `page` is its navigation entry, by default the first part of its path.

    `events` is its update stream, `poll_s` an interval [s].
    """
    page = f"/{request.url.path.split('/')[1]}"
    defaults = {"page": page, "events": "", "refresh_s": 0, "poll_s": 0, "health": request.app.state.overview.health()}
    context = defaults | context
    may_read = is_allowed(request, Scope.READ)
    has_bell = may_read and context["health"] is not None and context["health"].parts["index"].latency_ms is not None
    ends = request.app.state.webhooks.own_ends(seen_end(request), limit=MOST_UNREAD) if has_bell else []
    context |= {
        "template": template,
        "path": request.url.path,
        "filters": {key: value for key, value in request.query_params.items() if value and key not in _NO_FILTERS},
        "base_url": base_url(request),
        "docs_url": request.app.state.settings.docs_url,
        "navigation": NAVIGATION if may_read else (),
        "unread": len(ends) if has_bell else None,
        "toast": unquote(toast := request.cookies.get(_TOAST, "")),
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
    response = HTMLResponse(text, status_code=status, headers={"Cache-Control": "no-store"})
    if toast:
        response.delete_cookie(_TOAST, httponly=True, samesite="strict")
    return response


def redirect(where: str, toast: str) -> RedirectResponse:
    """Send the browser to another page, which shows the message `toast` once."""
    response = RedirectResponse(where, status_code=303)
    response.set_cookie(_TOAST, quote(toast), max_age=60, httponly=True, samesite="strict")
    return response


def seen_end(request: Request) -> int:
    """Return the number of the last end that the visitor has seen; by default, that of yesterday."""
    seen = request.cookies.get(SEEN, "")
    return int(seen) if seen.isascii() and seen.isdigit() and len(seen) < 18 else int(1000 * (time.time() - 86400))


def base_url(request: Request) -> str:
    """Return the address of the service in the visitor's browser, without a trailing slash."""
    return f"{str(request.base_url).rstrip('/')}{request.app.state.settings.api_root_path or ''}"


def problem_page(request: Request, problem: dict[str, Any]) -> Response:
    if problem["status"] == 401:
        return RedirectResponse("/login", status_code=303)
    return render(request, "problem.html", status=problem["status"], page="", problem=problem, health=None)
