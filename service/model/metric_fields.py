"""Fields of pydantic models, derived from the table of metrics."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, cast

from pydantic import BaseModel, Field, create_model

from graspd.service.model.metrics import IndexLevel, indexed_metrics

M = TypeVar("M", bound=BaseModel)

if TYPE_CHECKING:
    SortedName = str
    OfferedName = str
else:
    SortedName = Literal[tuple(metric.name for metric in indexed_metrics(IndexLevel.SORTED))]
    OfferedName = Literal[tuple(metric.name for metric in indexed_metrics(IndexLevel.OFFERED))]


def value_fields(*, optional: bool, default: Any = ...) -> dict[str, Any]:
    """Return the type and field of each required or optional metric in the index, sorted metrics first."""
    return {
        metric.name: (int | None if metric.whole else float | None, Field(default, description=metric.meaning))
        for metric in sorted(indexed_metrics(), key=lambda metric: metric.indexed < IndexLevel.SORTED)
        if metric.optional == optional
    }


def mean_fields() -> dict[str, Any]:
    return {metric.name: (float | None, None) for metric in indexed_metrics(IndexLevel.OFFERED)}


def filter_fields() -> dict[str, Any]:
    fields: dict[str, Any] = {}
    for metric in indexed_metrics(IndexLevel.OFFERED):
        low, high = metric.limits
        bound = Annotated[float | None, Field(ge=low, le=high, allow_inf_nan=False)]
        fields |= {f"{end}_{metric.name}": (bound, None) for end in ("min", "max")}
    return fields


def insert_fields(**parts: Mapping[str, Any]) -> Callable[[type[M]], type[M]]:
    """Decorate a model: insert each group of fields before the field of that name, `last` at the end."""

    def decorate(model: type[M]) -> type[M]:
        base: type[BaseModel] = next(base for base in model.__bases__ if issubclass(base, BaseModel))
        fields: dict[str, Any] = {}
        for name, field in model.model_fields.items():
            if name not in base.model_fields:
                fields |= {**parts.get(name, {}), name: (field.annotation, field)}
        options: dict[str, Any] = {"__cls_kwargs__": dict(model.model_config), "__doc__": model.__doc__}
        fields |= parts.get("last", {})
        new = create_model(model.__name__, __base__=base, __module__=model.__module__, **options, **fields)
        return cast(type[M], new)

    return decorate
