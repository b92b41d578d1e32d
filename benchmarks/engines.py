"""Verdicts of several engines on the same candidates, free and on a table: agreement, and causes of differences.

usage: python -m benchmarks.engines DATA_DIR [--hands allegro ...] [--objects 025_mug ...] [--grasps 16] [--seed 1500]
           [--engines mujoco,physx] [--candidates FOLDER] [--page OUT.md] [--section causes ...]
           [--variants] [--release PYTHON]

Candidates are not selected by validation. Each is validated with the object's own mass and friction, and with half the
friction; cells of one hand are summed. `--variants` repeats all verdicts with one changed feature of an engine.
`--release` is the interpreter of an environment with another release of MuJoCo, whose verdicts are compared."""

from __future__ import annotations

import argparse
import json
import subprocess
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from itertools import combinations, permutations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final
from unittest.mock import patch

import mujoco
import numpy as np

from benchmarks.cells import HANDS
from graspd.exchange.inputs import Case, load_case
from graspd.service.model.errors import InputError
from graspd.studies.engines import (
    compare_frictions,
    held_back_lines,
    matrix_lines,
    plan_candidates,
    summarise_groups,
    table,
)
from graspd.worker.validation import lifting, validator
from graspd.worker.validation.decomposition import decompose
from graspd.worker.validation.engines import registry
from graspd.worker.validation.engines.registry import EngineVerdicts, check_engines
from graspd.worker.validation.model import FRICTION, MujocoOptions, scene_of
from graspd.worker.validation.protocol import Test

Key = tuple[str, ...]
#: Verdicts by hand, scene and friction; for each file those of all engines and variants, by their names.
Found = dict[Key, list[dict[str, EngineVerdicts]]]
SECTIONS: Final = ("agreement", "held-back", "starts", "causes", "releases")
HEAD: Final = """# Engines

`python -m benchmarks.engines DATA` measures these tables: verdicts of several engines on the same candidates, which no
validation selected. *Half*: half the friction. *Both*, *only first*, *only second*: numbers of grasps that hold. κ:
agreement beyond chance (Cohen). *First held: second holds*: share of the first engine's grasps that the second engine
holds. Core-ms are CPU time per verdict on a busy machine.
"""
TEXTS: Final = {
    "held-back": """Grasps are chosen if all other engines hold them; full and half friction, free and on a table.""",
    "starts": """Free grasps at full and half friction, by the penetration of hand and object at the pregrasp. Losses of
one engine only: while closing, and in pushes.""",
    "causes": """Classes of grasps that one engine holds and another loses. *Ended by*: number of these grasps on which
both engines agree once one feature of one engine is changed. In the same order, the last column counts the grasps of
equal verdicts, one per file, on which the same change makes verdicts differ.

- Table, MuJoCo holds, others turn: torsional friction. Without it in MuJoCo, all seven differences end.
- Free, Drake turns: torsional friction. With areas in Drake, three of five differences end.
- Free, MuJoCo loses while closing: penetrating pregrasps. Of five grasps, three start 2.2 to 2.6 mm deep in the object
  and two 0.5 mm. The object turns from the first stage on: by 17 to 27 degrees in MuJoCo, 3 to 11 in PhysX, 2 to 16 in
  Drake. No change of friction ends these differences; for the two of Allegro, neither do a time step of 1 ms, a rigid
  root, 10 or no iterations against slip, or stiffer and softer contacts of the hand.
- Most other losses while closing, and four of five drops on a table, are near a limit: a tenth of the friction ends
  the difference.
- Unexplained: two free grasps of Barrett that only Drake holds; on a table, a drop of Allegro and a turn of Shadow.
""",
    "releases": """Option `--release`: equal candidates and convex pieces; levels `standard` and `lift`. All verdicts
are equal. Releases before 3.8 lack a flag that the validator sets.""",
}
WIDER: Final = 0.1  # change of friction that shows which verdicts are close to a limit
DEEP_M: Final = 0.001  # penetration of pregrasps that tells two groups of grasps apart
CONTROLS: Final = 1  # grasps per file on which engines agree and which variants also validate


#: Kinds of losses, by the names of pushes and of lifts.
LOSSES: Final = {"rotated": "turned", "turned": "turned", "displaced": "dropped", "not lifted": "dropped"}


