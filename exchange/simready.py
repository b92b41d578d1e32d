"""Grasps in the USD file of their object, as the grasp feature of NVIDIA's SimReady foundation asks.

Feature: https://nvidia.github.io/simready-foundation/latest/features/FET_005_STANDARD.html. Its requirement GSP.001 is
a line (`BasisCurves`) below the default prim, named `grasp_identifier...`, along which opposing fingers close; PMT.001
is a physics material on each collider. Hand frames, joint positions and provenance are below `graspd`."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade, UsdUtils, Vt

from graspd.exchange.inputs import Case, load_case
from graspd.exchange.plan import ExportSummary, prim_name
from graspd.service.model.digests import file_sha256
from graspd.service.model.errors import InputError
from graspd.service.model.transforms import Floats, pose_to_matrix
from graspd.service.store.shards import Shard, read_shard
from graspd.service.store.usd_layers import LAYERS
from graspd.worker.files.provenance import parse_options_attribute
from graspd.worker.files.subsets import select_grasps
from graspd.worker.grasps import Posture
from graspd.worker.objects.options import UNITS, parse_options
from graspd.worker.objects.prepare import files_from_path
from graspd.worker.quality.contact import LINK_CONTACT_M
from graspd.worker.quality.probe import FACING_COS, HAND_POINTS, probe_of
from graspd.worker.rendering.sheets import best_rows, metric_at_threshold

#: Length by which a line leaves the object on either side [m]: a ray from its end meets the surface.
BEYOND_M: Final = 0.005
#: Contacts of one grasp that are tried as the ends of its line.
_TRIED: Final = 64
#: Distances from a mean contact at which the surface is searched [m].
_STEPS: Final = np.arange(0.0, 0.1, 5e-4)
_WIDTH_M: Final = 0.002
_COLOUR: Final = (0.1, 0.6, 0.2)
_TOLD: Final = ("shard_id", "method", "verdict_level", "code_version", "created", "seed", "root_link", "mu")


def closing_lines(case: Case, grasp: Posture) -> Floats:
    """Return the closing line (N, 2, 3) of each grasp in the object frame [m]; nan without contacts.
    It joins the mean contacts of two opposing sides and ends `BEYOND_M` outside the object. The sides face along the
    line between the two contacts whose normals are closest to it."""
    probe = probe_of(case.hand, case.obj, hand_points=HAND_POINTS, object_points=64)
    found = probe.nearest_points(grasp)
    near, lines = np.abs(found.distance) < LINK_CONTACT_M, np.full((len(grasp), 2, 3), np.nan)
    for row, mask in enumerate(near):
        place, normal = found.closest[row, mask], found.normal[row, mask]
        tried = np.linspace(0, len(place) - 1, min(_TRIED, len(place))).astype(int)
        between = place[tried][None] - place[tried][:, None]
        between /= np.maximum(np.linalg.norm(between, axis=2, keepdims=True), 1e-9)
        into = -np.einsum("ik,ijk->ij", normal[tried], between)
        facing = np.minimum(into, into.T)
        if facing.size and facing.max() >= -FACING_COS:
            axis = between[np.unravel_index(int(np.argmax(facing)), facing.shape)]
            along = normal @ axis
            for end, side in enumerate((along < FACING_COS, along > -FACING_COS)):
                outward = axis if end else -axis
                # The mean contact of a curved side lies inside the object.
                points = place[side].mean(axis=0) + _STEPS[:, None] * outward
                outside = probe.signed_distance(points)[0] > 0
                lines[row, end] = points[int(np.argmax(outside))] + BEYOND_M * outward
    return lines


@dataclass(frozen=True)
class _Grasps:
    """Selected grasps of one shard with their lines; `unit` [m] is that of the object's file."""

    shard: Shard
    case: Case
    rows: NDArray[np.intp]
    lines: Floats
    unit: float


def write_simready(source: Path, grasps: Sequence[Path], out: Path, *, best: int = 10) -> ExportSummary:
    """Write a copy of an object's USD file with the `best` valid grasps by epsilon; 0 for all.
    Mass, colliders and a physics material are added where the file has none; references stay valid.
    Raises InputError: the files are not USD, the grasps are of another object, or none is valid."""
    if not all(path.suffix.lower() in LAYERS for path in (source, out)):
        raise InputError(f"{source} or {out} is no USD layer; give .usd, .usda or .usdc files (unpack a .usdz)")
    if not source.is_file() or out.resolve() == source.resolve():
        raise InputError(f"{source} does not exist, or is the output file; give another output: -o OUT.usd")
    written = ExportSummary({})
    found = [_select(path, source, best, written) for path in grasps]
    if len({one.unit for one in found}) != 1:
        raise InputError("the grasps were planned with different units of the object; give those of one unit")
    asset = _Asset(source, found[0].unit)
    asset.add_physics(found[0].case, written)
    for one in found:
        asset.add_grasps(one)
    asset.write(out)
    hands = len({one.case.hand.name for one in found})
    written.counts |= {"grasps": sum(len(one.rows) for one in found), "hands": hands}
    return written


