"""Outbox: ends of jobs and datasets in order, webhooks, and their deliveries."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from sqlalchemy import (
    JSON,
    BigInteger,
    Column,
    Connection,
    Float,
    Index,
    Integer,
    String,
    Table,
    Text,
    delete,
    func,
    select,
    update,
)

from graspd.service.index.bulk import upsert
from graspd.service.index.database import Database
from graspd.service.index.tables import datasets, metadata
from graspd.service.index.views import DeliveryView, EndView, WebhookView
from graspd.service.model.clock import timestamp
from graspd.service.model.errors import NotFoundError
from graspd.service.model.projects import EVERYTHING, ProjectScope
from graspd.service.model.webhooks import MOST_WAITING, WAITS_S, Webhook

#: Ends and deliveries older than this are deleted [s].
KEPT_S: Final = 30 * 86400.0
_AT_ONCE: Final = 500
#: Live: a rebuilt index starts a new feed.
ends: Final = Table(
    "ends",
    metadata,
    Column("seq", BigInteger, primary_key=True, autoincrement=False),
    Column("kind", String(8), nullable=False),
    Column("subject", String(64), nullable=False),
    Column("state", String(10), nullable=False),
    Column("at", String(32), nullable=False),
    Column("project", String(32), nullable=False, server_default=""),
    Column("owner", String(64), nullable=False, server_default=""),
    Index("ends_of_project", "project", "seq"),
)
webhooks: Final = Table(
    "webhooks",
    metadata,
    Column("id", String(32), primary_key=True),
    Column("url", Text, nullable=False),
    Column("states", JSON, nullable=False),
    Column("created", String(32), nullable=False),
    Column("owner", String(64), nullable=False, server_default=""),
    Column("project", String(32), nullable=False, server_default=""),
    # Live: ends up to here have deliveries.
    Column("seen", BigInteger, nullable=False, server_default="0"),
)
#: Live: a log.
deliveries: Final = Table(
    "deliveries",
    metadata,
    Column("webhook", String(32), primary_key=True),
    Column("seq", BigInteger, primary_key=True, autoincrement=False),
    Column("state", String(10), nullable=False),
    Column("attempts", Integer, nullable=False),
    Column("due", Float, nullable=False),
    Column("tried", String(32)),
    Column("status", Integer),
    Column("detail", String(300), nullable=False, server_default=""),
    Index("deliveries_due", "state", "due"),
)


@dataclass(frozen=True)
class DueDelivery:
    hook: WebhookView
    end: EndView
    attempts: int


def note_ends(connection: Connection, rows: Sequence[dict[str, Any]]) -> None:
    """Append ends to the feed within a transaction; writers take turns, so numbers appear in order.

    A number is the time in milliseconds, or the last one plus 1. So the numbers of a new index follow those that
    readers saw before the old one was lost.
    """
    if rows:
        last = connection.scalar(select(func.max(ends.c.seq))) or 0
        first = max(int(last) + 1, int(time.time() * 1000))
        numbered = [{"seq": first + place, "at": timestamp(), **row} for place, row in enumerate(rows)]
        upsert(connection, ends, numbered)


@dataclass(frozen=True)
class Outbox:
    database: Database

    def ends(self, since: int, *, limit: int, scope: ProjectScope = EVERYTHING) -> list[EndView]:
        query = select(ends).where(ends.c.seq > since).order_by(ends.c.seq).limit(limit)
        if not scope.everything:
            query = query.where(ends.c.project == scope.project)
        with self.database.reading() as connection:
            return [EndView(**row) for row in connection.execute(query).mappings()]

    def untold_datasets(self, *, limit: int = 200) -> list[tuple[str, int]]:
        """Return datasets whose end is not reported since their last event, with their number of events."""
        query = select(datasets.c.name, datasets.c.events).where(
            datasets.c.planned.is_(True), datasets.c.applied >= datasets.c.events, datasets.c.told < datasets.c.events
        )
        with self.database.reading() as connection:
            return [(name, events) for name, events in connection.execute(query.limit(limit))]

    def tell_dataset(self, name: str, events: int, row: dict[str, Any]) -> None:
        """Append the end of a dataset, once for each number of events."""
        with self.database.writing() as connection:
            untold = (datasets.c.name == name, datasets.c.told < events)
            if connection.execute(update(datasets).where(*untold).values(told=events)).rowcount:
                note_ends(connection, [row])

    def add(self, hook: Webhook, *, seen: int | None = None, within: Connection | None = None) -> None:
        """Add a webhook; it receives ends from now on.

        Args:
            seen: ends up to here are not delivered; None: all present ones.
        """
        with self.database.writing(within) as connection:
            last = seen if seen is not None else self.last(within=connection)
            row = {
                "id": hook.id,
                "url": hook.url,
                "states": list(hook.states),
                "created": hook.created,
                "owner": hook.owner,
                "project": hook.project,
                "seen": last,
            }
            upsert(connection, webhooks, [row], keep=("seen",))

    def last(self, *, within: Connection) -> int:
        return int(within.scalar(select(func.max(ends.c.seq))) or 0)

    def seen(self, *, within: Connection) -> dict[str, int]:
        return {row.id: row.seen for row in within.execute(select(webhooks.c.id, webhooks.c.seen))}

    def told(self, *, within: Connection) -> dict[str, int]:
        """Return the number of events for which each dataset's end was reported."""
        return {row.name: row.told for row in within.execute(select(datasets.c.name, datasets.c.told))}

    def set_told(self, told: dict[str, int], *, within: Connection) -> None:
        """Restore the result of `told`."""
        for name, events in told.items():
            within.execute(update(datasets).where(datasets.c.name == name).values(told=events))

    def hooks(self, *, scope: ProjectScope = EVERYTHING) -> list[WebhookView]:
        query = select(webhooks).order_by(webhooks.c.created, webhooks.c.id)
        if not scope.everything:
            query = query.where(webhooks.c.project == scope.project)
        with self.database.reading() as connection:
            return [_hook(row) for row in connection.execute(query).mappings()]

    def hook(self, webhook: str, *, scope: ProjectScope = EVERYTHING) -> WebhookView:
        for one in self.hooks(scope=scope):
            if one.id == webhook:
                return one
        raise NotFoundError(f"there is no webhook {webhook!r}")

    def remove(self, webhook: str) -> None:
        with self.database.writing() as connection:
            connection.execute(delete(deliveries).where(deliveries.c.webhook == webhook))
            connection.execute(delete(webhooks).where(webhooks.c.id == webhook))

    def log(self, webhook: str, *, limit: int = 50) -> list[DeliveryView]:
        query = (
            select(deliveries, ends.c.kind, ends.c.subject, ends.c.state.label("ended"))
            .join(ends, ends.c.seq == deliveries.c.seq)
            .where(deliveries.c.webhook == webhook)
            .order_by(deliveries.c.seq.desc())
            .limit(limit)
        )
        with self.database.reading() as connection:
            return [
                DeliveryView(**{name: row[name] for name in DeliveryView.model_fields})
                for row in connection.execute(query).mappings()
            ]

    def plan(self) -> None:
        """Create deliveries of new ends; a webhook that is far behind misses the oldest."""
        for hook in self.hooks():
            mine = (ends.c.project == hook.project, ends.c.seq > hook.seen)
            query = select(ends.c.seq, ends.c.state).where(*mine).order_by(ends.c.seq).limit(_AT_ONCE)
            with self.database.reading() as connection:
                found = connection.execute(query).all()
            if not found:
                continue
            with self.database.writing() as connection:
                waiting = select(func.count()).where(deliveries.c.webhook == hook.id, deliveries.c.state == "waiting")
                room = MOST_WAITING - int(connection.scalar(waiting) or 0)
                resting = select(func.max(deliveries.c.due)).where(
                    deliveries.c.webhook == hook.id, deliveries.c.state == "waiting"
                )
                rest_until = float(connection.scalar(resting) or 0.0)
                wanted = [row.seq for row in found if row.state in hook.states]
                rows = [
                    {"webhook": hook.id, "seq": seq, "state": "waiting", "attempts": 0, "due": rest_until, "detail": ""}
                    if place < room
                    else {
                        "webhook": hook.id,
                        "seq": seq,
                        "state": "failed",
                        "attempts": 0,
                        "due": 0.0,
                        "detail": f"{MOST_WAITING} deliveries wait already",
                    }
                    for place, seq in enumerate(wanted)
                ]
                upsert(connection, deliveries, rows, keep=("state", "attempts", "due", "detail"))
                seen = update(webhooks).where(webhooks.c.id == hook.id).values(seen=found[-1].seq)
                connection.execute(seen)

    def due(self, now: float) -> list[DueDelivery]:
        """Return the due deliveries, the oldest of each webhook."""
        hooks = {hook.id: hook for hook in self.hooks()}
        first = (
            select(func.min(deliveries.c.seq).label("seq"), deliveries.c.webhook)
            .where(deliveries.c.state == "waiting", deliveries.c.due <= now)
            .group_by(deliveries.c.webhook)
            .subquery()
        )
        query = (
            select(ends, deliveries.c.webhook, deliveries.c.attempts)
            .join(first, first.c.seq == ends.c.seq)
            .join(deliveries, (deliveries.c.seq == first.c.seq) & (deliveries.c.webhook == first.c.webhook))
        )
        with self.database.reading() as connection:
            rows = connection.execute(query).mappings().all()
        return [
            DueDelivery(
                hooks[row["webhook"]], EndView(**{name: row[name] for name in EndView.model_fields}), row["attempts"]
            )
            for row in rows
            if row["webhook"] in hooks
        ]

    def settle(self, due: DueDelivery, *, status: int | None, detail: str, done: bool, final: bool = False) -> None:
        """Record an attempt: a failure delays all deliveries of the address, a success makes them due.

        Args:
            final: no other attempt follows for any delivery of the address.
        """
        last = final or due.attempts >= len(WAITS_S)
        rest_until = 0.0 if done else time.time() + WAITS_S[min(due.attempts, len(WAITS_S) - 1)]
        values = {
            "state": "delivered" if done else "failed" if last else "waiting",
            "attempts": due.attempts + 1,
            "due": rest_until,
            "tried": timestamp(),
            "status": status,
            "detail": detail[:300].replace("\0", ""),
        }
        same = (deliveries.c.webhook == due.hook.id, deliveries.c.seq == due.end.seq)
        waiting = (deliveries.c.webhook == due.hook.id, deliveries.c.state == "waiting")
        with self.database.writing() as connection:
            connection.execute(update(deliveries).where(*same).values(**values))
            others = {"due": rest_until} | ({"state": "failed", "detail": values["detail"]} if final else {})
            connection.execute(update(deliveries).where(*waiting).values(**others))

    def forget_old(self) -> None:
        oldest = int((time.time() - KEPT_S) * 1000)
        with self.database.writing() as connection:
            connection.execute(delete(deliveries).where(deliveries.c.seq < oldest))
            connection.execute(delete(ends).where(ends.c.seq < oldest))


def _hook(row: Any) -> WebhookView:
    return WebhookView(**{name: row[name] for name in WebhookView.model_fields})