def loss_kind(reason: str) -> str:
    """Return `turned`, `dropped`, or another reason without the direction of the push."""
    name = reason.partition(" under ")[0]
    return LOSSES.get(name, name)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--hands", nargs="+", default=["allegro", "barrett", "shadow"])
    parser.add_argument("--objects", nargs="+", help="default: all")
    parser.add_argument("--scenes", nargs="+", default=["free", "table"])
    parser.add_argument("--grasps", type=int, default=16)
    parser.add_argument("--engines", default="mujoco,physx")
    parser.add_argument("--seed", type=int, default=1500)
    parser.add_argument("--candidates", type=Path, help="folder of candidates; missing ones are planned")
    parser.add_argument("--page", type=Path)
    parser.add_argument("--section", nargs="+", choices=SECTIONS, default=["agreement", "held-back"])
    parser.add_argument("--variants", action="store_true")
    parser.add_argument("--release", type=Path)
    given = parser.parse_args()
    given.objects = given.objects or sorted(path.parent.name for path in given.data.glob("objects/*/clean.stl"))
    touched: dict[str, list[Any]] = {}
    engines, found, listed = check_engines(given.engines.split(",")), Found(), dict[Key, list[Path]]()
    variants = [one for one in VARIANTS if one.partition(",")[0] in engines] if given.variants else []
    with TemporaryDirectory() as work:
        folder = given.candidates or Path(work)
        folder.mkdir(parents=True, exist_ok=True)
        for obj in given.objects:
            for hand in given.hands:
                for scene in given.scenes:
                    files = str(given.data / "hands" / HANDS[hand]), str(given.data / "objects" / obj / "clean.stl")
                    try:
                        file = folder / f"{hand}-{obj}-{scene}.h5"
                        case = load_case(plan_candidates(*files, scene, given.grasps, given.seed, file))
                        made = {friction: named(one) for friction, one in compare_frictions(case, engines).items()}
                        if "starts" in given.section and scene == "free":
                            touched.setdefault(hand, []).append(start_depths_m(case))
                        for friction, verdicts in made.items():
                            rows = differing_rows(verdicts) if variants else []
                            verdicts |= {name: variant_verdicts(case, name, friction, rows) for name in variants}
                    except InputError as error:
                        print(f"{hand}, {obj}, {scene}: {error}", flush=True)  # noqa: T201
                        continue
                    for friction, verdicts in made.items():
                        found.setdefault((hand, scene, friction), []).append(verdicts)
                        listed.setdefault((hand, scene, friction), []).append(file)
                    write(given, engines, found, touched)
        if given.release:
            add_release(given.release, found, listed)
            write(given, engines, found, touched)


def named(verdicts: list[EngineVerdicts]) -> dict[str, EngineVerdicts]:
    return {one.engine: one for one in verdicts}


def options(**changes: Any) -> Callable[[], Any]:
    """Return a change of MuJoCo's options."""

    @contextmanager
    def change() -> Iterator[None]:
        with (
            patch.object(validator, "MujocoOptions", partial(MujocoOptions, **changes)),
            patch.object(lifting, "MujocoOptions", partial(MujocoOptions, **changes)),
        ):
            yield

    return change


def without_torsion() -> Any:
    made = registry.engine_model
    return patch.object(registry, "engine_model", lambda *given: replace(made(*given), torsional_friction_m=0.0))


def with_areas() -> Any:
    from graspd.worker.validation.engines import drake

    return patch.object(drake, "MAX_DOFS", 99)


#: Engines with one changed feature; a number is a change of friction.
VARIANTS: Final[dict[str, Callable[[], Any] | float]] = {
    "mujoco, no torsional friction": options(friction=(FRICTION[0], 0.0)),
    "physx, no torsional friction": without_torsion,
    "drake, areas": with_areas,
    **{f"{one}, friction {sign:+.0%}": sign for one in ("mujoco", "physx", "drake") for sign in (-WIDER, WIDER)},
}


def differing_rows(verdicts: Mapping[str, EngineVerdicts]) -> list[int]:
    """Return the rows on which engines differ, and the first `CONTROLS` others."""
    held = np.array([one.success for one in verdicts.values()]).sum(axis=0)
    same = np.isin(held, (0, len(verdicts)))
    return [] if same.all() else sorted([*np.flatnonzero(~same).tolist(), *np.flatnonzero(same)[:CONTROLS].tolist()])


