"""Form of a job with its estimated cost, and submission, cancellation and retry of jobs."""

from __future__ import annotations

import shlex
import time
from collections.abc import AsyncIterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final, Literal

from fastapi import APIRouter, Depends, Request
from fastapi.responses import HTMLResponse, RedirectResponse
from pydantic import ValidationError
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import FormData, UploadFile

from graspd.api.access.auth import project_scope
from graspd.api.catalog.assets import Assets
from graspd.api.catalog.jobs import Jobs
from graspd.api.dashboard.form_uploads import FILE_FIELDS, UNITS, AssetChoice, choose_asset, select_choices, shown_unit
from graspd.api.dashboard.rendering import redirect, render
from graspd.api.routes.dependencies import READ, SUBMIT, AssetsOf, JobsOf
from graspd.service.command_options import parse_pairs
from graspd.service.index.index import Index
from graspd.service.index.queries.overview import BatchCost
from graspd.service.model.base import first_error, problem_text
from graspd.service.model.clock import timestamp
from graspd.service.model.domain import FORM, JobOptions, JobRequest
from graspd.service.model.errors import GraspdError, InputError
from graspd.service.model.options import FormField, OptionRow, option_rows
from graspd.service.model.states import AssetKind, Stage
from graspd.service.pipeline.datasets.cost import estimate
from graspd.service.pipeline.datasets.spec import Estimate, Matrix

router = APIRouter(include_in_schema=False)


def fields_of(most: int) -> Any:
    """Return a dependency that reads a form of at most `most` fields."""

    async def parse_fields(request: Request) -> AsyncIterator[FormData]:
        async with request.form(max_fields=most) as found:
            yield found

    return Depends(parse_fields)


@dataclass(frozen=True)
class FormInput:
    name: str
    label: str
    hint: str
    kind: str
    """checkbox, select, number or text."""
    choices: Mapping[str, str]
    default: Any
    attributes: Mapping[str, Any]
    group: str
    many: bool
    """Whether the text is a list, separated by commas or spaces."""

    @classmethod
    def from_row(cls, row: OptionRow, form: FormField) -> FormInput:
        kind = "checkbox" if row.kind is bool else "select" if form.choices else "text"
        limits: dict[str, Any] = {}
        if row.kind in (int, float):
            bounds, kind = row.bounds, "number"
            limits = {"min": bounds.get("ge", bounds.get("gt")), "max": bounds.get("le")}
            limits = {name: f"{value:.12g}" for name, value in limits.items() if value is not None}
            limits |= {"step": "any"} if row.kind is float else {}
        elif form.placeholder:
            limits = {"maxlength": 600, "placeholder": form.placeholder}
        default: Any = row.default if row.default or kind == "number" else "" if kind == "text" else False
        default = "" if default is None else f"{default:g}" if row.kind is float else default
        label = f"{form.label} [{row.unit}]" if row.unit else form.label
        usual = f"default {form.choices.get(default, default)}" if default != "" and kind != "checkbox" else ""
        hint = "; ".join(filter(None, (form.hint, usual)))
        return cls(row.name, label, hint, kind, form.choices, default, limits, form.group, row.kind == list[str])


def inputs_of(*, cells: bool = False) -> list[FormInput]:
    """Return the fields of a job's form, or of a dataset's with `cells`."""
    rows = [(row, FORM.get(row.name)) for row in option_rows(JobOptions, "job")]
    return [FormInput.from_row(row, form) for row, form in rows if form and (form.cells or not cells)]


INPUTS: Final = inputs_of()
DEFAULTS: Final = {"hand": "allegro", "object": "mug"} | {one.name: one.default for one in INPUTS}


@router.get("/submit", dependencies=READ)
def submit_page(request: Request, assets: AssetsOf) -> HTMLResponse:
    given = {key: value for key, value in request.query_params.items() if key in DEFAULTS}
    return _render_form(request, assets, DEFAULTS | given)


@router.post("/submit", dependencies=SUBMIT, response_model=None)
async def submit(request: Request, jobs: JobsOf, assets: AssetsOf) -> HTMLResponse | RedirectResponse:
    async with request.form(max_files=2, max_fields=64) as fields:
        sent = any(isinstance(value, UploadFile) and value.filename for value in fields.values())
        # A refused file that the form refers to is read and checked like an upload.
        has_upload = sent or any(fields.get(f"{kind.value}_held") for kind in FILE_FIELDS)
        run = request.app.state.forms.run if has_upload else run_in_threadpool
        return await run(_submit, request, jobs, assets, fields)


@router.post("/jobs/{job_id}/{action}", dependencies=SUBMIT)
def act(job_id: str, action: Literal["cancel", "retry"], jobs: JobsOf) -> RedirectResponse:
    if action == "cancel":
        jobs.cancel(job_id)
        return redirect(f"/jobs/{job_id}", "The job is cancelled; finished grasps remain.")
    jobs.retry(job_id)
    return redirect(f"/jobs/{job_id}", "Failed and cancelled tasks of the job run again.")


def first_message(error: Exception) -> str:
    return first_error(error) if isinstance(error, ValidationError) else str(error)


