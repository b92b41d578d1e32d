"""HTTP application. It keeps no state between requests that another process would need."""

import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from typing import Any, Final

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from fastapi.staticfiles import StaticFiles

from graspd.api import problems
from graspd.api.access.auth import Proxy
from graspd.api.access.keys import KeyFile
from graspd.api.dashboard import pages
from graspd.api.dashboard.rendering import STATIC, problem_page
from graspd.api.formatting import is_loopback
from graspd.api.metrics import Metrics
from graspd.api.middleware.limits import BodyLimit, RateLimit, Rates
from graspd.api.middleware.request_context import HeadMethod, RequestContext, RootPath, SameOrigin, host_name
from graspd.api.routes import assets, datasets, grasps, jobs, system
from graspd.api.routes.assets import asset_router
from graspd.api.routes.dependencies import EXPORTS, FORMS, UPLOADS, RequestLimiter, install_services
from graspd.service.index.rebuild import mark_complete_if_new
from graspd.service.model.errors import InputError, UnavailableError
from graspd.service.model.states import AssetKind
from graspd.service.model.version import PACKAGE_VERSION
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.identity import identify_if_redis_answers
from graspd.service.queue.connection import redis_url
from graspd.service.settings import Settings

_log = logging.getLogger("graspd.api")
#: Routers of all resources except assets and datasets, in the order of the OpenAPI document.
_ROUTERS: Final = (
    *(jobs.router, grasps.router, jobs.shard_router, system.router, assets.correction_router, grasps.tag_router),
    *(system.usage_router, system.event_router, system.deletion_router),
)
_LOOPBACK_NAMES = frozenset({"127.0.0.1", "localhost", "::1"})


def create_app(settings: Settings, services: Services | None = None) -> FastAPI:
    """Create the application; without `services` it opens its own, and closes them at its end."""
    proxy = Proxy(settings)
    keys = KeyFile(settings.resolved_keys_file, closed=proxy.is_on)
    if not (proxy.is_on or keys.has_live_key or is_loopback(settings.host)):
        problem = f"{settings.host} is reachable from other machines and there is no valid key"
        raise InputError(f"{problem}; make one with `graspd keys add NAME --scope admin`, or bind 127.0.0.1")
    opened = services or Services.open(settings)
    if services is None:
        identify_if_redis_answers(opened)
    with suppress(UnavailableError):
        mark_complete_if_new(opened.index, opened.store)
    rates = Rates(redis_url(settings))

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        yield
        await rates.close()
        if services is None:
            opened.close()

    app = FastAPI(
        title="graspd",
        version=PACKAGE_VERSION,
        description="Grasp datasets as a service. Errors are application/problem+json (RFC 9457).",
        docs_url=None,
        redoc_url=None,
        lifespan=lifespan,
        # A redirect would follow the Host header.
        redirect_slashes=False,
    )
    app.state.settings = settings
    app.state.keys, app.state.proxy, app.state.metrics = keys, proxy, Metrics()
    install_services(app, opened)
    app.state.uploads, app.state.forms, app.state.exports = map(RequestLimiter, (UPLOADS, FORMS, EXPORTS))
    app.state.replays = RequestLimiter(1)
    problems.install_handlers(app, problem_page)
    pages.install_dashboard(app, opened)
    for router in (*_ROUTERS, *map(asset_router, AssetKind), *datasets.routers, *pages.routers):
        # Adds the routes built at import. `include_router` would rebuild them at the first request. It would also
        # silence warnings for the whole process, which is unsafe while another application is built.
        app.router.routes.extend(router.routes)
    app.mount("/static", StaticFiles(directory=STATIC), name="static")
    _add_middleware(app, settings, keys, proxy, rates)
    app.openapi = lambda: _openapi(app)  # type: ignore[method-assign]
    return app


def _add_middleware(app: FastAPI, settings: Settings, keys: KeyFile, proxy: Proxy, rates: Rates) -> None:
    """Add middleware, innermost first."""
    app.add_middleware(HeadMethod)
    uploads = frozenset({*(f"/v1/{kind.value}s" for kind in AssetKind), "/submit"})
    app.add_middleware(BodyLimit, upload_paths=uploads, upload_bytes=settings.max_upload_bytes)
    app.add_middleware(RateLimit, keys=keys, proxy=proxy, settings=settings, rates=rates)
    allowed = _LOOPBACK_NAMES | {host_name(settings.host)} if keys.is_open else None
    app.add_middleware(SameOrigin, allowed_hosts=allowed)
    app.add_middleware(RequestContext, metrics=app.state.metrics)
    if prefix := settings.api_root_path:
        first = prefix.split("/")[1]
        if first in {str(getattr(route, "path", "/")).split("/")[1] for route in app.routes}:
            raise InputError(f"GRASPD_API_ROOT_PATH: the service itself uses the path /{first}; choose another path")
        app.add_middleware(RootPath, prefix=prefix)


def _openapi(app: FastAPI) -> dict[str, Any]:
    """Return the OpenAPI document, with problem documents in place of FastAPI's own error schema."""
    if app.openapi_schema is None:
        document = get_openapi(title=app.title, version=app.version, description=app.description, routes=app.routes)
        schemas = document["components"]["schemas"]
        del schemas["HTTPValidationError"], schemas["ValidationError"]
        problem = problems.Problem.model_json_schema(ref_template="#/components/schemas/{model}")
        schemas |= problem.pop("$defs")
        schemas["Problem"] = problem
        for path, operations in document["paths"].items():
            for method, operation in operations.items():
                answers = operation["responses"]
                if "application/json" in answers.get("422", {}).get("content", {}):
                    answers["422"] = problems.problem_responses(422)[422]
                for status, answer in problems.problem_responses(*_middleware_statuses(path, method)).items():
                    answers.setdefault(str(status), answer)
        if app.state.settings.api_root_path:
            document["servers"] = [{"url": app.state.settings.api_root_path}]
        app.openapi_schema = document
    return app.openapi_schema


def _middleware_statuses(path: str, method: str) -> list[int]:
    """Return the statuses that middleware or the errors of the catalog may send; routes declare others."""
    statuses = [421]
    if path.startswith(("/v1/", "/metrics")):
        statuses += [400, 401, 403, 404, 429, 503]
    if method not in ("get", "head"):
        statuses += [403, 408, 409, 413, 415]
    return statuses