def variant_verdicts(case: Case, name: str, friction: str, rows: list[int]) -> EngineVerdicts:
    """Return verdicts of an engine with one changed feature on some rows; success is -1 for the others."""
    engine, change = name.partition(",")[0], VARIANTS[name]
    success, reasons = np.full(len(case.grasps), -1, np.int8), np.full(len(case.grasps), "", object)
    if not rows:
        return EngineVerdicts(name, success, tuple(reasons), np.zeros(len(success)), 0.0)
    placed = None if case.placed is None else replace(case.placed, index=case.placed.index[rows])
    changed = replace(case, grasps=case.grasps.take(rows), placed=placed)
    if isinstance(change, float):
        changed = replace(changed, obj=replace(case.obj, friction=case.obj.friction * (1 + change)))
    with nullcontext() if isinstance(change, float) else change():
        (made,) = compare_frictions(changed, [engine], frictions=(friction,))[friction]
    success[rows], reasons[rows] = made.success, made.reasons
    return replace(made, engine=name, success=success, reasons=tuple(reasons))


def add_release(python: Path, found: Found, listed: Mapping[Key, list[Path]]) -> None:
    """Add verdicts of MuJoCo in another environment; their name is `release` and the version."""
    asked = [str(python), "-c", "import mujoco; print(mujoco.__version__)"]
    name = f"release {subprocess.run(asked, capture_output=True, text=True, check=True).stdout.strip()}"
    for place in sorted({key[1:] for key in listed}):
        scene, friction = place
        cells = [key for key in listed if key[1:] == place]
        of_file = {str(file): one for key in cells for file, one in zip(listed[key], found[key], strict=True)}
        options = [*(["--protocol", "lift"] if scene != "free" else []), *(["--hard"] if friction == "half" else [])]
        command = [str(python), "-m", "graspd", "evaluate", *of_file, "--engines", "mujoco", "--json", *options]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
        for one in json.loads(done.stdout)["files"]:
            held = np.array(one["held"]["mujoco"], np.int8)
            reasons = tuple(one["reasons"]["mujoco"])
            of_file[one["file"]][name] = EngineVerdicts(name, held, reasons, np.zeros(len(held)), 0.0)


def start_depths_m(case: Case) -> Any:
    """Return the penetration (N,) of hand and object at the pregrasps of free grasps [m]."""
    case = case.centred
    test = Test(scene_of(case.hand, case.obj, decompose(case.obj), MujocoOptions()))
    depths = []
    for row in range(len(case.grasps)):
        test.set_up(case.grasps, row)
        depths.append(test.penetration()[0])
    return np.array(depths)


def start_lines(engines: tuple[str, ...], found: Found, touched: Mapping[str, list[Any]]) -> list[str]:
    """Return the agreement on free grasps by the penetration of their pregrasps."""
    lines = table(
        "pregrasp in the object",
        "first",
        "second",
        "n",
        "agreement",
        "lost by one while closing",
        "lost by one otherwise",
    )
    cells = [
        (one, depths)
        for key, files in found.items()
        if key[1] == "free"
        for one, depths in zip(files, touched[key[0]], strict=True)
    ]
    depth = np.concatenate([depths for _, depths in cells])
    held = {name: np.concatenate([one[name].success == 1 for one, _ in cells]) for name in engines}
    closing = {
        name: np.array([reason == "lost while closing" for one, _ in cells for reason in one[name].reasons])
        for name in engines
    }
    for label, rows in ((f"{1e3 * DEEP_M:g} mm or deeper", depth >= DEEP_M), ("less deep or clear", depth < DEEP_M)):
        for a, b in combinations(engines, 2):
            differ = (held[a] != held[b]) & rows
            while_closing = differ & np.where(held[a], closing[b], closing[a])
            n, lost = int(rows.sum()), int(while_closing.sum())
            agreement = f"{1 - differ.sum() / n:.3f}" if n else "–"
            lines.append(f"| {label} | {a} | {b} | {n} | {agreement} | {lost} | {int(differ.sum()) - lost} |")
    return lines