def _submit(request: Request, jobs: Jobs, assets: Assets, fields: FormData) -> HTMLResponse | RedirectResponse:
    names = [name for name in DEFAULTS if name not in ("hand", "object")]
    form: dict[str, Any] = {name: fields[name] for name in names if isinstance(fields.get(name), str) and fields[name]}
    form |= {one.name: fields.get(one.name) == "true" for one in INPUTS if one.kind == "checkbox"}
    things = {kind: choose_asset(request, assets, fields, kind) for kind in FILE_FIELDS}
    form |= {kind.value: one.name for kind, one in things.items()}
    shown = DEFAULTS | form | {"units": shown_unit(fields)}
    refused = {one.form_field(kind): one.problem for kind, one in things.items() if one.problem}
    if any(fields.get(f"{kind.value}_fix") for kind in FILE_FIELDS):
        # A chosen file or the button of a fix only shows its result; the submit button submits.
        return _render_form(request, assets, shown, things=things, errors=refused)
    started = timestamp()
    try:
        named = {kind.value: one.name or "unnamed" for kind, one in things.items()}
        body = JobRequest.model_validate(parse_lists(form) | named)
        if refused:
            return _render_form(request, assets, shown, things=things, errors=refused, status=422)
        job = jobs.submit(body)
    except ValidationError as error:
        return _render_form(request, assets, shown, things=things, errors=refused | _errors_by_field(error), status=422)
    except InputError as error:
        problem = {"title": error.title, "detail": str(error)}
        return _render_form(request, assets, shown, things=things, problem=problem, status=error.status)
    said = "The same job existed already; this is its page." if job.created < started else "The job is submitted."
    return redirect(f"/jobs/{job.id}", said)


def _snippet(form: dict[str, Any]) -> tuple[str, str]:
    """Return the call of `graspd.Client` and the command that submit a form's job, with valid options."""
    words = [str(form["hand"]), str(form["object"])]
    calls, command = [repr(word) for word in words], ["graspd", "submit", "--hand", words[0], "--object", words[1]]
    with suppress(ValueError, GraspdError):
        request = JobRequest.model_validate(parse_lists(form)).model_dump(mode="json", exclude_defaults=True)
        for row in option_rows(JobOptions, "job"):
            if row.name in request and (typed := str(form[row.name])) != str(DEFAULTS[row.name]):
                calls.append(f"{row.name}={request[row.name]!r}")
                values = split_list(typed) if row.kind == list[str] else [typed]
                command += [part for one in values for part in (row.flags[0], one)[: 1 if row.kind is bool else 2]]
    return f"client.submit({', '.join(calls)})", shlex.join(command)


def _errors_by_field(error: ValidationError) -> dict[str, str]:
    errors: dict[str, str] = {}
    for entry in error.errors():
        said = problem_text(entry)
        # An error about several fields has no place; its message mostly starts with the name of a field.
        word = said.partition(" ")[0]
        named = next((name for name in DEFAULTS if word in (name, name.rpartition("_")[2])), "scenes")
        errors.setdefault(str(entry["loc"][0]) if entry["loc"] else named, said)
    return errors


def _render_form(
    request: Request,
    assets: Assets,
    form: dict[str, Any],
    *,
    things: dict[AssetKind, AssetChoice] | None = None,
    errors: dict[str, str] | None = None,
    problem: dict[str, str] | None = None,
    status: int = 200,
) -> HTMLResponse:
    things = things or {kind: AssetChoice(name=str(form[kind.value])) for kind in FILE_FIELDS}
    return render(
        request,
        "submit.html",
        status=status,
        form={"units": "m"} | form,
        errors=(errors := dict.fromkeys([*DEFAULTS, "file", "hand_file"], "") | (errors or {})),
        problem=problem,
        groups={
            title: [one for one in INPUTS if one.group == title] for title in dict.fromkeys(one.group for one in INPUTS)
        },
        opened=any(errors[one.name] or str(form[one.name]) != str(one.default) for one in INPUTS if one.group),
        hands=select_choices(assets, AssetKind.HAND, str(form["hand"]), things[AssetKind.HAND]),
        objects=select_choices(assets, AssetKind.OBJECT, str(form["object"]), things[AssetKind.OBJECT]),
        things={kind.value: one for kind, one in things.items()},
        cost=request.app.state.expectations.estimate(form),
        units=UNITS,
        snippet=_snippet(form),
        max_upload=request.app.state.settings.max_upload_bytes,
    )


#: Cache lifetime of the costs of batches [s].
KEPT_S: Final = 60.0


def split_list(text: str) -> list[str]:
    return text.replace(",", " ").split()


def parse_lists(form: Mapping[str, Any]) -> dict[str, Any]:
    """Return a form's fields with lists parsed. Raises InputError: a planner's option has no value."""
    found = {one.name: split_list(str(form.get(one.name, ""))) for one in INPUTS if one.many}
    form = {name: value for name, value in form.items() if value != ""}
    return {**form, **found, "options": parse_pairs(found["options"])}


class FormEstimates:
    """Estimates for the form of a job, with a cache of batch costs."""

    def __init__(self, index: Index) -> None:
        self._index = index
        self._read = lru_cache(maxsize=64)(lambda stage, scope, _: index.costs.batch_costs(stage, scope=scope))

    def estimate(self, form: Mapping[str, Any]) -> Estimate | None:
        """Return the estimate for a form; None while its values are invalid, or its fidelity is `auto`."""
        wanted = {key: value for key, value in form.items() if key not in ("hand", "object")}
        try:
            wanted = parse_lists(wanted) | {"hands": (str(form["hand"]),), "objects": (str(form["object"]),)}
            return estimate(self._index, Matrix.model_validate(wanted), costs=self._costs, scope=project_scope())
        except (ValueError, GraspdError):
            return None

    def _costs(self, stage: Stage) -> list[BatchCost]:
        return self._read(stage, project_scope(), time.monotonic() // KEPT_S)
