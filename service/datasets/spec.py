"""What a user asks for: hands x objects, the options of each cell; and the record that follows from it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Final, Self

from pydantic import AfterValidator, Field, model_validator

from service.clock import timestamp
from service.datasets.records import DatasetRecord, Member, request_of
from service.digests import digest_json, job_id
from service.domain import JobOptions, Name
from service.version import STAGE_REVISIONS

#: Larger matrices are split by their user: the record of this many cells has 4 MB.
MAX_CELLS: Final = 100_000


def _once(given: tuple[str, ...]) -> tuple[str, ...]:
    """The same name twice is the same cell."""
    return tuple(dict.fromkeys(given))


Names = Annotated[tuple[Name, ...], AfterValidator(_once)]


class Matrix(JobOptions):
    """Hands x objects, and what is wanted of each cell: `grasps` is a number for each cell."""

    hands: Names = Field(min_length=1, max_length=1000, description="names of hands")
    objects: Names = Field((), max_length=MAX_CELLS, description="names of objects")
    sets: Names = Field((), max_length=100, description="names of sets of objects; these follow `objects`")

    @model_validator(mode="after")
    def _has_objects(self) -> Self:
        if not self.objects and not self.sets:
            raise ValueError("a dataset needs objects: name some, or a set of them")
        return self

    @property
    def options(self) -> JobOptions:
        """What all cells share."""
        return JobOptions(**{name: getattr(self, name) for name in JobOptions.model_fields})


class DatasetRequest(Matrix):
    """A matrix with a name."""

    name: Name = Field(description="name of the dataset")


def describe(name: str, hands: Sequence[Member], objects: Sequence[Member], options: JobOptions) -> DatasetRecord:
    """The record of a dataset. Equal hands, objects and options have the same digest, whatever the name."""
    content = {
        "hands": [[hand.name, hand.digest] for hand in hands],
        "objects": [[obj.name, obj.digest] for obj in objects],
        "options": options.model_dump(mode="json"),
    }
    pairs = ((hand, obj) for hand in hands for obj in objects)
    return DatasetRecord(
        name=name,
        digest=digest_json(content),
        hands=tuple(hands),
        objects=tuple(objects),
        options=options,
        revisions=dict(STAGE_REVISIONS),
        jobs=tuple(job_id(request_of(options, h.name, o.name), h.digest, o.digest) for h, o in pairs),
        created=timestamp(),
    )
