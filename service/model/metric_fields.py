"""Fields of models, and names, that follow from the table of metrics."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, cast

from pydantic import BaseModel, Field, create_model

from graspd.service.model.metrics import IndexLevel, indexed

M = TypeVar("M", bound=BaseModel)

if TYPE_CHECKING:
    SortedName = str
    OfferedName = str
else:
    SortedName = Literal[tuple(metric.name for metric in indexed(IndexLevel.SORTED))]
    OfferedName = Literal[tuple(metric.name for metric in indexed(IndexLevel.OFFERED))]


def values(*, optional: bool, default: Any = ...) -> dict[str, Any]:
    """Fields of a model that tells an indexed metric each: those that every shard has, or those that it may lack."""
    # Those by which grasps are sorted come first: so manifests have it.
    chosen = sorted(indexed(), key=lambda metric: metric.indexed < IndexLevel.SORTED)
    return {
        metric.name: (int | None if metric.whole else float | None, Field(default, description=metric.meaning))
        for metric in chosen
        if metric.optional == optional
    }


def means() -> dict[str, Any]:
    """Fields of a model that tells the mean of each metric that is offered; absent: None."""
    return {metric.name: (float | None, None) for metric in indexed(IndexLevel.OFFERED)}


def filters() -> dict[str, Any]:
    """Fields `min_...` and `max_...` of a query, for each metric that is offered."""
    fields: dict[str, Any] = {}
    for metric in indexed(IndexLevel.OFFERED):
        low, high = metric.limits
        bound = Annotated[float | None, Field(ge=low, le=high, allow_inf_nan=False)]
        fields |= {f"{end}_{metric.name}": (bound, None) for end in ("min", "max")}
    return fields


def with_fields(**parts: Mapping[str, Any]) -> Callable[[type[M]], type[M]]:
    """Decorator of a model of fields alone: each part stands before the field it is named after, `last` at the end."""

    def made(model: type[M]) -> type[M]:
        base: type[BaseModel] = next(base for base in model.__bases__ if issubclass(base, BaseModel))
        fields: dict[str, Any] = {}
        for name, field in model.model_fields.items():
            if name not in base.model_fields:
                fields |= dict(parts.get(name, {})) | {name: (field.annotation, field)}
        fields |= dict(parts.get("last", {}))
        anew = create_model(
            model.__name__,
            __base__=base,
            __cls_kwargs__=dict(model.model_config),
            __module__=model.__module__,
            __doc__=model.__doc__,
            **fields,
        )
        return cast(type[M], anew)

    return made