def _select(path: Path, source: Path, best: int, written: ExportSummary) -> _Grasps:
    shard, case = read_shard(path, kind="base"), load_case(path, obj=str(source))
    mask, _ = select_grasps(shard)
    rows = best_rows(shard.arrays, best or len(mask), mask)
    lines = closing_lines(case, Posture.from_columns(shard.arrays).take(rows))
    opposed = np.isfinite(lines).all(axis=(1, 2))
    if lost := int((~opposed).sum()):
        written.notes.append(f"{path.name}: {lost} grasps without opposing contacts are left out")
    _, files, stated = files_from_path(source)
    options = parse_options(files, stated | parse_options_attribute(shard.attributes.get("object_options")))
    if options.scale_to is not None or not opposed.any():
        raise InputError(f"{path}: no grasp with opposing contacts, or planned with --scale-to: plan again without it")
    return _Grasps(shard, case, rows[opposed], lines[opposed], UNITS[options.units])


class _Asset:
    """Copy of the object's stage; poses in metres are converted to the frame of its default prim."""

    def __init__(self, source: Path, unit: float) -> None:
        layer, here = Sdf.Layer.CreateAnonymous(source.name), source.resolve().parent
        layer.TransferContent(Sdf.Layer.FindOrOpen(str(source)))
        # An anonymous layer has no folder, so its paths are absolute until it is written.
        UsdUtils.ModifyAssetPaths(layer, lambda path: str(here / path) if path and (here / path).is_file() else path)
        self.layer, self.stage = layer, Usd.Stage.Open(layer)
        tops = [prim for prim in self.stage.GetPseudoRoot().GetChildren() if not prim.IsAbstract()]
        self.root: Any = self.stage.GetDefaultPrim() or (tops[0] if len(tops) == 1 else None)
        if not self.root or self.root.GetChild("graspd"):
            raise InputError(f"{source} has no default prim, or grasps already; name one, or give the original file")
        self.stage.SetDefaultPrim(self.root)
        self.metres = UsdGeom.GetStageMetersPerUnit(self.stage) * unit
        self.kilograms = UsdPhysics.GetStageKilogramsPerUnit(self.stage)
        UsdGeom.SetStageMetersPerUnit(self.stage, self.metres)
        UsdGeom.SetStageUpAxis(self.stage, UsdGeom.GetStageUpAxis(self.stage))
        UsdPhysics.SetStageKilogramsPerUnit(self.stage, self.kilograms)
        self.to_root = np.linalg.inv(np.array(UsdGeom.XformCache().GetLocalToWorldTransform(self.root), float).T)
        self.scope = UsdGeom.Scope.Define(self.stage, self.root.GetPath().AppendChild("graspd"))

    def add_grasps(self, found: _Grasps) -> None:
        said, hand, kinds = found.shard.attributes, found.case.hand, Sdf.ValueTypeNames
        number = len(self.scope.GetPrim().GetChildren())
        group = UsdGeom.Scope.Define(self.stage, self.scope.GetPath().AppendChild(prim_name(f"{hand.name}_{number}")))
        told: dict[str, Any] = {"hand": hand.name, "hand_digest": hand.digest, "object_digest": found.case.obj.digest}
        told |= {name: said[name] for name in _TOLD if name in said}
        if found.shard.path is not None:
            told["grasps_sha256"] = file_sha256(found.shard.path)
        group.GetPrim().SetCustomDataByKey("graspd", told)
        epsilon = metric_at_threshold(found.shard.arrays, "quality/epsilon")
        parts = {name: Posture.from_columns(found.shard.arrays, name) for name in ("grasp", "pregrasp", "squeeze")}
        width = _WIDTH_M / self.metres * float(np.linalg.norm(self.to_root[:3, 0]))
        for row, line in zip(found.rows.tolist(), found.lines, strict=True):
            used = {prim.GetName() for prim in self.root.GetChildren()}
            name = next(name for k in range(1, 10**6) if (name := f"grasp_identifier_{k:02}") not in used)
            curve = UsdGeom.BasisCurves.Define(self.stage, self.root.GetPath().AppendChild(name))
            ends = line / self.metres @ self.to_root[:3, :3].T + self.to_root[:3, 3]
            curve.CreateTypeAttr(UsdGeom.Tokens.linear)
            curve.CreateCurveVertexCountsAttr([2])
            curve.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(ends.astype(np.float32)))
            curve.CreateWidthsAttr([width])
            curve.SetWidthsInterpolation(UsdGeom.Tokens.constant)
            curve.CreatePurposeAttr(UsdGeom.Tokens.guide)
            curve.CreateDisplayColorAttr([Gf.Vec3f(*_COLOUR)])
            curve.CreateExtentAttr(UsdGeom.Boundable.ComputeExtentFromPlugins(curve, 0))
            at = group.GetPath().AppendChild(f"grasp_{name.rpartition('_')[2]}")
            curve.GetPrim().CreateRelationship("graspd:frame").SetTargets([at])
            # The frame of the root link at the grasp [m], without scale.
            matrix = pose_to_matrix(parts["grasp"].hand_pose[row])
            matrix[:3, 3] /= self.metres
            frame = UsdGeom.Xform.Define(self.stage, at)
            frame.AddTransformOp().Set(Gf.Matrix4d((self.to_root @ matrix).T))
            frame = frame.GetPrim()
            frame.CreateAttribute("graspd:row", kinds.Int).Set(row)
            frame.CreateAttribute("graspd:epsilon", kinds.Double).Set(float(epsilon[row]))
            frame.CreateAttribute("graspd:jointNames", kinds.StringArray).Set(list(hand.joint_names))
            for key, part in parts.items():
                joints = frame.CreateAttribute(f"graspd:{key}:jointPositions", kinds.DoubleArray)
                joints.Set(part.joint_positions[row].tolist())

    def add_physics(self, case: Case, written: ExportSummary) -> None:
        """Add a rigid body, colliders, mass and a physics material where the object has none."""
        parts = list(Usd.PrimRange(self.root, Usd.TraverseInstanceProxies()))
        body = next((prim for prim in parts if prim.HasAPI(UsdPhysics.RigidBodyAPI)), self.root)
        UsdPhysics.RigidBodyAPI.Apply(body)
        colliders = [prim for prim in parts if prim.HasAPI(UsdPhysics.CollisionAPI)]
        if not colliders:
            colliders = [prim for prim in parts if prim.IsA(UsdGeom.Gprim) and not prim.IsInstanceProxy()]
            for prim in colliders:
                UsdPhysics.CollisionAPI.Apply(prim)
                if prim.IsA(UsdGeom.Mesh):
                    UsdPhysics.MeshCollisionAPI.Apply(prim).CreateApproximationAttr("convexDecomposition")
            written.notes.append(f"{len(colliders)} colliders added (convexDecomposition)")
        if not any((UsdPhysics.MassAPI(prim).GetMassAttr().Get() or 0) > 0 for prim in parts):
            UsdPhysics.MassAPI.Apply(body).CreateMassAttr(case.obj.mass / self.kilograms)
            written.notes.append(f"mass of {case.obj.mass:g} kg added")
        bare = []
        for prim in colliders:
            found = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")[0]
            if not found or not found.GetPrim().HasAPI(UsdPhysics.MaterialAPI):
                bare.append(prim)
        if not bare:
            return
        material = UsdShade.Material.Define(self.stage, self.scope.GetPath().AppendChild("physics_material"))
        friction = UsdPhysics.MaterialAPI.Apply(material.GetPrim())
        friction.CreateStaticFrictionAttr(case.obj.friction)
        friction.CreateDynamicFrictionAttr(case.obj.friction)
        friction.CreateRestitutionAttr(0.0)
        for prim in bare:
            while prim.IsInstanceProxy():  # Only the instance itself can be changed.
                prim = prim.GetParent()
            binding = UsdShade.MaterialBindingAPI.Apply(prim)
            binding.Bind(material, UsdShade.Tokens.weakerThanDescendants, "physics")
        written.notes.append(f"physics material of friction {case.obj.friction:g} added")

    def write(self, out: Path) -> None:
        # The stage would look for the layers at their new paths.
        del self.stage, self.root, self.scope
        folder = out.resolve().parent
        folder.mkdir(parents=True, exist_ok=True)
        UsdUtils.ModifyAssetPaths(
            self.layer,
            lambda path: Path(os.path.relpath(path, folder)).as_posix() if Path(path).is_absolute() else path,
        )
        out.unlink(missing_ok=True)
        self.layer.Export(str(out))
