"""Request of a user: hands x objects and the options of each cell; and the record derived from it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated, Final, Self

from pydantic import AfterValidator, Field, field_validator, model_validator

from graspd.service.model.base import Name
from graspd.service.model.clock import timestamp
from graspd.service.model.digests import digest_json, job_id
from graspd.service.model.domain import JobOptions, JobRequest
from graspd.service.model.fidelity import AUTO
from graspd.service.model.records import Choice, DatasetRecord, Member, request_of
from graspd.service.model.renamed import original_request
from graspd.service.model.version import STAGE_REVISIONS

#: Most cells of a dataset: a record of this many cells has 4 MB.
MAX_CELLS: Final = 100_000


#: Unique names, because repeated names would be one cell.
Names = Annotated[tuple[Name, ...], AfterValidator(lambda given: tuple(dict.fromkeys(given)))]


class Matrix(JobOptions):
    """Hands x objects, and the options of each cell; `grasps` is a number for each cell."""

    SUBMITTED = True

    hands: Names = Field(min_length=1, max_length=1000, description="names of hands")
    objects: Names = Field((), max_length=MAX_CELLS, description="names of objects")
    sets: Names = Field((), max_length=100, description="names of sets of objects; these follow `objects`")

    @model_validator(mode="after")
    def _has_objects(self) -> Self:
        if not self.objects and not self.sets:
            raise ValueError("a dataset needs objects: name objects, or a set of objects")
        return self

    @property
    def shared(self) -> JobOptions:
        return JobOptions(**{name: getattr(self, name) for name in JobOptions.model_fields})


class DatasetRequest(Matrix):
    name: Name = Field(description="name of the dataset; `estimate` is reserved")

    @field_validator("name")
    @classmethod
    def _is_free(cls, value: str) -> str:
        if value == "estimate":
            raise ValueError("this name is reserved for estimates; choose another one")
        return value


def describe(
    name: str,
    hands: Sequence[Member],
    objects: Sequence[Member],
    options: JobOptions,
    choose: Callable[[JobRequest], tuple[JobRequest, Choice | None]],
    owner: str = "",
    project: str = "",
) -> DatasetRecord:
    """Return the record of a dataset. Its digest follows from hands, objects, options and fidelities only.

    `choose` replaces `auto` by a fidelity, or raises InputError if none meets the target on one of the cells.
    """
    cells = [(hand, obj, *choose(request_of(options, hand.name, obj.name))) for hand in hands for obj in objects]
    fidelities = tuple(str(request.fidelity) for _, _, request, _ in cells) if options.fidelity == AUTO else ()
    found = [choice for *_, choice in cells if choice is not None]
    places = {choice: place for place, choice in enumerate(dict.fromkeys(found))}
    # Digests do not depend on newer options that are unused.
    unused = {name for name in ("options", "target") if not getattr(options, name)}
    content = {
        "hands": [[hand.name, hand.digest] for hand in hands],
        "objects": [[obj.name, obj.digest] for obj in objects],
        "options": original_request(options.model_dump(mode="json", exclude=unused)),
        **({"fidelities": fidelities} if fidelities else {}),
    }
    return DatasetRecord(
        name=name,
        digest=digest_json(content),
        hands=tuple(hands),
        objects=tuple(objects),
        options=options,
        revisions=dict(STAGE_REVISIONS),
        jobs=tuple(job_id(request, hand.digest, obj.digest, project) for hand, obj, request, _ in cells),
        fidelities=fidelities,
        choices=tuple(places),
        chosen=tuple(places[choice] for choice in found),
        created=timestamp(),
        owner=owner,
        project=project,
    )
