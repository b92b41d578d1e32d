"""Queries of grasps: filters, and pages sorted by a metric, among millions of rows.

This module chooses the database index, because SQLite has no statistics of the values. There are three plans:

1. If a condition leaves few rows, they are fetched by its index and sorted.
2. Otherwise a bounded number of rows is read in the wanted order until the page is full.
3. If these rows do not fill the page, all rows are read once.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, Unpack

from pydantic import Field
from sqlalchemy import ColumnElement, Connection, Float, Select, String, Subquery, and_, func, not_, or_, select, tuple_
from sqlalchemy.sql.operators import in_op, is_

from graspd.service.index import database
from graspd.service.index.tables import dataset_cells, grasps, jobs, shards, tagged, tasks
from graspd.service.index.views import GraspView, Page
from graspd.service.model import where as expressions
from graspd.service.model.base import Model
from graspd.service.model.errors import InputError
from graspd.service.model.metric_fields import SortedName
from graspd.service.model.metrics import indexed_metrics
from graspd.service.model.projects import EVERYTHING, ProjectScope
from graspd.service.model.records import Grasp
from graspd.service.model.states import Stage
from graspd.service.model.where import Connective, Flag, MetricComparison, Negation, Node, TypeComparison, parse_where

Metric = SortedName
#: Key of the grasp before a page (metric, shard id and row), None for the first page.
Start = tuple[Any, ...] | None


class GraspSort(Model):
    """Order of grasps; those without the metric come last."""

    by: Metric | Literal["created"] = "epsilon"
    descending: bool = True


_BEST_FIRST = GraspSort()


class Grasps(database.IndexPart):
    def page(
        self, where: GraspFilter | None = None, *, sort: GraspSort = _BEST_FIRST, **part: Unpack[database.Paging]
    ) -> Page[GraspView]:
        size, cursor = database.page_size(part.get("limit", 50)), part.get("cursor")
        start = None if cursor is None else database.decode_cursor(cursor, (float, int, str, type(None)), str, int)
        with self.database.read_transaction() as connection:
            rows = search(connection, where, sort, size + 1, start)
        views = [GraspView(**row) for row in rows[:size]]
        last = rows[size - 1] if len(rows) > size else None
        return Page(items=views, next=last and database.encode_cursor(last[sort.by], last["shard_id"], last["row"]))

    def get(self, shard_id: str, row: int, *, scope: ProjectScope = EVERYTHING) -> GraspView:
        query = select(grasps).where(grasps.c.shard_id == shard_id, grasps.c.row == row)
        query = query.where(*database.shard_scope_conditions(scope, grasps.c.shard_id))
        return GraspView(**self.database.first_row(query, f"grasp {row} in shard {shard_id!r}"))

    def shard_of(self, prefix: str) -> str:
        """Return the shard whose id starts with hexadecimal digits; NotFoundError if there is none."""
        query = select(grasps.c.shard_id).where(grasps.c.shard_id.between(prefix, prefix + "g")).limit(1)
        return str(self.database.first_row(query, f"shard {prefix!r}")["shard_id"])

    def matching_grasps(self, where: GraspFilter, *, limit: int) -> list[Grasp]:
        query = select(grasps.c.shard_id, grasps.c.row).order_by(grasps.c.shard_id, grasps.c.row).limit(limit)
        return [(found["shard_id"], found["row"]) for found in self.database.rows(query.where(*sql_conditions(where)))]

    def get_many(self, wanted: Sequence[Grasp]) -> Iterator[GraspView]:
        """Yield the given grasps, ordered by shard and row, without missing ones."""
        for some in database.chunks(sorted(wanted)):
            query = select(grasps).where(tuple_(grasps.c.shard_id, grasps.c.row).in_(some))
            for row in self.database.rows(query.order_by(grasps.c.shard_id, grasps.c.row)):
                yield GraspView(**row)


#: Maximum number of rows to fetch by an index and sort, which is faster than a scan of a million rows.
SORTED_AT_ONCE: Final = 40_000
#: Groups of conditions on the tasks that made the grasps.
_OF_TASKS: Final = ("job", "dataset", "project")
#: Numbers of rows to read in the wanted order: few at first, because these suffice for most filters.
LOOKED_AT: Final = (1000, 20_000)
#: Columns by name, of the table of grasps or of a subquery.
Columns = Any
_METRICS: Final = frozenset(metric.name for metric in indexed_metrics())
_FLAGS: Final[dict[str, Callable[[Columns], ColumnElement[bool]]]] = {
    "validated": lambda grasps: grasps.success.is_not(None),
    "valid": lambda grasps: grasps.valid.is_(True),
    "held": lambda grasps: grasps.success.is_(True),
    # Grasps planned in a scene are validated by the lift.
    "lift": lambda grasps: and_(grasps.scene_kind != "free", grasps.success.is_(True)),
    "lift_hard": lambda grasps: grasps.lift_hard.is_(True),
}


@dataclass(frozen=True)
class ColumnCondition:
    """Comparison of one column with a value. Conditions of one group share one database index."""

    group: str
    column: ColumnElement[Any]
    operator: Callable[[Any, Any], Any]
    value: Any

    def sql(self, groups: Sequence[str] | None) -> ColumnElement[bool]:
        """Return the test in SQL, which uses an index only if its group is in `groups` (None: all groups)."""
        return self._compare(self.column if groups is None or self.group in groups else _without_index(self.column))

    def sql_for_rows(self, rows: Subquery) -> ColumnElement[bool]:
        return self._compare(rows.c[str(self.column.key)])

    def _compare(self, column: ColumnElement[Any]) -> ColumnElement[bool]:
        test: ColumnElement[bool] = self.operator(column, self.value)
        return test


@dataclass(frozen=True)
class TagCondition:
    tag: str
    group: str = "tag"

    def sql(self, groups: Sequence[str] | None) -> ColumnElement[bool]:
        if groups is not None and self.group not in groups:
            return self._membership(grasps.c)
        those = select(tagged.c.shard_id, tagged.c.row).where(tagged.c.tag == self.tag)
        return tuple_(grasps.c.shard_id, grasps.c.row).in_(those)

    def sql_for_rows(self, rows: Subquery) -> ColumnElement[bool]:
        return self._membership(rows.c)

    def _membership(self, columns: Any) -> ColumnElement[bool]:
        same = (tagged.c.tag == self.tag, tagged.c.shard_id == columns.shard_id, tagged.c.row == columns.row)
        return select(tagged.c.tag).where(*same).exists()


@dataclass(frozen=True)
class ExpressionCondition:
    """Grasps that satisfy an expression, tested without an index."""

    node: Node
    group: str = "flag"

    def sql(self, groups: Sequence[str] | None) -> ColumnElement[bool]:
        return sql_condition(self.node, grasps.c)

    def sql_for_rows(self, rows: Subquery) -> ColumnElement[bool]:
        return sql_condition(self.node, rows.c)


Test = ColumnCondition | TagCondition | ExpressionCondition


def conditions(where: GraspFilter | None) -> list[Test]:
    """Return the tests of a filter, all of which must hold; InputError for an invalid expression."""
    where = where or GraspFilter()
    found: list[Test] = []
    for group in _OF_TASKS:
        if getattr(where, group) is not None:
            made = _tasks_of(group, where).with_only_columns(tasks.c.shard_id)
            found.append(ColumnCondition(group, grasps.c.shard_id, in_op, made))
    if where.tag is not None:
        found.append(TagCondition(where.tag))
    if where.where is not None:
        found.append(ExpressionCondition(parse_where(where.where)))
    for name, wanted in (("hand", where.hand), ("object", where.object)):
        if wanted is not None:
            found.append(ColumnCondition("pair", grasps.c[name], operator.eq, wanted))
    flags = {name: getattr(where, name) for name in ("valid", "success", "lift_hard")}
    found += [ColumnCondition("flag", grasps.c[name], is_, flag) for name, flag in flags.items() if flag is not None]
    # `valid=False` excludes grasps without validation.
    validated = True if where.valid is False else where.validated
    if validated is not None:
        found.append(ColumnCondition("flag", grasps.c.success, operator.ne if validated else operator.eq, None))
    if where.scene is not None:
        compared, kind = (operator.ne, "free") if where.scene == "any" else (operator.eq, where.scene)
        found.append(ColumnCondition("flag", grasps.c.scene_kind, compared, kind))
    if where.robust_weakest is not None:
        found.append(ColumnCondition("flag", grasps.c.robust_weakest, operator.eq, where.robust_weakest))
    if where.digits:
        found.append(ColumnCondition("flag", grasps.c.digits, in_op, where.digits))
    if where.neighbours is not None:
        found.append(ColumnCondition("flag", grasps.c.neighbours, operator.gt if where.neighbours else operator.eq, 0))
    found += [ColumnCondition(name, grasps.c[name], operator.ge, bound) for name, bound in where.at_least.items()]
    found += [ColumnCondition(name, grasps.c[name], operator.le, bound) for name, bound in where.at_most.items()]
    return found


def sql_conditions(where: GraspFilter | None) -> list[ColumnElement[bool]]:
    return [condition.sql(None) for condition in conditions(where)]


def search(connection: Connection, where: GraspFilter | None, sort: GraspSort, size: int, start: Start) -> list[Any]:
    """Return the first `size` rows after `start`."""
    wanted = conditions(where)
    few = _selective_group(connection, where, wanted)
    rows: list[Any] = []
    # Databases sort NULL differently, so rows with and without the metric need two queries.
    if start is None or start[0] is not None:
        rows = _rows_with_metric(connection, wanted, few, sort, size, start)
    if len(rows) < size:
        by = grasps.c[sort.by]
        query = select(grasps).where(by.is_(None), *(c.sql([few] if few else None) for c in wanted))
        after = start[1:] if start is not None and start[0] is None else None
        key = (grasps.c.shard_id, grasps.c.row)
        rows += connection.execute(_slice(query, key, sort, size - len(rows), after)).mappings()
    return rows


def _rows_with_metric(
    connection: Connection, wanted: Sequence[Test], few: str | None, sort: GraspSort, size: int, start: Start
) -> list[Any]:
    by = grasps.c[sort.by]
    # The database index of the order also serves conditions on its metric and, for epsilon, on hand and object.
    served = [sort.by, "pair"] if sort.by == "epsilon" else [sort.by]
    if few is not None and few not in served:
        return _sorted_rows(connection, [c.sql([few]) for c in wanted], sort, size, start)
    inside = [c.sql(served) for c in wanted if c.group in served]
    outside = [c for c in wanted if c.group not in served]
    ordered = select(grasps).where(by.is_not(None), *inside)
    key = (by, grasps.c.shard_id, grasps.c.row)
    if not outside:
        return list(connection.execute(_slice(ordered, key, sort, size, start)).mappings())
    for number in LOOKED_AT:
        looked = _slice(ordered, key, sort, number, start).subquery()
        query = select(looked).where(*(c.sql_for_rows(looked) for c in outside))
        looked_key = tuple(looked.c[str(column.key)] for column in key)
        rows = list(connection.execute(_slice(query, looked_key, sort, size, None)).mappings())
        if len(rows) >= size or _count_rows(connection, looked) < number:
            return rows
    # PostgreSQL combines indexes; SQLite would follow a single one row by row, which is slower than a full scan.
    groups = None if connection.dialect.name == "postgresql" else [few] if few == "pair" else []
    return _sorted_rows(connection, [c.sql(groups) for c in wanted], sort, size, start)


def _sorted_rows(
    connection: Connection, tests: Sequence[ColumnElement[bool]], sort: GraspSort, size: int, start: Start
) -> list[Any]:
    """Return the matching rows, sorted without an index."""
    by = _without_index(grasps.c[sort.by])
    query = select(grasps).where(by.is_not(None), *tests)
    return list(connection.execute(_slice(query, (by, grasps.c.shard_id, grasps.c.row), sort, size, start)).mappings())


def _selective_group(connection: Connection, where: GraspFilter | None, wanted: Sequence[Test]) -> str | None:
    """Return the group of conditions that leaves the fewest rows, if they are few enough to sort."""
    numbers: dict[str, int] = {}
    for group in dict.fromkeys(condition.group for condition in wanted):
        if group != "flag":
            numbers[group] = estimate_row_count(connection, where or GraspFilter(), group, wanted)
    few = min(numbers, key=numbers.__getitem__, default=None)
    return few if few is not None and numbers[few] <= SORTED_AT_ONCE else None


def estimate_row_count(connection: Connection, where: GraspFilter, group: str, wanted: Sequence[Test] = ()) -> int:
    """Estimate the rows that match a group of conditions; for metrics, count at most `SORTED_AT_ONCE` + 1."""
    query: Select[Any]
    if group in _OF_TASKS:
        query = _tasks_of(group, where).with_only_columns(func.sum(tasks.c.count))
    elif group == "tag":
        query = select(func.count()).where(tagged.c.tag == where.tag)
    elif group == "pair":
        pair = {"hand": where.hand, "object": where.object}
        tests = [shards.c[name] == value for name, value in pair.items() if value is not None]
        query = select(func.sum(shards.c.count)).where(shards.c.kind == "base", *tests)
    else:
        some = select(grasps.c[group]).where(*(c.sql(None) for c in wanted if c.group == group))
        return _count_rows(connection, some.limit(SORTED_AT_ONCE + 1).subquery())
    return int(connection.scalar(query) or 0)


def _tasks_of(group: str, where: GraspFilter) -> Select[Any]:
    """Return the tasks that make the grasps of a job, a dataset or a project."""
    made = select(tasks.c.id).where(tasks.c.stage == Stage.SYNTHESIZE.value)
    if group == "job":
        return made.where(tasks.c.job_id == where.job)
    if group == "project":
        return made.join(jobs, jobs.c.id == tasks.c.job_id).where(jobs.c.project == where.project)
    joined = made.join(dataset_cells, dataset_cells.c.job_id == tasks.c.job_id)
    return joined.where(dataset_cells.c.dataset == where.dataset)


def _count_rows(connection: Connection, rows: Subquery) -> int:
    return int(connection.scalar(select(func.count()).select_from(rows)) or 0)


def _slice(
    query: Select[Any], key: tuple[ColumnElement[Any], ...], sort: GraspSort, size: int, start: Start
) -> Select[Any]:
    if start is not None:
        position = tuple_(*key)
        query = query.where(position < start if sort.descending else position > start)
    return query.order_by(*(part.desc() if sort.descending else part for part in key)).limit(size)


def _without_index(column: ColumnElement[Any]) -> ColumnElement[Any]:
    if isinstance(column.type, Float):
        return column + 0.0
    return column.concat("") if isinstance(column.type, String) else column


def sql_condition(node: Node, grasps: Columns) -> ColumnElement[bool]:
    """Translate a grasp expression to SQL that is never NULL; InputError for a missing column."""
    if isinstance(node, Connective):
        return (or_ if node.word == "or" else and_)(*(sql_condition(part, grasps) for part in node.parts))
    if isinstance(node, Negation):
        return not_(sql_condition(node.part, grasps))
    if isinstance(node, Flag):
        if node.name not in _FLAGS:
            raise _missing_column_error(node.name)
        return _FLAGS[node.name](grasps)
    if isinstance(node, MetricComparison):
        if node.name not in _METRICS:
            raise _missing_column_error(node.name)
        return _comparison(grasps[node.name], node.op, node.bound)
    if isinstance(node, TypeComparison):
        return _comparison(grasps.grasp_type, node.op, int(node.kind))
    return _compare(grasps[node.name], node.op, node.word)


def _comparison(column: Any, op: str, value: float) -> ColumnElement[bool]:
    return and_(column.is_not(None), _compare(column, op, value))


def _compare(column: Any, op: str, value: Any) -> ColumnElement[bool]:
    test: ColumnElement[bool] = expressions.OPERATORS[op](column, value)
    return test


def _missing_column_error(name: str) -> InputError:
    return InputError(f"the index lacks {name!r}, but the shards have it: `graspd grasps where` reads them")


class GraspFilter(Model):
    """Filters, all of which must match; `at_least` and `at_most` are inclusive bounds of metrics."""

    hand: str | None = None
    object: str | None = None
    job: str | None = None
    dataset: str | None = None
    tag: str | None = None
    where: str | None = None
    """An expression of `service.model.where`."""
    project: str | None = None
    """Project of the jobs; None for all projects."""
    validated: bool | None = None
    valid: bool | None = None
    """False selects validated grasps that are not valid."""
    success: bool | None = None
    scene: str | None = None
    """Kind of the scene in which the grasp was planned; `any` means all kinds except free."""
    neighbours: bool | None = None
    digits: tuple[int, ...] = ()
    """Codes of the digits in contact, one of which must match; empty for all."""
    lift_hard: bool | None = None
    robust_weakest: str | None = None
    """Perturbed parameter of the first model in which the grasp fails."""
    at_least: dict[Metric, float] = Field(default_factory=dict)
    at_most: dict[Metric, float] = Field(default_factory=dict)
