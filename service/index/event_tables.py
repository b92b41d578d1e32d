"""Tables of what is told to others: ends of jobs and datasets in their order, webhooks, deliveries."""

from __future__ import annotations

from typing import Final

from sqlalchemy import JSON, BigInteger, Column, Float, Index, Integer, String, Table, Text

from service.index.tables import metadata

#: Live: an index that is rebuilt goes on with a feed of its own.
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
