"""Wrong models of the atlas: what is off by nothing changes nothing, what is off by much holds nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graspd.service.model.metrics import Axis
from graspd.service.model.studies import MapCell
from graspd.studies.stability import model_errors
from graspd.studies.stability.model_errors import ERRORS, model_error_map
from graspd.worker.engines import backend
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.validation.variant import Variant, draw

FRICTION, MASS = "friction over the model's", "mass over the model's"


def validated(monkeypatch: pytest.MonkeyPatch, name: str, amounts: tuple[float, ...]) -> list[MapCell]:
    monkeypatch.setitem(ERRORS, name, replace(ERRORS[name], amounts=amounts))
    backend.start()
    hand, obj = hand_from_path("barrett"), object_from_path("block")
    return model_error_map([hand], obj, errors=[name], fidelity="draft", count=3).cells


def test_the_models_own_friction_keeps_what_holds_and_ice_keeps_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    ice, own = validated(monkeypatch, FRICTION, (0.01, 1.0))
    assert (own.value, own.outcome, own.reached) == (1.0, "good", True)
    assert (ice.value, ice.outcome, ice.reached) == (0.0, "broken", False)


#: What of a variant stands for an error's amount.
AMOUNTS = {
    "shapes of the hand stand out [mm]": (Axis.SHAPES, lambda v: 1e3 * v.grown_m),
    FRICTION: (Axis.FRICTION, lambda v: v.friction),
    MASS: (Axis.MASS, lambda v: v.mass),
    "gains over the model's": (Axis.JOINTS, lambda v: v.gain),
    "armature [1e-4 kg m²]": (Axis.JOINTS, lambda v: 1e4 * (v.armature or 0.0)),
    "dry friction of joints [N m]": (Axis.JOINTS, lambda v: v.dry_friction or 0.0),
    "object stands off by [mm]": (Axis.POSE, lambda v: 1e3 * np.linalg.norm(v.object_shift_m)),
    "object is turned by [°]": (Axis.POSE, lambda v: np.degrees(np.linalg.norm(v.object_turn))),
    "hand stands off by [mm]": (Axis.CALIBRATION, lambda v: 1e3 * np.linalg.norm(v.hand_shift_m)),
    "centre of mass is off by [mm]": (Axis.CENTRE, lambda v: 1e3 * np.linalg.norm(v.centre_m)),
    "last finger begins later by [share of closing]": (Axis.ORDER, lambda v: max(v.lags)),
}


@pytest.mark.parametrize("name", ERRORS)
def test_amounts_within_reach_are_those_that_robust_draws(name: str) -> None:
    hand, rng, (axis, amount) = hand_from_path("barrett"), np.random.default_rng(3), AMOUNTS[name]
    drawn = [amount(draw(axis, hand, rng)) for _ in range(400)]
    low, high = ERRORS[name].drawn
    assert low - 1e-9 <= min(drawn) and max(drawn) <= high + 1e-9
    # Draws come near the ends, but for that of nothing: the bounds are no wider than they need be.
    assert high - max(drawn) < 0.2 * (high - low)
    assert low == 0.0 or min(drawn) - low < 0.2 * (high - low)


@pytest.mark.parametrize("name", ERRORS)
def test_an_amount_departs_along_one_axis_only(name: str) -> None:
    error, along = ERRORS[name], np.array([0.6, 0.0, 0.8])
    one = error.variant(hand_from_path("barrett"), error.amounts[-1], along)
    changed = [field for field, value in vars(one).items() if value != getattr(Variant(), field)]
    assert len(changed) == 1
    assert AMOUNTS[name][1](one) == pytest.approx(error.amounts[-1])


def test_a_hand_without_valid_grasps_is_no_number_and_broken(monkeypatch: pytest.MonkeyPatch) -> None:
    found = model_errors.validated_grasps

    def none(*arguments: object, **options: object) -> object:
        made = found(*arguments, **options)  # type: ignore[arg-type]
        return replace(made, grasps=made.grasps.take(np.zeros(0, int)))

    monkeypatch.setattr(model_errors, "validated_grasps", none)
    (cell,) = validated(monkeypatch, MASS, (1.0,))
    assert cell.outcome == "broken" and not np.isfinite(cell.value)