def write(given: Any, engines: tuple[str, ...], found: Found, touched: Mapping[str, list[Any]]) -> None:
    """Print the sections with all cells so far, and replace them on the page."""
    of_engines = {key: [[one[name] for name in engines] for one in files] for key, files in found.items()}
    cells = f"{len(given.objects)} objects ({', '.join(given.objects)})"
    sample = f"{given.grasps} candidates per hand, object and kind of scene; {cells}; seed {given.seed}."
    made = {"agreement": ("Agreement", [sample, "", *matrix_lines(summarise_groups(of_engines))])}
    if len(engines) > 2:
        by_hand: dict[Key, Any] = {}
        for (hand, _, _), files in of_engines.items():
            by_hand.setdefault((hand, "all", "all"), []).extend(files)
        made["held-back"] = ("Held-back engine", [sample, "", *held_back_lines(summarise_groups(by_hand))])
    if touched:
        made["starts"] = ("Penetrating pregrasps", [sample, "", *start_lines(engines, found, touched)])
    if given.variants:
        made["causes"] = ("Causes", [sample, "", *cause_lines(engines, found)])
    if any(name.startswith("release ") for files in found.values() for one in files for name in one):
        made["releases"] = ("Two releases of MuJoCo", [sample, "", *release_lines(found)])
    for name in given.section:
        if name in made:
            heading, lines = made[name]
            text = "\n".join([f"## {heading}", "", *([TEXTS[name], ""] if name in TEXTS else []), *lines, ""])
            print(text, flush=True)  # noqa: T201
            if given.page:
                given.page.write_text(with_section(given.page.read_text() if given.page.exists() else "", text))


def with_section(page: str, section: str) -> str:
    """Return a page with a section, which replaces the one of the same heading."""
    first, *parts = (page or HEAD).split("\n## ")
    parts = [part for part in parts if part.partition("\n")[0] != section.partition("\n")[0].removeprefix("## ")]
    return "\n## ".join([first, *parts, section.removeprefix("## ")]).replace("\n\n\n", "\n\n")


def cause_lines(engines: tuple[str, ...], found: Found) -> list[str]:
    """Return the classes of grasps that one engine holds and another loses, with the changes that end the difference.
    All grasps: the same change among the grasps on which both engines agree."""
    lines = table(
        "scene",
        "holds",
        "loses",
        "loss",
        "n",
        "share",
        "hands",
        "ended by a change of one engine",
        "agreeing grasps that it parts",
    )
    for scene in ("free", "table"):
        files = [(key[0], one) for key, listed in found.items() if key[1] == scene for one in listed]
        if not files:
            continue
        hands = np.concatenate([[hand] * len(one[engines[0]].success) for hand, one in files])
        held = {name: np.concatenate([one[name].success == 1 for _, one in files]) for name in files[0][1]}
        tested = {name: np.concatenate([one[name].success >= 0 for _, one in files]) for name in held}
        for a, b in permutations(engines, 2):
            differ = held[a] & ~held[b]
            kinds = np.array([loss_kind(reason) for _, one in files for reason in one[b].reasons], object)
            for kind, count in Counter(kinds[differ].tolist()).most_common():
                mine = differ & (kinds == kind)
                ended = {}
                for name in VARIANTS:
                    engine = name.partition(",")[0]
                    if engine in (a, b) and name in held:
                        other, agree = held[b if engine == a else a], held[a] == held[b]
                        parted = agree & tested[name] & (held[name] != other)
                        ended[name] = int((held[name] == other)[mine].sum()), int(parted.sum())
                best = sorted(((name, pair) for name, pair in ended.items() if pair[0]), key=lambda one: -one[1][0])
                of_hands = ", ".join(f"{hand} {n}" for hand, n in Counter(hands[mine].tolist()).items())
                lines.append(
                    f"| {scene} | {a} | {b} | {kind} | {count} | {count / len(hands):.3f} | {of_hands} | "
                    f"{'; '.join(f'{name}: {pair[0]}' for name, pair in best) or '–'} | "
                    f"{'; '.join(f'{pair[1]}' for name, pair in best) or '–'} |"
                )
    return lines


def release_lines(found: Found) -> list[str]:
    here = f"mujoco {mujoco.__version__}"
    there = next(name for name in next(iter(found.values()))[0] if name.startswith("release "))
    both: dict[Key, list[list[EngineVerdicts]]] = {
        key: [[replace(one["mujoco"], engine=here), one[there]] for one in files] for key, files in found.items()
    }
    rows: Mapping[Key, Any] = summarise_groups(both)
    lines = table(
        "hand",
        "scene",
        "friction",
        "n",
        f"{here} holds",
        f"{there.replace('release', 'mujoco')} holds",
        "agreement",
        "κ",
        "losses of grasps that differ",
    )
    for key, row in rows.items():
        pair = row["pairs"][0]
        lost = ", ".join(f"{count} {reason}" for reason, count in pair["differences"].items())
        kappa = "–" if pair["kappa"] is None else f"{pair['kappa']:.2f}"
        held = " | ".join(f"{row['success'][name]:.3f}" for name in (here, there))
        lines.append(f"| {' | '.join(key)} | {row['n']} | {held} | {pair['agreement']:.3f} | {kappa} | {lost} |")
    return lines


if __name__ == "__main__":
    main()
