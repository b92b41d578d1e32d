"""Text of the check of an asset: verdict, sizes and guessed values."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import typer

from graspd.service.model.states import AssetKind

#: Displacements of the surface up to this value [m] are rounding errors, and are not reported.
_NOTHING_M = 1e-7
_OVERRIDES = {"palm": "--palm LINK --approach x,y,z", "preshape": "--pre-shape JOINT=VALUE,..."}


def print_check(kind: AssetKind, report: Mapping[str, Any]) -> None:
    if report["verdict"] == "refuse":
        typer.echo(f"graspd: refused: {report['message']}", err=True)
        return
    typer.echo(f"{report['verdict']}: {report['message']}")
    for line in summary(kind, report["facts"]):
        typer.echo(f"  {line}")


def verdict_line(asset: Mapping[str, Any]) -> str:
    return f"{asset['verdict'] or 'waiting':<8} {asset['message'] or asset['name']}"


def summary(kind: AssetKind, facts: Mapping[str, Any]) -> list[str]:
    pairs = {AssetKind.HAND: _hand_rows, AssetKind.OBJECT: _object_rows, AssetKind.NETWORK: _network_rows}[kind](facts)
    return [f"{label:<18} {text}" for label, text in pairs]


def self_test_line(facts: Mapping[str, Any]) -> str:
    """Return the result of the self-test, `ready: 91 % hold, ...` or a warning; "" without self-test."""
    return str(_mapping(facts, "self_test").get("says", ""))


def payload_line(facts: Mapping[str, Any]) -> str:
    return str(_mapping(_mapping(facts, "self_test"), "limit").get("says", ""))


def _mapping(facts: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    return found if isinstance(found := facts.get(key), Mapping) else {}


def self_test_lines(facts: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return labels and texts of the self-test: its result, and the payload of the hand."""
    lines = [("self-test", self_test_line(facts)), ("payload", payload_line(facts))]
    return [(label, text) for label, text in lines if text]


def hand_line(facts: Mapping[str, Any]) -> str:
    return f"{facts.get('hand', '')} ({str(facts.get('hand_digest', ''))[:12]})"


def _hand_rows(facts: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    guessed = facts.get("guessed", [])
    if "palm_centre" in facts:
        yield "palm", f"{facts.get('root', '')} at {_vector_text(facts['palm_centre'], 1e3)} mm"
        yield "approach", _vector_text(facts["palm_approach"])
    if "fingertips" in facts:
        yield "fingertips", ", ".join(facts["fingertips"])
    if "opening_m" in facts:
        yield "opening", f"{1e3 * facts['opening_m']:.1f} mm between the pads"
    yield from self_test_lines(facts)
    if "dofs" in facts:
        yield "dofs", f"{len(facts['dofs'])}, driving {len(facts.get('joints', []))} joints"
        yield from (("", _dof_text(name, facts)) for name in facts["dofs"])
    fix = [_OVERRIDES[key] for key in guessed if key in _OVERRIDES]
    if guessed:
        yield "guessed", f"{', '.join(guessed)}{'; override: ' + ' '.join(fix) if fix else ''}"


def _dof_text(name: str, facts: Mapping[str, Any]) -> str:
    limits = f"{_angle_text(facts['lower'][name])} .. {_angle_text(facts['upper'][name])}"
    closing = {1: "closes +", -1: "closes -", 0: "spreads"}[facts["closing"][name]]
    return f"{name:<32} {limits:<18} {closing:<9} pre-shape {_angle_text(facts['preshape'][name])}"


def _object_rows(facts: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    if "extents_m" in facts:
        yield "size", f"{_vector_text(facts['extents_m'], 1e3)} mm, read as {facts.get('units', 'm')}"
    if "prepared_faces" in facts:
        faces = f"{facts['faces']} faces, simplified to {facts['prepared_faces']}"
        yield "mesh", f"{faces}; largest surface deviation {1e3 * facts['deviation_m']:.2f} mm"
    if (moved := facts.get("repair_deviation_m")) is not None and moved > _NOTHING_M:
        yield "repaired", f"surface moved by at most {1e3 * moved:.2g} mm"
    for name in ("parts", "colours"):
        if facts.get(name):
            yield name, ", ".join(facts[name])
    if "volume_m3" in facts:
        mass = facts.get("mass_kg")
        assumed = " assumed" if facts.get("mass_stated") is False else ""
        yield "volume", f"{1e6 * facts['volume_m3']:.1f} cm3" + (f", {mass:.3g} kg{assumed}" if mass else "")


def _network_rows(facts: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    if "hand_digest" in facts:
        yield "hand", f"{facts.get('hand', '')} {facts['hand_digest']}, {facts.get('joints', 0)} joints"
    if "points" in facts:
        yield "cloud", f"{facts['points']} points, {facts.get('steps', 0)} steps of the flow"
    if "file_digest" in facts:
        yield "file digest", str(facts["file_digest"])
    if facts.get("about"):
        yield "about", str(facts["about"])


def _vector_text(values: Sequence[float], scale: float = 1.0) -> str:
    return "(" + ", ".join(f"{scale * value:.4g}" for value in values) + ")"


def _angle_text(value: float) -> str:
    return "0" if math.isclose(value, 0, abs_tol=5e-4) else f"{value:.2f}"
