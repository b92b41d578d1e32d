"""`/v1/deletions`, and `/v1/{datasets,jobs,...}/NAME/restore`: what was deleted is brought back."""

from __future__ import annotations

from typing import Annotated, Final, get_args

from fastapi import APIRouter, Depends, Path

from api.catalog.deletions import DeletionView
from api.problems import responses
from api.routes.dependencies import DeletionsOf, may_read, may_submit
from service.store.records import What

router = APIRouter(tags=["deletions"])

Name = Annotated[str, Path(max_length=64, description="its name, or its id")]
KINDS: Final[tuple[What, ...]] = get_args(What)


@router.get("/v1/deletions", dependencies=[Depends(may_read)], responses=responses(401, 403, 503))
def list_deletions(deletions: DeletionsOf) -> list[DeletionView]:
    """What can be restored, the newest first."""
    return deletions.recent()


def _add_restore(what: What) -> None:
    @router.post(
        f"/v1/{what}s/{{name}}/restore",
        dependencies=[Depends(may_submit)],
        responses=responses(401, 403, 404, 409, 422, 503),
        name=f"restore_{what}",
    )
    def restore(name: Name, deletions: DeletionsOf) -> DeletionView:
        """Bring back what was deleted within the grace time (`GRASPD_SHARD_GRACE_S`), as it was."""
        return deletions.restore(what, name)


for _kind in KINDS:
    _add_restore(_kind)
