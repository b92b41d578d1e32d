"""Load a hand from its files: description, meshes, `asset.json` or `hand.json`, and default gains."""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from graspd.service.model.digests import digest_files, digest_variant
from graspd.service.model.errors import HandError, InputError, NotFoundError, did_you_mean
from graspd.service.model.states import AssetKind
from graspd.service.model.transforms import Floats, compose
from graspd.service.store.assets import builtin_files, builtin_names, strip_common_folder, unpack_file
from graspd.service.store.hand_files import find_hand_files, find_main_file, hand_name
from graspd.worker.execution_context import DEFAULT_CONTEXT, ExecutionContext
from graspd.worker.hands import collisions, guess, primitives, shapes
from graspd.worker.hands.collisions import collision_exempt_pairs
from graspd.worker.hands.guess import complete_hand
from graspd.worker.hands.jaws import jaws_of, prismatic_dofs
from graspd.worker.hands.model import ConvexPiece, Drag, HandModel, JointType, PalmFrame
from graspd.worker.hands.mounting import mounting_tree
from graspd.worker.hands.options import (
    DEFAULT_EFFORT,
    DEFAULT_FORCE,
    DEFAULT_LINEAR_STIFFNESS,
    DEFAULT_STIFFNESS,
    HandOptions,
    parse_options,
)
from graspd.worker.hands.primitives import volume
from graspd.worker.hands.robot import Joint, Mimic, Robot, joint_chain
from graspd.worker.hands.shapes import Hulls, make_pieces
from graspd.worker.hands.tendons import tendons_of
from graspd.worker.hands.tree import Tree, build_tree
from graspd.worker.hands.visuals import PlacedShape, Visuals
from graspd.worker.hands.xacro import read_robot
from graspd.worker.objects.disk_cache import caching_steps

log = logging.getLogger(__name__)

#: Density for the mass of a link without a stated mass, from the volume of its pieces [kg/m^3].
DENSITY = 1000.0


def load_hand(
    files: Mapping[str, bytes], *, name: str, digest: str, options: Mapping[str, Any] | None = None, drag: bool = False
) -> HandModel:
    """Load a hand from URDF or MJCF, meshes, and optional `asset.json` or `hand.json` (`parse_options`).
    `digest` is that of the files; `options` override keys in the files. With `drag`, joints have the files' armature
    and dry friction. Raises HandError: the files describe no usable hand; the message names the fault and the fix."""
    source = HandSource.read(files, options, name=name, digest=digest)
    with caching_steps("hand_shapes", (digest_files(AssetKind.HAND, files),), (collisions, guess, primitives, shapes)):
        hand = build_hand(source)
    return replace(hand, drag=_drag(source.robot, hand)) if drag else hand


@dataclass(frozen=True)
class HandSource:
    """Checked description of a hand, its options and files."""

    robot: Robot
    options: HandOptions
    files: Mapping[str, bytes]
    main: str
    name: str
    digest: str
    run: ExecutionContext

    @classmethod
    def read(
        cls,
        files: Mapping[str, bytes],
        options: Mapping[str, Any] | None = None,
        *,
        name: str = "",
        digest: str = "",
        run: ExecutionContext = DEFAULT_CONTEXT,
    ) -> HandSource:
        settings = parse_options(files, options)
        main = main_file(files, settings)
        return cls(read_robot(files, main, settings.xacro), settings, files, main, name, digest, run)


def build_hand(source: HandSource) -> HandModel:
    """Build the model of a hand. Raises TaskCancelled if its run is cancelled."""
    tree = build_tree(source.robot, source.options)
    hand = complete_hand(body_model(source, tree), tree, source.options)
    hand = with_default_drives(hand, stated_gains(source, tree.dof_names), dofs_without_effort(source, tree.dof_names))
    mounting, fault = build_mounting(source, hand)
    if fault:
        log.warning("%s: %s", source.name, fault)
    return replace(hand, neighbours=collision_exempt_pairs(hand), mounting=mounting)


def build_mounting(source: HandSource, hand: HandModel) -> tuple[HandModel | None, str]:
    """Return the model of the links above the hand's root, or None, and the reason if it cannot be built.
    A fault above a hand does not make the hand unusable."""
    tree = mounting_tree(source.robot, hand.root_link, source.options)
    if tree is None:
        return None, ""
    try:
        return body_model(replace(source, options=HandOptions(shapes=source.options.shapes)), tree), ""
    except HandError as error:
        return None, f"links above {hand.root_link!r} are no obstacles in scenes: {error}"


