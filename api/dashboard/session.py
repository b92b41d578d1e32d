"""Sign in with a key: the browser gets a signed cookie that dies with the key. Sign out: it forgets the cookie."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Form, Request
from fastapi.responses import HTMLResponse, RedirectResponse

from api.access.auth import SESSION_COOKIE
from api.access.keys import SESSION_S, KeyFile
from api.dashboard.rendering import render

router = APIRouter(include_in_schema=False)


@router.get("/login")
def login_page(request: Request) -> HTMLResponse:
    """The form for the key; with a session, whose it is and the way out of it."""
    key = request.scope["state"].get("key") if SESSION_COOKIE in request.cookies else None
    return render(request, "login.html", problem="", health=None, session=key.name if key else "")


@router.post("/logout")
def logout(request: Request) -> RedirectResponse:
    """End the session of this browser. Others of the same key go on; revoking the key ends all of them."""
    response = RedirectResponse("/login", status_code=303)
    response.delete_cookie(SESSION_COOKIE, httponly=True, samesite="strict", secure=request.url.scheme == "https")
    return response


@router.post("/login", response_model=None)
def login(request: Request, key: Annotated[str, Form(max_length=200)]) -> HTMLResponse | RedirectResponse:
    """Change a key for a cookie."""
    keys: KeyFile = request.app.state.keys
    found = keys.find(key.strip())
    if found is None:
        return render(
            request, "login.html", session="", problem="No live key is like this one.", health=None, status=401
        )
    response = RedirectResponse("/", status_code=303)
    response.set_cookie(
        SESSION_COOKIE,
        keys.open_session(found),
        max_age=SESSION_S,
        httponly=True,
        samesite="strict",
        secure=request.url.scheme == "https",
    )
    return response
