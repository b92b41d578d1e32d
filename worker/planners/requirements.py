"""Requirements on the grasps of a job: type, digits, contact region, approach and wrist pose.

Requirements act on all steps of planning: starts, contacts of the optimisation, and selection of candidates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.contact_region import parse_cone, parse_pose, parse_region
from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import InputError
from graspd.service.model.grasp_types import BALANCED, TAXONOMY
from graspd.service.model.metrics import GraspType
from graspd.service.model.transforms import IDENTITY_POSE, Floats, quat_conjugate, quat_rotate
from graspd.worker.grasps import Posture
from graspd.worker.hands.digits import NAMES, Part, digit_names, digit_order, finger_of_body, hand_with_digits
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.pinch_postures import require_opposing
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.parts import Voxels, voxels_of
from graspd.worker.objects.region import WHOLE, ContactRegion
from graspd.worker.planners.fitting import region_points
from graspd.worker.quality.diversity import hand_points as surface_points
from graspd.worker.quality.grasp_type import RULES, Rule, pattern_of
from graspd.worker.quality.probe import HAND_POINTS, probe_of
from graspd.worker.simulation.environment import PlacedGrasps
from graspd.worker.simulation.model import ANYWHERE, AllowedContacts
from graspd.worker.simulation.obstacles import MARGIN_M, body_clearance

#: Share of the cone's angle within which hands start: the optimisation turns them.
INNER: Final = 0.6
#: Least share of the contact area in the required region.
LEAST_SHARE: Final = 0.95
#: Largest distance [m] and angle [deg] of a wrist from the demonstrated pose. They include .92 (Allegro) and .83
#: (Shadow) of the candidates that start around the pose of a valid grasp of a mug.
LIKE_M: Final = 0.04
LIKE_DEG: Final = 30.0
#: Largest angle between a direction and the nearest free direction that is tested [rad].
_SPACING: Final = 0.16
#: Number of hand points that decide the type of a candidate, and reach of their distances [m].
_POINTS: Final = 1000
_REACH_M: Final = 0.004


@dataclass(frozen=True)
class Requirements:
    type: str = "any"
    digits: tuple[str, ...] = ()
    """Digits that may touch; empty: all."""
    region: ContactRegion = WHOLE
    approach: Floats | None = None
    """(3,) axis of the cone of palm approaches; scene frame in scenes, else object frame. None: any approach."""
    cone: float = np.pi
    """Largest angle between a palm's approach and `approach` [rad]."""
    like: Floats | None = None
    """(7,) demonstrated wrist pose, object frame; None: any pose."""

    @classmethod
    def of(
        cls,
        request: JobOptions,
        hand: HandModel,
        batch: int = 0,
        *,
        obj: ObjectModel | None = None,
        origin: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> Requirements:
        """Return the requirements of a batch.
        `origin` (3,) is that of the planner's frame in the object frame [m]. Raises InputError: no such part of `obj`.
        """
        kind: str = request.type
        if kind == "balanced":
            has_thumb = "thumb" in (request.digits or digit_names(hand))
            kinds = [name for name in BALANCED if has_thumb or not RULES[name].digits]
            kind = kinds[batch % len(kinds)]
        rule, digits = RULES.get(kind), tuple[str, ...](request.digits)
        if rule is not None and rule.digits and not digits:
            digits = NAMES[: rule.digits] if rule.thumb else NAMES[1 : 1 + rule.digits]
        texts = (request.touch_region, request.avoid_region)
        regions = [_region(text, obj, np.asarray(origin)) if text else None for text in texts]
        found = cls(kind, digits, ContactRegion(*regions) if any(texts) else WHOLE)
        if request.approach_cone:
            axis, degrees = parse_cone(request.approach_cone)
            found = replace(found, approach=np.array(axis) / np.linalg.norm(axis), cone=float(np.deg2rad(degrees)))
        if request.like:
            pose = np.array(parse_pose(request.like))
            place, turn = pose[:3] - np.asarray(origin), pose[3:] / np.linalg.norm(pose[3:])
            found = replace(found, like=np.concatenate([place, turn]))
        return found if found.is_set else NOTHING

    @property
    def is_set(self) -> bool:
        pose = self.approach is not None or self.like is not None
        return self.type != "any" or bool(self.digits) or not self.region.is_whole or pose

    @property
    def rule(self) -> Rule | None:
        return RULES.get(self.type)

    @property
    def by_pads(self) -> bool:
        """Whether only fingertips may touch."""
        return self.rule is not None and self.rule.kind == GraspType.PRECISION

    @property
    def in_row(self) -> bool:
        """Whether fingertips must touch in line, so that all pads start near the object."""
        return self.by_pads and self.rule is not None and self.rule.arrangement == "line"

    @property
    def out_of_line(self) -> bool:
        """Whether fingertips must touch out of line."""
        return self.by_pads and self.rule is not None and self.rule.arrangement not in ("any", "line")

    @property
    def links(self) -> int:
        """Least number of bodies in contact."""
        return max(2, self.rule.digits if self.rule else 0)

    def check(self, hand: HandModel, obj: ObjectModel) -> None:
        """Raise InputError if the hand cannot fulfil the requirements on this object.
        It has too few digits or does not reach the object, or the object has no surface in the region. Raises
        HandError: the digits do not oppose."""
        rule, names = self.rule, digit_names(hand)
        if rule is not None and rule.digits:
            fingers = rule.digits - rule.thumb
            needed = f"{rule.digits} digits {'with' if rule.thumb else 'besides'} the thumb"
            if fingers >= len(names):
                count = f"has {len(names)}" if names else "is a gripper"
                raise InputError(f"type {self.type} needs {needed}, and {hand.name} {count}: choose power or precision")
            if len(set(self.digits) - {"thumb"}) < fingers or (rule.thumb and "thumb" not in self.digits):
                raise InputError(f"type {self.type} needs {needed}; digits name {', '.join(self.digits)}")
        require_opposing(self.hand(hand))
        if self.like is not None:
            away = float(np.linalg.norm(self.like[:3] - obj.centre_of_mass)) - obj.radius
            if away > _reach_m(hand) + LIKE_M:
                raise InputError(
                    f"{hand.name} does not reach {obj.name} from the demonstrated wrist pose: give it in metres in the "
                    "object's frame"
                )
        if not self.region.is_whole:
            region_points(obj, self.region)

    def hand(self, hand: HandModel) -> HandModel:
        """Return the hand that is planned with; see `hand_with_digits`."""
        return hand_with_digits(hand, self.digits) if self.digits else hand

    def allowed(self, hand: HandModel) -> AllowedContacts:
        """Return the allowed contacts of the whole hand."""
        rule, finger, names = self.rule, finger_of_body(hand), digit_names(hand)
        no_palm = rule is not None and rule.palm is False
        if not (self.by_pads or self.digits or no_palm or not self.region.is_whole):
            return ANYWHERE
        parts = np.full(hand.bodies, Part.WHOLE, np.int32)
        if self.by_pads:
            parts[:] = Part.NONE
            parts[list(hand.fingertips)] = Part.WHOLE
        elif no_palm:
            parts[finger < 0] = Part.NONE
        if self.digits:
            idle = [k for k, name in enumerate(names) if name not in self.digits]
            parts[np.isin(finger, idle)] = Part.NONE
        if rule is not None and rule.to_side:
            thumb = names.index("thumb")
            parts[parts != Part.NONE] = Part.SIDES
            parts[finger == thumb] = Part.NONE
            parts[hand.fingertips[thumb]] = Part.PAD
        return AllowedContacts(parts, self.region)

    def opposed_parts(self, hand: HandModel) -> tuple[NDArray[np.int32], NDArray[np.int32]] | None:
        """Return the two parts of a hand between which it holds the object, as the `Part` (L,) of each body.
        None: the pads of the digits."""
        if self.rule is None or not self.rule.to_side:
            return None
        allowed, thumb = self.allowed(hand).parts, finger_of_body(hand) == digit_names(hand).index("thumb")
        assert allowed is not None
        return np.where(thumb, allowed, Part.NONE), np.where(thumb, Part.NONE, allowed)

    def axes(self, placed: PlacedGrasps | None, count: int) -> Floats | None:
        """Return the cone's axis (N, 3) of each of `count` grasps in the object frame; None without a cone."""
        if self.approach is None:
            return None
        if placed is None:
            return np.tile(self.approach, (count, 1))
        turned = quat_rotate(quat_conjugate(np.asarray(placed.object_pose, float)[:, 3:]), self.approach)
        return np.asarray(turned[placed.index])

    def retreats(self, ways: Floats, scenes: PlacedGrasps, scene: int) -> Floats:
        """Select the directions of retreat (K, 3) with approaches in the inner part of the cone.
        `ways` are the free directions of scene number `scene`.
        Raises InputError: obstacles block the cone."""
        if self.approach is None:
            return ways
        (axis,) = self.axes(replace(scenes, index=np.array([scene])), 1)  # type: ignore[misc]
        inside = -ways @ axis >= np.cos(max(INNER * self.cone, _SPACING))
        if not inside.any():
            raise InputError("obstacles block every approach in the cone: choose another axis or a larger angle")
        return np.asarray(ways[inside])

    def has_room(self, hand: HandModel, scenes: PlacedGrasps) -> NDArray[np.bool_]:
        """Return a mask (S,) of scenes in which the palm is clear of obstacles at the demonstrated wrist pose."""
        count = len(scenes.object_pose)
        if self.like is None:
            return np.ones(count, bool)
        grasp = Posture(np.tile(self.like, (count, 1)), hand.expand(np.tile(hand.preshape, (count, 1))))
        clearance = body_clearance(hand, grasp, scenes.scenes, np.arange(count))
        return np.asarray((clearance[:, finger_of_body(hand) < 0] >= MARGIN_M).all(axis=1))

    def fulfilled(
        self, hand: HandModel, obj: ObjectModel, grasp: Posture, placed: PlacedGrasps | None, device: str = "cpu"
    ) -> NDArray[np.bool_]:
        """Return a mask (N,) of grasps with the required type, region, approach and wrist pose."""
        out = self._is_like(grasp)
        if (axes := self.axes(placed, len(grasp))) is not None:
            out &= _cosine(hand, grasp, axes) >= np.cos(self.cone)
        if self.rule is not None or not self.region.is_whole:
            points = _POINTS if self.region.is_whole else HAND_POINTS
            probe = probe_of(hand, obj, hand_points=points, object_points=64, device=device)
            found = probe.nearest_points(grasp, reach=_REACH_M)
            if self.rule is not None:
                out &= self.rule.applies(pattern_of(hand, probe, found))
            if not self.region.is_whole:
                out &= probe.region_share(found, self.region) >= LEAST_SHARE
        return out

    def failed(
        self, hand: HandModel, grasp: Posture, placed: PlacedGrasps | None, columns: Mapping[str, NDArray[Any]]
    ) -> NDArray[np.object_]:
        """Return the first requirement that each of N grasps fails; empty for a grasp that fulfils all.
        `columns` are those of `quality.table.measure`. Names are those of `service.model.planning.OUTCOMES`."""
        out = np.full(len(grasp), "", object)
        if (axes := self.axes(placed, len(grasp))) is not None:
            out[_cosine(hand, grasp, axes) < np.cos(self.cone)] = "other_approach"
        if not self.region.is_whole:
            out[~(columns["quality/region_share"] >= LEAST_SHARE)] = "outside_region"
        mask = np.asarray(columns["quality/digits"], int)
        if self.digits:
            order = [digit_names(hand)[k] for k in digit_order(hand)]
            others = sum(1 << k for k, name in enumerate(order) if name not in self.digits)
            out[(mask & others) != 0] = "other_digits"
        if self.rule is not None:
            right = np.asarray(columns["quality/grasp_type"]) == self.rule.kind
            if self.type in TAXONOMY:
                right = np.asarray(columns["quality/taxonomy_type"]) == TAXONOMY[self.type]
            elif self.rule.digits:
                right &= (mask & 1 == 1) & (np.bitwise_count(mask) == self.rule.digits)
            out[~right] = "other_type"
        out[~self._is_like(grasp)] = "other_wrist_pose"
        return out

    def like_columns(self, grasp: Posture) -> dict[str, Floats]:
        """Return distances [m] and angles [deg] (N,) of wrists from the demonstrated pose; empty without one."""
        if self.like is None:
            return {}
        distance = np.linalg.norm(grasp.hand_pose[:, :3] - self.like[:3], axis=1)
        angle = 2 * np.arccos(np.clip(np.abs(grasp.hand_pose[:, 3:] @ self.like[3:]), 0.0, 1.0))
        return {"quality/like_distance_m": distance, "quality/like_angle_deg": np.rad2deg(angle)}

    def _is_like(self, grasp: Posture) -> NDArray[np.bool_]:
        if self.like is None:
            return np.ones(len(grasp), bool)
        distance, angle = self.like_columns(grasp).values()
        return (distance <= LIKE_M) & (angle <= LIKE_DEG)


def _region(text: str, obj: ObjectModel | None, origin: Floats) -> Floats | Voxels:
    spec = parse_region(text)
    if not spec.planes:
        if obj is None:
            raise InputError(f"region {spec} needs an object")
        corners = obj.centred.vertices
        return voxels_of(obj.parts, spec, corners.min(axis=0), corners.max(axis=0), obj.name)
    half_spaces = np.array(spec.planes)
    half_spaces[:, 3] -= half_spaces[:, :3] @ origin
    return half_spaces


def _reach_m(hand: HandModel) -> float:
    """Return the hand's largest extent from its wrist in its pre-shape and at its limits [m]."""
    q = np.array([hand.preshape, hand.lower, hand.upper])
    grasp = Posture(np.tile(IDENTITY_POSE, (3, 1)), hand.expand(q))
    return float(np.linalg.norm(surface_points(hand, grasp), axis=2).max())


def _cosine(hand: HandModel, grasp: Posture, axes: Floats) -> Floats:
    return np.asarray(np.einsum("ni,ni->n", quat_rotate(grasp.hand_pose[:, 3:], hand.palm.approach), axes))


NOTHING: Final = Requirements()
