"""Outbox: numbered ends of jobs and datasets, webhooks, and deliveries of ends to webhooks."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from sqlalchemy import Connection, delete, func, select, update

from graspd.service.index.database import IndexPart, scope_conditions, upsert
from graspd.service.index.tables import datasets, deliveries, ends, jobs, webhooks
from graspd.service.index.views import DeliveryView, EndView, WebhookView
from graspd.service.model.clock import timestamp
from graspd.service.model.projects import EVERYTHING, ProjectScope
from graspd.service.model.webhooks import MOST_WAITING, WAITS_S, Webhook

#: Age [s] above which ends and deliveries are deleted.
KEPT_S: Final = 30 * 86400.0
_AT_ONCE: Final = 500


@dataclass(frozen=True)
class DueDelivery:
    hook: WebhookView
    end: EndView
    attempts: int


def append_end_events(connection: Connection, rows: Sequence[dict[str, Any]]) -> None:
    """Append ends of jobs and datasets within a transaction, numbered in ascending order.

    A number is the time [ms], or the last number plus 1 if greater: a new index continues the numbers of a lost one.
    """
    if rows:
        first = max(last_end_number(connection) + 1, int(time.time() * 1000))
        numbered = [{"seq": first + place, "at": timestamp(), **row} for place, row in enumerate(rows)]
        upsert(connection, ends, numbered)


def last_end_number(connection: Connection) -> int:
    return int(connection.scalar(select(func.max(ends.c.seq))) or 0)


class Outbox(IndexPart):
    def end_events(self, since: int, *, limit: int, scope: ProjectScope = EVERYTHING) -> list[EndView]:
        query = select(ends).where(ends.c.seq > since, *scope_conditions(scope, ends)).order_by(ends.c.seq).limit(limit)
        return [EndView(**row) for row in self.database.rows(query)]

    def own_ends(self, owner: str, since: int, *, limit: int, scope: ProjectScope) -> list[tuple[EndView, str]]:
        """Return a submitter's ends after number `since`, newest first, with the hand and object of a job."""
        mine = (ends.c.owner == owner, ends.c.seq > since, *scope_conditions(scope, ends))
        query = select(ends, jobs.c.hand, jobs.c.object).outerjoin(jobs, jobs.c.id == ends.c.subject).where(*mine)
        rows = self.database.rows(query.order_by(ends.c.seq.desc()).limit(limit))
        return [(EndView(**row), f"{row['hand']} on {row['object']}" if row["hand"] else "") for row in rows]

    def unreported_datasets(self, *, limit: int = 200) -> list[tuple[str, int]]:
        """Return datasets without a report of their end since their last event, with their number of events."""
        query = select(datasets.c.name, datasets.c.events).where(
            datasets.c.planned.is_(True), datasets.c.applied >= datasets.c.events, datasets.c.told < datasets.c.events
        )
        return [(row["name"], row["events"]) for row in self.database.rows(query.limit(limit))]

    def report_dataset_end(self, name: str, events: int, row: dict[str, Any]) -> None:
        with self.database.write_transaction() as connection:
            untold = (datasets.c.name == name, datasets.c.told < events)
            if connection.execute(update(datasets).where(*untold).values(told=events)).rowcount:
                append_end_events(connection, [row])

    def add(self, hook: Webhook, *, seen: int | None = None, within: Connection | None = None) -> None:
        """Add a webhook; it receives ends after number `seen`, by default all future ends."""
        row = {name: getattr(hook, name) for name in ("id", "url", "created", "owner", "project")}
        with self.database.write_transaction(within) as connection:
            row |= {"states": list(hook.states), "seen": last_end_number(connection) if seen is None else seen}
            upsert(connection, webhooks, [row], keep=("seen",))

    def webhooks(self, *, scope: ProjectScope = EVERYTHING) -> list[WebhookView]:
        query = select(webhooks).where(*scope_conditions(scope, webhooks)).order_by(webhooks.c.created, webhooks.c.id)
        return [WebhookView(**row) for row in self.database.rows(query)]

    def webhook(self, webhook: str, *, scope: ProjectScope = EVERYTHING) -> WebhookView:
        query = select(webhooks).where(webhooks.c.id == webhook, *scope_conditions(scope, webhooks))
        return WebhookView(**self.database.first_row(query, f"webhook {webhook!r}"))

    def remove(self, webhook: str) -> None:
        with self.database.write_transaction() as connection:
            connection.execute(delete(deliveries).where(deliveries.c.webhook == webhook))
            connection.execute(delete(webhooks).where(webhooks.c.id == webhook))

    def delivery_log(self, webhook: str, *, limit: int = 50) -> list[DeliveryView]:
        query = select(deliveries, ends.c.kind, ends.c.subject, ends.c.state.label("ended"))
        query = query.join(ends, ends.c.seq == deliveries.c.seq).where(deliveries.c.webhook == webhook)
        return [DeliveryView(**row) for row in self.database.rows(query.order_by(deliveries.c.seq.desc()).limit(limit))]

    def create_deliveries(self) -> None:
        """Create deliveries of new ends; those above `MOST_WAITING` of a webhook fail at once."""
        for hook in self.webhooks():
            mine = (ends.c.project == hook.project, ends.c.seq > hook.seen)
            query = select(ends.c.seq, ends.c.state).where(*mine).order_by(ends.c.seq).limit(_AT_ONCE)
            if not (found := self.database.rows(query)):
                continue
            with self.database.write_transaction() as connection:
                of_waiting = select(func.count(), func.max(deliveries.c.due))
                of_waiting = of_waiting.where(deliveries.c.webhook == hook.id, deliveries.c.state == "waiting")
                number, rest_until = connection.execute(of_waiting).one()
                waits = {"state": "waiting", "due": rest_until or 0.0, "detail": ""}
                missed = {"state": "failed", "due": 0.0, "detail": f"{MOST_WAITING} deliveries wait already"}
                reported = [row["seq"] for row in found if row["state"] in hook.states]
                rows = [
                    {"webhook": hook.id, "seq": seq, "attempts": 0, **(waits if place < MOST_WAITING else missed)}
                    for place, seq in enumerate(reported, start=number)
                ]
                upsert(connection, deliveries, rows, keep=("state", "attempts", "due", "detail"))
                connection.execute(update(webhooks).where(webhooks.c.id == hook.id).values(seen=found[-1]["seq"]))

    def due_deliveries(self, now: float) -> list[DueDelivery]:
        """Return the oldest due delivery of each webhook."""
        hooks = {hook.id: hook for hook in self.webhooks()}
        oldest = select(func.min(deliveries.c.seq).label("seq"), deliveries.c.webhook).group_by(deliveries.c.webhook)
        first = oldest.where(deliveries.c.state == "waiting", deliveries.c.due <= now).subquery()
        is_first = (deliveries.c.seq == first.c.seq) & (deliveries.c.webhook == first.c.webhook)
        query = select(ends, deliveries.c.webhook, deliveries.c.attempts)
        query = query.join(first, first.c.seq == ends.c.seq).join(deliveries, is_first)
        return [
            DueDelivery(hooks[row["webhook"]], EndView(**row), row["attempts"])
            for row in self.database.rows(query)
            if row["webhook"] in hooks
        ]

    def record_attempt(
        self, due: DueDelivery, *, status: int | None, detail: str, done: bool, final: bool = False
    ) -> None:
        """Record an attempt; a failure delays all waiting deliveries of the webhook, or fails them if `final`."""
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
        others = {"due": rest_until} | ({"state": "failed", "detail": values["detail"]} if final else {})
        of_hook = update(deliveries).where(deliveries.c.webhook == due.hook.id)
        with self.database.write_transaction() as connection:
            connection.execute(of_hook.where(deliveries.c.seq == due.end.seq).values(**values))
            connection.execute(of_hook.where(deliveries.c.state == "waiting").values(**others))

    def delete_expired(self) -> None:
        oldest = int((time.time() - KEPT_S) * 1000)
        with self.database.write_transaction() as connection:
            connection.execute(delete(deliveries).where(deliveries.c.seq < oldest))
            connection.execute(delete(ends).where(ends.c.seq < oldest))
