"""Pages of hands and objects: lists, an object in 3D, a hand with a form to correct guesses."""

from collections.abc import Iterator
from contextlib import suppress
from functools import lru_cache
from typing import Any, Final

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, RedirectResponse
from starlette.datastructures import FormData

from graspd.api.catalog.assets import Assets
from graspd.api.dashboard.forms import first_message
from graspd.api.dashboard.rendering import redirect, render
from graspd.api.routes.assets import CorrectionRequest, store_correction
from graspd.api.routes.dependencies import READ, SUBMIT, AssetsOf, Cursor
from graspd.service.index.views import AssetView
from graspd.service.model.errors import ConflictError, InputError, NotFoundError
from graspd.service.model.states import AssetKind
from graspd.service.store.asset_summary import hand_line, payload_line, self_test_line
from graspd.service.store.assets import BUILTIN_LICENCE
from graspd.service.store.descriptions import MAX_ENTRIES, HandFacts, read_document

PAGE_SIZE: Final = 50
_CHECK_S: Final = 2
_MAX_FIELDS: Final = 16 + 3 * MAX_ENTRIES
_COUNTED: Final = (("dofs", "Joints"), ("fingertips", "Fingertips"))

router = APIRouter(include_in_schema=False)


@router.get("/hands", dependencies=READ)
def hands_page(request: Request, assets: AssetsOf, cursor: Cursor = None) -> HTMLResponse:
    """Show all hands, also refused ones; their pages state the reason."""
    networks = [] if cursor else assets.page(AssetKind.NETWORK, limit=PAGE_SIZE).items
    about = {"networks": networks, "network_hands": {one.digest: hand_line(one.facts) for one in networks}}
    return _render_list(request, assets, AssetKind.HAND, cursor, **about)


@router.get("/objects", dependencies=READ)
def objects_page(request: Request, assets: AssetsOf, cursor: Cursor = None) -> HTMLResponse:
    """Show all objects, also refused ones; their pages state the reason."""
    return _render_list(request, assets, AssetKind.OBJECT, cursor, networks=[])


def _render_list(request: Request, assets: Assets, kind: AssetKind, cursor: str | None, **context: Any) -> HTMLResponse:
    page = assets.page(kind, limit=PAGE_SIZE, cursor=cursor, refused=True)
    return render(
        request,
        "assets.html",
        poll_s=2 * _CHECK_S,
        kind=kind.value,
        assets=[(one, _short_facts(assets, one)) for one in page.items],
        next=page.next,
        datasets=assets.datasets_of([one.digest for one in page.items]),
        self_tests={one.digest: self_test_line(one.facts) for one in page.items},
        **context,
    )


def _short_facts(assets: Assets, asset: AssetView) -> list[tuple[str, str]]:
    """Return labels and texts. `facts` contains data from the upload, so values may be of any type."""
    facts = asset.facts
    if asset.builtin:
        facts = _builtin_facts(assets, asset.kind, asset.digest) | facts
    rows = [(label, str(len(one))) for name, label in _COUNTED if isinstance(one := facts.get(name), list)]
    if isinstance(opening := facts.get("opening_m"), int | float):
        rows.append(("Opening", f"{1e3 * opening:.0f} mm"))
    if isinstance(extents := facts.get("extents_m"), list):
        rows.append(("Size", " × ".join(f"{1e3 * one:.0f}" for one in extents if isinstance(one, int | float)) + " mm"))
    if isinstance(mass := facts.get("mass_kg"), int | float):
        rows.append(("Mass", f"{mass:.3g} kg"))
    licence = facts.get("licence") or (BUILTIN_LICENCE if asset.builtin else "not stated")
    return [*rows, ("Licence", str(licence))]


@lru_cache(maxsize=16)
def _builtin_facts(assets: Assets, kind: AssetKind, digest: str) -> dict[str, Any]:
    """Return the facts of a built-in hand or object from its model, because it has no check."""
    with suppress(NotFoundError, ConflictError):
        asset = assets.get(kind, digest)
        if kind is AssetKind.HAND:
            return assets.hand_facts(asset).model_dump()
        return dict(read_document(assets.model(asset))["asset"]["extras"])
    return {}


@router.get("/objects/{name}", dependencies=READ)
def object_page(request: Request, name: str, assets: AssetsOf) -> HTMLResponse:
    found = assets.get(AssetKind.OBJECT, name)
    checked = found.builtin or found.verdict is not None
    return render(
        request,
        "object.html",
        poll_s=0 if checked else _CHECK_S,
        object=found,
        checked=checked,
        facts=_short_facts(assets, found),
        datasets=assets.datasets_of([found.digest])[found.digest],
    )