def _drag(robot: Robot, hand: HandModel) -> Drag:
    armature, dry = np.zeros((2, hand.bodies))
    for name, body in zip(hand.joint_names, hand.joint_body, strict=True):
        armature[body], dry[body] = robot.joints[name].armature, robot.joints[name].dry_friction
    return Drag(armature, dry)


def body_model(source: HandSource, tree: Tree) -> HandModel:
    """Build bodies, joints and pieces of a tree, without palm, fingers, closing and neighbours.
    Raises HandError: no part can touch, or a mesh or a number cannot be used."""
    robot, root = source.robot, tree.bodies[0].name
    base = str(PurePosixPath(source.main).parent).removeprefix(".")
    if not (pieces := _pieces(source, tree, base)):
        raise HandError.with_fixes(
            f"no link of the hand, from {root!r} on, has collision geometry, so nothing can touch",
            "add <collision> elements, or begin elsewhere: --root LINK",
            {"root": None},
        )
    joints = [body.joint for body in tree.bodies]
    drives = [tree.drives[joint.name] if joint else Mimic("", 0.0, 0.0) for joint in joints]
    number = {joint.name: body for body, joint in enumerate(joints) if joint}
    visuals = tuple(
        PlacedShape(shape, body, compose(pose, shape.pose), link)
        for link, (body, pose) in tree.links.items()
        for shape in robot.links[link].visuals
    )
    dofs = len(tree.dof_names)
    return HandModel(
        name=source.name,
        digest=source.digest,
        root_link=root,
        body_names=tuple(body.name for body in tree.bodies),
        parent=np.array([body.parent for body in tree.bodies], dtype=np.int32),
        joint_type=np.array([_joint_type(joint) for joint in joints], dtype=np.int32),
        origin=np.array([body.origin for body in tree.bodies]),
        axis=np.array([joint.axis if joint else (1.0, 0, 0) for joint in joints]),
        dof=np.array([tree.dof_names.index(d.joint) if d.joint else -1 for d in drives], dtype=np.int32),
        multiplier=np.array([d.multiplier for d in drives]),
        offset=np.array([d.offset for d in drives]),
        dof_names=tree.dof_names,
        lower=tree.lower,
        upper=tree.upper,
        effort=_effort(source, tree),
        stiffness=_stiffness(source, tree),
        preshape=np.clip(np.zeros(dofs), tree.lower, tree.upper),
        closing=np.zeros(dofs),
        joint_names=tree.joint_names,
        joint_body=np.array([number[joint] for joint in tree.joint_names], dtype=np.int32),
        palm=PalmFrame(np.zeros(3), np.array([0.0, 0, 1])),
        fingertips=(),
        pieces=pieces,
        neighbours=frozenset(),
        masses=_masses(robot, tree, pieces),
        velocity=tree.velocity,
        arm=joint_chain(robot, root),
        visuals=Visuals(visuals, source.files, base),
        frames=dict(tree.links),
        tendons=tendons_of(robot, source.options.tendons, tree.dof_names),
    )


def main_file(files: Mapping[str, bytes], options: HandOptions) -> str:
    """Return the name of the file that describes the hand: from the options, else the only one."""
    try:
        return find_main_file(files, options.file)
    except InputError as error:
        raise HandError(str(error)) from None


def _pieces(source: HandSource, tree: Tree, base: str) -> tuple[ConvexPiece, ...]:
    pieces, hulls = [], Hulls()
    for number, (name, (body, pose)) in enumerate(tree.links.items()):
        source.run.check("reading the hand")
        source.run.progress(number, len(tree.links), f"shapes of {name}")
        link = source.robot.links[name]
        as_it_looks = source.options.shapes == "visual" and link.shapes and link.visuals
        for shape in link.visuals if as_it_looks else link.shapes:
            placed = compose(pose, shape.pose)
            pieces += make_pieces(shape, body=body, pose=placed, link=name, files=source.files, base=base, hulls=hulls)
    return tuple(pieces)


def _joint_type(joint: Joint | None) -> JointType:
    if joint is None:
        return JointType.FIXED
    return JointType.PRISMATIC if joint.type == "prismatic" else JointType.REVOLUTE


def dofs_without_effort(source: HandSource, dofs: Sequence[str]) -> list[str]:
    """Return the dofs whose torque or force limit neither the robot nor the options state."""
    stated = source.options.effort
    known = dofs if isinstance(stated, float) else stated or {}
    return [dof for dof in dofs if dof not in known and source.robot.joints[dof].effort <= 0]


