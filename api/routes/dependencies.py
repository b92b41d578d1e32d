"""What routes ask for: the catalogue of this application, and the right to use it."""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends, Query, Request

from api.access.auth import authorize
from api.access.keys import Scope
from api.catalog.catalog import Catalog

MAX_LIMIT = 200


def get_catalog(request: Request) -> Catalog:
    """The catalogue that `create_app` opened."""
    return request.app.state.catalog


def may_read(request: Request) -> None:
    authorize(request, Scope.READ)


def may_submit(request: Request) -> None:
    authorize(request, Scope.SUBMIT)


def may_scrape(request: Request) -> None:
    """Whoever may read; or anybody, where the settings say so."""
    if request.app.state.settings.metrics_need_key:
        authorize(request, Scope.READ)


CatalogOf = Annotated[Catalog, Depends(get_catalog)]
Limit = Annotated[int, Query(ge=1, le=MAX_LIMIT, description="items on a page")]
Cursor = Annotated[str | None, Query(max_length=512, description="`next` of the page before")]