@router.get("/hands/{name}", dependencies=READ)
def hand_page(request: Request, name: str, assets: AssetsOf) -> HTMLResponse:
    hand = assets.get(AssetKind.HAND, name)
    facts, trouble = _load_facts(assets, hand)
    return _render_hand(request, hand, facts, problem=trouble, form=_form_of(facts) if facts else {})


@router.post("/hands/{name}", dependencies=SUBMIT, response_model=None)
async def correct(request: Request, name: str, assets: AssetsOf) -> HTMLResponse | RedirectResponse:
    async with request.form(max_files=0, max_fields=_MAX_FIELDS) as fields:
        return await request.app.state.uploads.run(_correct, request, assets, name, fields)


def _correct(request: Request, assets: Assets, name: str, fields: FormData) -> HTMLResponse | RedirectResponse:
    hand = assets.get(AssetKind.HAND, name)
    facts = assets.hand_facts(hand)
    shown = _form_of(facts) | {key: value for key, value in fields.multi_items() if isinstance(value, str)}
    shown["fingertips"] = [str(value) for value in fields.getlist("fingertip")]
    try:
        said = CorrectionRequest.model_validate(dict(_changed_fields(facts, shown)))
        made = store_correction(assets, hand.digest, said, said.name)
    except (InputError, ConflictError, ValueError) as error:
        return _render_hand(request, hand, facts, problem=first_message(error), form=shown, status=422)
    return redirect(f"/hands/{made.digest}", f"The hand {made.name} is saved; a worker checks it.")


def _render_hand(
    request: Request, hand: AssetView, facts: HandFacts | None, *, problem: str, form: dict[str, Any], status: int = 200
) -> HTMLResponse:
    guessed = hand.facts.get("guessed")
    checked = hand.builtin or hand.verdict is not None
    waits = (facts is None or not checked) and hand.verdict != "refuse" and not problem
    return render(
        request,
        "hand.html",
        status=status,
        poll_s=_CHECK_S if waits else 0,
        hand=hand,
        facts=facts,
        waits=waits,
        problem=problem,
        form=form,
        guessed=guessed if isinstance(guessed, list) else [],
        self_test=self_test_line(hand.facts),
        short_facts=_short_facts(request.app.state.assets, hand),
        datasets=request.app.state.assets.datasets_of([hand.digest])[hand.digest],
        limit=payload_line(hand.facts),
    )


def _load_facts(assets: Assets, hand: AssetView) -> tuple[HandFacts | None, str]:
    """Return the facts of a hand, or why it cannot be shown; neither while its check runs."""
    try:
        return assets.hand_facts(hand), ""
    except NotFoundError:
        return None, ""
    except ConflictError as error:
        return None, str(error)


def _form_of(facts: HandFacts) -> dict[str, Any]:
    form: dict[str, Any] = {"palm_link": facts.root, "name": "", "fingertips": facts.fingertips}
    for axis, centre, approach in zip("xyz", facts.palm_centre, facts.palm_approach, strict=True):
        form[f"centre_{axis}"] = f"{round(1e3 * centre, 3):g}"
        form[f"approach_{axis}"] = f"{approach:.6g}"
    for number, dof in enumerate(facts.dofs):
        form[f"closing.{number}"] = str(facts.closing[dof])
        form[f"preshape.{number}"] = f"{facts.preshape[dof]:.6g}"
    return form


def _changed_fields(facts: HandFacts, form: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield differences between form and facts, as fields of a request."""
    before = _form_of(facts)
    if name := form["name"].strip():
        yield "name", name
    palm = [f"{what}_{axis}" for what in ("centre", "approach") for axis in "xyz"]
    if any(form[key] != before[key] for key in ("palm_link", *palm)):
        x, y, z, *approach = (_parse_number(form, key) for key in palm)
        yield "palm", {"link": form["palm_link"], "centre": [x / 1e3, y / 1e3, z / 1e3], "approach": approach}
    for name, read in (("closing", _parse_direction), ("preshape", _parse_number)):
        keys = {dof: f"{name}.{number}" for number, dof in enumerate(facts.dofs)}
        yield name, {dof: read(form, key) for dof, key in keys.items() if form[key] != before[key]}
    if set(form["fingertips"]) != set(facts.fingertips):
        yield "fingertips", form["fingertips"]


def _parse_number(form: dict[str, Any], key: str) -> float:
    try:
        return float(form[key])
    except ValueError:
        raise InputError(f"{key.replace('_', ' ')} {form[key][:40]!r} is no number") from None


def _parse_direction(form: dict[str, Any], key: str) -> int:
    if form[key] not in ("-1", "0", "1"):
        raise InputError(f"{key} {form[key][:40]!r} must be -1, 0 or 1")
    return int(form[key])