def _effort(source: HandSource, tree: Tree) -> Floats:
    said = source.options.effort
    efforts = dict.fromkeys(tree.dof_names, said) if isinstance(said, float) else said or {}
    assumed = dict.fromkeys(dofs_without_effort(source, tree.dof_names), DEFAULT_EFFORT)
    values = [efforts.get(dof, assumed.get(dof, source.robot.joints[dof].effort)) for dof in tree.dof_names]
    for dof, effort in zip(tree.dof_names, values, strict=True):
        if effort <= 0:
            raise HandError(f"the effort of {dof!r} is {effort:g}; it must be positive")
    return np.array(values)


def stated_gains(source: HandSource, dofs: Sequence[str]) -> dict[str, float]:
    """Return stated position gains: those of the options, else of the robot's servos."""
    said = source.options.stiffness
    if isinstance(said, float):
        return dict.fromkeys(dofs, said)
    gains = {dof: source.robot.joints[dof].stiffness for dof in dofs}
    return {dof: gain for dof, gain in gains.items() if gain} | {d: g for d, g in (said or {}).items() if d in dofs}


def _stiffness(source: HandSource, tree: Tree) -> Floats:
    stated = stated_gains(source, tree.dof_names)
    values = [stated.get(dof, DEFAULT_STIFFNESS) for dof in tree.dof_names]
    if min(values, default=1.0) <= 0:
        raise HandError("a stiffness in asset.json is not positive")
    return np.array(values)


def _masses(robot: Robot, tree: Tree, pieces: tuple[ConvexPiece, ...]) -> Floats:
    masses = np.zeros(len(tree.bodies))
    for link, (body, _) in tree.links.items():
        mass = robot.links[link].mass
        if mass is None:
            mine = [p for p in pieces if p.link == link]
            mass = DENSITY * sum(volume(p.kind, p.size, p.vertices, p.faces) for p in mine)
        masses[body] += mass
    # A body that consists of empty frames still needs a mass in simulations that move it.
    return np.maximum(masses, 1e-3)


def hand_from_path(path: str | Path, options: Mapping[str, Any] | None = None, *, drag: bool = False) -> HandModel:
    """Load a hand for the command line: a built-in's name, URDF, folder, or ZIP; `drag`: see `load_hand`.
    Raises NotFoundError: neither a file nor a built-in hand. HandError: see `load_hand`."""
    name, files, stated = files_from_path(path)
    digest = digest_variant(digest_files(AssetKind.HAND, files), options)
    return load_hand(files, name=name, digest=digest, options={**stated, **(options or {})}, drag=drag)


def files_from_path(path: str | Path) -> tuple[str, dict[str, bytes], dict[str, Any]]:
    """Return name, files and options of a hand: a URDF, its folder, a ZIP of it, or a built-in's name."""
    path = Path(path)
    if not path.is_file() and str(path) in builtin_names(AssetKind.HAND):
        return str(path), builtin_files(AssetKind.HAND, str(path)), {}
    if not path.exists():
        known = builtin_names(AssetKind.HAND)
        meant = did_you_mean(str(path), known)
        raise NotFoundError(f"{path} is neither a file nor a built-in hand ({', '.join(known)}){meant}")
    if path.suffix.lower() == ".zip":
        return path.stem, strip_common_folder(unpack_file(path)), {}
    found, main = find_hand_files(path)
    files = {name: file.read_bytes() for name, file in found.items()}
    return hand_name(path.resolve().name), files, {"file": main} if main else {}


def with_default_drives(hand: HandModel, stated: Collection[str], assumed: Sequence[str]) -> HandModel:
    """Replace the defaults of revolute joints by those of sliding joints and jaws, unless stated.
    A dof that moves pads by v [m/rad or 1] along their line gets the limit f |v| and the gain k v^2, summed over the
    pads. Each pad thus has gain k [N/m] and limit f [N] for any gearing."""
    slide, jaws = prismatic_dofs(hand), jaws_of(hand)
    if jaws is None and not slide.any():
        return hand
    gain = np.where(slide, DEFAULT_LINEAR_STIFFNESS, hand.stiffness)
    limit = np.where(slide, DEFAULT_FORCE, hand.effort)
    if jaws is not None:
        half = jaws.speed[len(jaws.speed) // 2]
        moves = np.abs(half).sum(axis=1) > 0
        gain = np.where(moves, DEFAULT_LINEAR_STIFFNESS * (half**2).sum(axis=1), gain)
        limit = np.where(moves, DEFAULT_FORCE * np.abs(half).sum(axis=1), limit)
    keeps = np.array([dof in stated for dof in hand.dof_names])
    free = np.array([dof in assumed for dof in hand.dof_names])
    return replace(hand, stiffness=np.where(keeps, hand.stiffness, gain), effort=np.where(free, limit, hand.effort))
