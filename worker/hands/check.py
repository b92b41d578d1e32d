"""Check of an uploaded hand: accepted with notes, or refused with the reason."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from graspd.service.model.errors import InputError
from graspd.worker.execution_context import DEFAULT_CONTEXT, ExecutionContext
from graspd.worker.hands.closing import finger_chains
from graspd.worker.hands.guess import guess_approach
from graspd.worker.hands.jaws import jaws_of
from graspd.worker.hands.load import HandSource, build_hand, build_mounting, dofs_without_effort
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.options import HandOptions
from graspd.worker.hands.pinch_postures import require_opposing
from graspd.worker.hands.robot import Robot, joint_chain
from graspd.worker.hands.surface import sample_surface
from graspd.worker.hands.tree import build_tree, joints_beyond_limits, reduced_range_notes

#: Number of points that measure the outer surface.
_SURFACE_POINTS = 512
#: Entry of the guessed values if the palm may equally face the opposite way.
TIED = "approach (a tie)"


def check_hand(
    files: Mapping[str, bytes],
    name: str,
    options: Mapping[str, Any] | None = None,
    run: ExecutionContext = DEFAULT_CONTEXT,
) -> dict[str, Any]:
    """Check whether the files describe a usable hand; report progress to `run`, link by link.
    Return verdict (accept or refuse), message (one line), repairs (always empty), and facts: measured or guessed
    values in SI units. If options can fix a refusal, facts have `problem` and `options_suggested` (`HandOptions`)."""
    try:
        source = HandSource.read(files, options, name=name, digest="0" * 32, run=run)
        robot, settings = source.robot, source.options
        hand = build_hand(source)
        area = float(sample_surface(hand, _SURFACE_POINTS).area.sum())
        require_opposing(hand)
    except InputError as error:
        return {"verdict": "refuse", "message": str(error), "repairs": [], "facts": getattr(error, "facts", {})}
    stated = {
        "palm": settings.palm is not None,
        "preshape": bool(settings.preshape),
        "closing": bool(settings.closing),
        "effort": not dofs_without_effort(source, hand.dof_names),
    }
    tie = _approach_notes(hand, settings)
    notes = [
        *robot.notes,
        *tie,
        *_unclosed_finger_notes(hand),
        *_tendon_notes(hand),
        *_limit_notes(robot, settings),
        *_omitted_link_notes(robot, hand, settings),
        *_mounting_notes(source, hand),
    ]
    facts = {
        "links": len(robot.links),
        **model_facts(hand),
        "mass": float(hand.masses.sum()),
        "pieces": len(hand.pieces),
        "notes": notes,
        "surface_area_m2": area,
        "guessed": [*(key for key, said in stated.items() if not said), *([TIED] if tie else [])],
    }
    message = (
        f"{name}: {hand.dofs} degrees of freedom in {len(hand.joint_names)} joints, {len(hand.fingertips)} fingertips, "
        f"{len(hand.pieces)} convex pieces; palm {hand.root_link!r} facing {_direction_text(hand)}"
    )
    if (jaws := jaws_of(hand)) is not None:
        facts["opening_m"] = round(jaws.opening, 6)
        message += f"; opens {1e3 * jaws.opening:.0f} mm"
    return {"verdict": "accept", "message": "; ".join([message, *notes]), "repairs": [], "facts": facts}


def _tendon_notes(hand: HandModel) -> list[str]:
    pairs = [" and ".join(hand.dof_names[d] for d in tendon.dofs) for tendon in hand.tendons]
    return [f"{', '.join(pairs)} on one tendon{' each' if len(pairs) > 1 else ''}"] if pairs else []


def _unclosed_finger_notes(hand: HandModel) -> list[str]:
    chains = zip(hand.fingertips, finger_chains(hand), strict=True)
    still = [hand.body_names[tip] for tip, chain in chains if not hand.closing[hand.dof[chain]].any()]
    return [f"no joint closes the finger of {', '.join(still)}: name one with --closing JOINT=1"] if still else []


def _approach_notes(hand: HandModel, settings: HandOptions) -> list[str]:
    stated = settings.approach or (settings.palm and settings.palm.approach)
    if stated or jaws_of(hand) is not None or not guess_approach(hand)[1]:
        return []
    return ["the palm may face either way along its axis: state its direction with --approach"]


def _limit_notes(robot: Robot, settings: HandOptions) -> list[str]:
    tree = build_tree(robot, settings)
    passed = joints_beyond_limits(robot, tree, settings)
    notes = (
        [f"limits of {', '.join(passed)} are not used, as in ROS, because these joints are coupled"] if passed else []
    )
    notes += reduced_range_notes(robot, tree)
    return notes + ([f"{', '.join(tree.still)} cannot move: the limits leave one value"] if tree.still else [])


def _omitted_link_notes(robot: Robot, hand: HandModel, settings: HandOptions) -> list[str]:
    """Return notes on joints above the root: faulty ones if option `root` is set, else all moving ones."""
    chain = joint_chain(robot, hand.root_link)
    if settings.root:
        return [f"{joint.name} ({joint.type}) above the palm taken as fixed" for joint in chain if joint.fault]
    above = ", ".join(joint.name for joint in chain if joint.type != "fixed")
    note = f"{above} above the palm left out; poses are those of {hand.root_link!r} (--root {robot.root})"
    return [note] if above else []


def _mounting_notes(source: HandSource, hand: HandModel) -> list[str]:
    if hand.mounting is None:
        return [fault] if (fault := build_mounting(source, hand)[1]) else []
    links = dict.fromkeys(piece.link for piece in hand.mounting.pieces)
    return [f"{', '.join(links)} above the palm kept clear in scenes"]


def model_facts(hand: HandModel) -> dict[str, Any]:
    return {
        "bodies": hand.bodies,
        "joints": list(hand.joint_names),
        "dofs": list(hand.dof_names),
        "root": hand.root_link,
        "palm_centre": _rounded(hand.palm.centre),
        "palm_approach": _rounded(hand.palm.approach),
        "fingertips": [hand.body_names[body] for body in hand.fingertips],
        "preshape": dict(zip(hand.dof_names, _rounded(hand.preshape), strict=True)),
        "closing": dict(zip(hand.dof_names, (int(c) for c in hand.closing), strict=True)),
        "lower": dict(zip(hand.dof_names, _rounded(hand.lower), strict=True)),
        "upper": dict(zip(hand.dof_names, _rounded(hand.upper), strict=True)),
        "effort": dict(zip(hand.dof_names, _rounded(hand.effort), strict=True)),
    }


def _rounded(values: Any) -> list[float]:
    return [round(float(value), 6) for value in values]


def _direction_text(hand: HandModel) -> str:
    axis = int(np.argmax(np.abs(hand.palm.approach)))
    if abs(hand.palm.approach[axis]) > 0.999:
        return f"{'+' if hand.palm.approach[axis] > 0 else '-'}{'xyz'[axis]}"
    return "(" + ", ".join(f"{v:.2f}" for v in hand.palm.approach) + ")"
