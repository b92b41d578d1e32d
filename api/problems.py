"""Errors as `application/problem+json` (RFC 9457): domain errors by slug, HTTP errors by status."""

import errno
from collections.abc import Callable
from http import HTTPStatus
from typing import Any, Final

from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, ConfigDict, Field
from starlette.exceptions import HTTPException
from starlette.routing import Match

from graspd.service.model.base import problem_text
from graspd.service.model.errors import GraspdError, InputError, LimitError, NotFoundError, RateError, StoreUnavailable

MEDIA_TYPE: Final = "application/problem+json"
RETRY_AFTER_S: Final = 2
_FULL_SAID: Final = "the disk of this service is full; the same request succeeds once there is space"
_LONGEST_POINTER: Final = 200
_MOST_ERRORS: Final = 100

#: Slug and meaning of errors outside the domain errors, by status.
HTTP_PROBLEMS: Final = {
    400: ("bad-request", "The body or form cannot be read."),
    401: ("unauthorized", "A valid key is required."),
    403: ("forbidden", "The scope of the key is insufficient, or the request comes from another web site."),
    405: ("method-not-allowed", "The address does not support this method."),
    408: ("request-timeout", "The body arrives too slowly."),
    415: ("unsupported-media-type", "The body is compressed or otherwise encoded; send it unencoded."),
    416: ("range-not-satisfiable", "The byte range starts after the end of the file."),
    421: ("misdirected-request", "The service does not accept this host name while it has no keys."),
}
_HTTP_SLUGS: Final = {status: slug for status, (slug, _) in HTTP_PROBLEMS.items()}
_HTTP_SLUGS.update((error.status, error.slug) for error in (NotFoundError, LimitError, InputError, RateError))


class FieldError(BaseModel):
    """One error in a request."""

    pointer: str = Field(description="JSON pointer into the body, or the name of the parameter")
    detail: str
    type: str = Field(description="identifier of the broken rule")


class Problem(BaseModel):
    """RFC 9457 problem details."""

    model_config = ConfigDict(extra="allow")

    type: str = Field(description="URI reference of the problem type; its page describes it")
    title: str
    status: int
    detail: str = Field(description="the error and its fix, in one line")
    instance: str = Field(description="path of the request")
    request_id: str | None = Field(None, description="equal to header X-Request-Id and the id in the log")
    errors: list[FieldError] | None = None


class ApiError(Exception):
    """HTTP error outside the domain errors: authentication, limits, a cross-site form."""

    def __init__(self, status: int, detail: str, *, headers: dict[str, str] | None = None) -> None:
        super().__init__(detail)
        self.status = status
        self.headers = headers or {}


def problem_response(
    request: Request,
    *,
    slug: str,
    title: str,
    status: int,
    detail: str,
    errors: list[FieldError] | None = None,
    headers: dict[str, str] | None = None,
) -> JSONResponse:
    problem = Problem(
        type=f"{request.app.state.settings.api_root_path or ''}/problems/{slug}",
        title=title,
        status=status,
        detail=detail,
        instance=request.url.path,
        request_id=request_id_of(request),
        errors=errors,
    )
    headers = dict(headers or {})
    if status in (429, 503):
        headers.setdefault("Retry-After", str(RETRY_AFTER_S))
    content = problem.model_dump(exclude_none=True)
    return JSONResponse(content, status_code=status, media_type=MEDIA_TYPE, headers=headers)


def describe_error(error: Exception) -> tuple[str, str, int, str]:
    """Return (slug, title, status, detail) of an exception; unexpected errors reveal no internals."""
    if isinstance(error, GraspdError):
        return error.slug, error.title, error.status, replace_surrogates(str(error)) or error.title
    if _is_disk_full(error) or _is_disk_full(error.__cause__):
        return StoreUnavailable.slug, StoreUnavailable.title, StoreUnavailable.status, _FULL_SAID
    if isinstance(error, ApiError):
        status, detail = error.status, str(error)
    elif isinstance(error, HTTPException):
        status, detail = error.status_code, str(error.detail)
    else:
        detail = "an unexpected error; the log has it under this request id"
        return GraspdError.slug, GraspdError.title, GraspdError.status, detail
    return _HTTP_SLUGS.get(status, "internal"), HTTPStatus(status).phrase, status, detail


