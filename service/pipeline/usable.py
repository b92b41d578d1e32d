"""Hands, objects and networks that jobs may use, including the neighbours in their scenes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

from sqlalchemy import Connection

from graspd.service.index.views import AssetView
from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import ConflictError, InputError, NotFoundError
from graspd.service.model.projects import EVERYTHING, ProjectScope
from graspd.service.model.records import Member
from graspd.service.model.states import AssetKind
from graspd.service.pipeline.backends import Services

Options = TypeVar("Options", bound=JobOptions)


def usable_asset(services: Services, kind: AssetKind, name: str, scope: ProjectScope = EVERYTHING) -> AssetView:
    """Return a hand, object or network, by name or digest, that jobs may use.

    NotFoundError: none is in scope. InputError: it failed its check. ConflictError: its check is still running.
    """
    asset = services.index.assets.get(kind, name, scope=scope)
    if asset.verdict == "refuse":
        raise InputError(f"{kind.value} {name!r} was refused: {asset.message}")
    if asset.verdict is None:
        why = f" ({asset.message})" if asset.message else ""
        raise ConflictError(f"{kind.value} {name!r} is still being checked{why}; submit again in a moment")
    return asset


def refuse_deleted(services: Services, wanted: Sequence[tuple[AssetKind, str]], connection: Connection) -> None:
    if missing := services.index.assets.missing(wanted, within=connection):
        raise NotFoundError(f"there is no {missing[0]} any more; it was deleted just now")


def with_neighbours(
    services: Services, options: Options, scope: ProjectScope = EVERYTHING
) -> tuple[Options, Sequence[AssetView]]:
    """Return options with the present digests of the neighbours' names, and these neighbours.

    A digest in the request itself, for example one copied from a job, stays. Errors as in `usable_asset`; InputError if
    a name and a digest belong to two objects.
    """
    beside = [usable_asset(services, AssetKind.OBJECT, one.digest or one.object, scope) for one in options.beside]
    found = []
    for one, asset in zip(options.beside, beside, strict=True):
        if one.object not in (asset.name, asset.digest):
            raise InputError(f"the neighbour {one.object!r} has the digest of {asset.name!r}; omit the digest")
        found.append(one.model_copy(update={"object": asset.name, "digest": asset.digest}))
    return options.with_beside(found), beside


def with_network(
    services: Services, options: Options, hands: Sequence[AssetView | Member], scope: ProjectScope = EVERYTHING
) -> Options:
    """Return options with the digest of their network; unchanged if their method uses none.

    Errors as in `usable_asset`; InputError if the network proposes grasps of another hand.
    """
    if not options.network:
        return options
    network = usable_asset(services, AssetKind.NETWORK, options.network, scope)
    own = str(network.facts.get("hand_digest", ""))
    if other := next((hand for hand in hands if hand.digest != own), None):
        raise InputError(
            f"network {network.name!r} proposes grasps of {network.facts.get('hand')} ({own[:12]}), not of "
            f"{other.name} ({other.digest[:12]})"
        )
    return options.model_copy(update={"options": {**options.options, "network": network.digest}})