def _is_disk_full(error: BaseException | None) -> bool:
    """Check whether the disk was full; FastAPI hides this cause behind a bad request."""
    return isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT)


def replace_surrogates(text: str) -> str:
    """Replace lone surrogates, which JSON may contain but UTF-8 cannot encode."""
    return text.encode(errors="replace").decode()


def error_response(request: Request, error: Exception) -> JSONResponse:
    slug, title, status, detail = describe_error(error)
    headers = dict(getattr(error, "headers", None) or {})
    if isinstance(error, HTTPException) and status == 404:
        detail = f"there is no {request.url.path}"
    if isinstance(error, HTTPException) and status == 405:
        detail = f"{request.method} is not possible on {request.url.path}"
        # The router lists only the methods of the first matching route.
        if allowed := _allowed_methods(request):
            headers["Allow"] = ", ".join(allowed)
    return problem_response(request, slug=slug, title=title, status=status, detail=detail, headers=headers)


def _allowed_methods(request: Request) -> list[str]:
    """Return the methods of all routes at the path of a request (RFC 9110 §15.5.6)."""

    def is_allowed(method: str) -> bool:
        scope = dict(request.scope) | {"method": "GET" if method == "HEAD" else method}
        return any(route.matches(scope)[0] is Match.FULL for route in request.app.routes)

    return [method for method in ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE") if is_allowed(method)]


def validation_answer(request: Request, error: RequestValidationError) -> JSONResponse:
    errors = [_field_error(entry) for entry in error.errors()]
    is_syntax = any(entry.type == "json_invalid" for entry in errors)
    first = errors[0]
    where = first.pointer.lstrip("#/").replace("/", ".") or "body"
    detail = f"the body is not JSON: {first.detail}" if is_syntax else f"{where}: {first.detail}"
    return problem_response(
        request,
        slug="bad-request" if is_syntax else InputError.slug,
        title="The body cannot be read" if is_syntax else InputError.title,
        status=400 if is_syntax else InputError.status,
        detail=detail,
        errors=errors[:_MOST_ERRORS],
    )


def _field_error(entry: dict[str, Any]) -> FieldError:
    place, *path = entry["loc"]
    tokens = [str(token).replace("~", "~0").replace("/", "~1") for token in path]
    message = problem_text(entry)
    if entry["type"] == "json_invalid":
        message = str(entry.get("ctx", {}).get("error", message))
        tokens = []
    pointer = "#/" + "/".join(tokens) if place == "body" else ".".join(tokens)
    where = replace_surrogates(pointer) if tokens else "#"
    return FieldError(pointer=where[:_LONGEST_POINTER], detail=replace_surrogates(message), type=str(entry["type"]))


def request_id_of(request: Request) -> str | None:
    return request.scope.get("state", {}).get("request_id")


def install_handlers(app: FastAPI, page: Callable[[Request, dict[str, Any]], Response]) -> None:
    """Convert exceptions to problem documents; at dashboard addresses, browsers get a `page` instead."""

    def answer_any(request: Request, error: Exception) -> Response:
        is_api = request.url.path.startswith(("/v1/", "/healthz", "/readyz", "/metrics", "/openapi.json"))
        if not is_api and "text/html" in request.headers.get("accept", ""):
            slug, title, status, detail = describe_error(error)
            facts = {"type": slug, "title": title, "status": status, "detail": detail}
            return page(request, facts | {"request_id": request_id_of(request)})
        return error_response(request, error)

    # Coroutines, because starlette would run plain functions in a thread.
    async def any_error(request: Request, error: Exception) -> Response:
        return answer_any(request, error)

    async def bad_request(request: Request, error: Any) -> Response:
        return validation_answer(request, error)

    app.state.answer_error = answer_any
    for kind in (GraspdError, ApiError, HTTPException):
        app.add_exception_handler(kind, any_error)
    app.add_exception_handler(RequestValidationError, bad_request)


def problem_responses(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Return OpenAPI entries of a route: a problem document for each status."""
    content = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
    return {status: {"description": HTTPStatus(status).phrase, "content": content} for status in statuses}
