"""Contents of a USD stage in an isolated process, with the arguments FOLDER and MAIN.

The standard output is an NPZ: `facts` (JSON) and arrays of meshes. Numbers are the file's, at the earliest time.
Variants are those that the file selects. Matrices act on column vectors."""

import io
import json
import os
import resource
import sys
from pathlib import Path
from typing import Any, Final

import numpy as np

from graspd.service.model.errors import InputError
from graspd.service.store.usd_layers import open_layers, usd_reason
from graspd.worker.objects.formats.soup import MAX_FACES, triangulate

#: CPU time [s] and address space [bytes] of the process, below those of the check of an upload.
CPU_LIMIT_S: Final = 20
MEMORY_LIMIT_BYTES: Final = 3 * 2**30
#: Largest number of points of a mesh and of prims, and depth of the tree.
_MAX_POINTS: Final = 3 * MAX_FACES
_MAX_PRIMS: Final = 100_000
_MAX_DEPTH: Final = 64
#: Sizes of primitives.
_SIZES: Final = {"Cube": ("size",), "Sphere": ("radius",)} | dict.fromkeys(
    ("Cylinder", "Capsule", "Cone"), ("radius", "height")
)
#: Terms of a joint, and their attributes in the schemas of PhysX and Newton.
_TERMS: Final = (
    ("velocity", "physxJoint:maxJointVelocity", "newton:velocityLimit"),
    ("armature", "physxJoint:armature", "newton:armature"),
    ("dry", "physxJoint:jointFriction", "newton:friction"),
    ("effort", "urdf:limit:effort", "newton:effortLimit"),
)
_AXES: Final = ("angular", "linear", "transX", "transY", "transZ", "rotX", "rotY", "rotZ")


def main() -> None:
    root, name = Path(sys.argv[1]), sys.argv[2]
    # USD prints warnings; only the result is needed.
    answers, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    for limit, most in ((resource.RLIMIT_AS, MEMORY_LIMIT_BYTES), (resource.RLIMIT_CPU, CPU_LIMIT_S)):
        hard = resource.getrlimit(limit)[1]
        resource.setrlimit(limit, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    arrays: dict[str, Any] = {}
    try:
        facts = _Reader(root, name, arrays).facts
    except InputError as error:
        facts = {"error": str(error)}
    except Exception as error:  # USD raises arbitrary exceptions
        facts = {"error": f"{name}: {usd_reason(error, root) or type(error).__name__}"}
    buffer = io.BytesIO()
    np.savez(buffer, facts=np.frombuffer(json.dumps(facts).encode(), np.uint8), **arrays)
    data = buffer.getbuffer()
    while data:
        data = data[os.write(answers, data) :]
    os._exit(0)


class _Reader:
    """Walks a stage below its default prim, else below its root."""

    def __init__(self, root: Path, main: str, arrays: dict[str, Any]) -> None:
        from pxr import Usd, UsdGeom, UsdPhysics, UsdShade

        self.geom, self.physics, self.shade = UsdGeom, UsdPhysics, UsdShade
        self.time, self.instances = Usd.TimeCode.EarliestTime(), Usd.TraverseInstanceProxies()
        self.arrays, self.meshes = arrays, dict[str, tuple[int, int]]()
        self.prims = self.faces = 0
        layers = open_layers(root, main)
        self.stage = stage = Usd.Stage.Open(layers[main])
        for error in stage.GetCompositionErrors():
            raise InputError(f"{main}: {usd_reason(str(error), root)}; correct its references")
        self.facts: dict[str, Any] = {"shapes": [], "bodies": {}, "frames": {}, "joints": [], "masses": [], "parts": {}}
        self.facts["unit"] = UsdGeom.GetStageMetersPerUnit(stage)
        self.facts["mass_unit"] = UsdPhysics.GetStageKilogramsPerUnit(stage)
        top, cache = stage.GetDefaultPrim() or stage.GetPseudoRoot(), UsdGeom.XformCache(self.time)
        above = _matrix(cache.GetLocalToWorldTransform(top.GetParent())) if top.GetParent() else np.eye(4)
        state = {"purpose": "", "visible": True, "body": "", "collider": "", "names": (), "massed": False}
        self._visit(top, above, state, 0)
        for path in {path for joint in self.facts["joints"] for path in joint["targets"] if path}:
            if prim := stage.GetPrimAtPath(path):
                self.facts["frames"][path] = _matrix(cache.GetLocalToWorldTransform(prim)).tolist()
        # Value clips and plugins open layers that no reference names.
        for layer in stage.GetUsedLayers():
            if layer.realPath and not Path(layer.realPath).resolve().is_relative_to(root.resolve()):
                raise InputError(f"{main}: it opens a layer outside its folder; flatten the stage")

    def _visit(self, prim: Any, above: np.ndarray, state: dict[str, Any], depth: int) -> None:
        self.prims += 1
        if self.prims > _MAX_PRIMS or depth > _MAX_DEPTH:
            raise InputError(f"more than {_MAX_PRIMS} prims or {_MAX_DEPTH} levels of prims; export one asset")
        matrix, state = above, dict(state)
        if depth:
            state["names"] = (*state["names"], prim.GetName())[-8:]
        if frame := self.geom.Xformable(prim):
            own = _matrix(frame.GetLocalTransformation(self.time))
            matrix = own if frame.GetResetXformStack() else above @ own
        if image := self.geom.Imageable(prim):
            state["visible"] &= self._value(prim, "visibility") != "invisible"
            stated = image.GetPurposeAttr().HasAuthoredValue()
            state["purpose"] = state["purpose"] or (self._value(prim, "purpose") if stated else "")
        self._visit_physics(prim, matrix, state)
        if instancer := self.geom.PointInstancer(prim):
            # The prototype of each instance applies its own transform itself.
            indices, paths = instancer.GetProtoIndicesAttr().Get(self.time), instancer.GetPrototypesRel().GetTargets()
            count = len(indices or [])
            if self.prims + count > _MAX_PRIMS:
                raise InputError(f"{count} instances; at most {_MAX_PRIMS} prims are taken: export one asset")
            options = (self.geom.PointInstancer.ExcludeProtoXform, self.geom.PointInstancer.ApplyMask)
            placed = instancer.ComputeInstanceTransformsAtTime(self.time, self.time, *options) if count else []
            mask = instancer.ComputeMaskAtTime(self.time) or [True] * count
            kept = [int(index) for index, shown in zip(indices or [], mask, strict=True) if shown]
            for index, transform in zip(kept, placed, strict=True):
                prototype = self.stage.GetPrimAtPath(paths[index])
                self._visit(prototype, matrix @ _matrix(transform), state, depth + 1)
            return
        if self.geom.Gprim(prim):
            self._add_shape(prim, matrix, state)
        for child in prim.GetFilteredChildren(self.instances):
            self._visit(child, matrix, state, depth + 1)

    def _visit_physics(self, prim: Any, matrix: np.ndarray, state: dict[str, Any]) -> None:
        physics, path = self.physics, str(prim.GetPath())
        if prim.HasAPI(physics.RigidBodyAPI) and self._value(prim, "physics:rigidBodyEnabled"):
            self.facts["bodies"][path] = matrix.tolist()
            state |= {"body": path, "collider": "", "massed": False}
        if prim.HasAPI(physics.CollisionAPI):
            state["collider"] = "none" if self._value(prim, "physics:collisionEnabled") else ""
        if state["collider"] and prim.HasAPI(physics.MeshCollisionAPI):
            state["collider"] = str(self._value(prim, "physics:approximation") or "none")
        if prim.HasAPI(physics.MassAPI) and not state["massed"]:
            mass, density = (self._number(prim, f"physics:{name}") for name in ("mass", "density"))
            self.facts["masses"].append({"body": state["body"], "mass": mass, "density": density})
            # A stated mass includes the parts below.
            state["massed"] = mass > 0
        if joint := physics.Joint(prim):
            self.facts["joints"].append(self._joint(joint))

    def _add_shape(self, prim: Any, matrix: np.ndarray, state: dict[str, Any]) -> None:
        kind = str(prim.GetTypeName())
        shape: dict[str, Any] = {"kind": kind, "path": str(prim.GetPath()), "matrix": matrix.tolist()}
        if kind == "Mesh":
            shape["mesh"] = self._mesh(prim)
        elif kind in _SIZES:
            shape["size"] = [self._number(prim, name) for name in _SIZES[kind]]
            shape["axis"] = str(self._value(prim, "axis") or "Z")
        else:
            return
        material = self.shade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")[0]
        if state["collider"] and material:
            terms = (("friction", "dynamicFriction"), ("density", "density"))
            shape |= {key: self._number(material.GetPrim(), f"physics:{name}") for key, name in terms}
        shape["shown"] = state["visible"] and state["purpose"] in ("", "default", "render")
        self.facts["shapes"].append(shape | {key: state[key] for key in ("names", "body", "collider")})

    def _mesh(self, prim: Any) -> int:
        """Store a mesh once for all its instances; return its number."""
        path = str((prim.GetPrimInPrototype() if prim.IsInstanceProxy() else prim).GetPath())
        if path in self.meshes:
            self._count_faces(self.meshes[path][1])
            return self.meshes[path][0]
        skinned = prim.GetAttribute("primvars:skel:jointIndices")
        if skinned and skinned.HasAuthoredValue():
            raise InputError(f"{path}: a mesh with bones; export the posed mesh")
        points = self._value(prim, "points")
        names = ("faceVertexCounts", "faceVertexIndices")
        counts, corners = (np.array(self._value(prim, name) or [], np.int64) for name in names)
        self._count_faces(len(counts))
        if points is None or len(points) > _MAX_POINTS or len(corners) > 2 * _MAX_POINTS:
            raise InputError(f"{path}: {0 if points is None else len(points)} points; 1 to {_MAX_POINTS} are taken")
        if (counts < 0).any() or counts.sum() != len(corners):
            raise InputError(f"{path}: its faces do not match their corners; export the mesh again")
        label, parts = np.zeros(len(counts), np.int32), [""]
        colours = self._display_colours(prim, counts, corners, len(points))
        for subset in self.geom.Subset.GetAllGeomSubsets(self.geom.Imageable(prim)):
            chosen = np.array(subset.GetIndicesAttr().Get(self.time) or [], np.int64)
            if subset.GetElementTypeAttr().Get() == "face" and ((chosen >= 0) & (chosen < len(label))).all():
                label[chosen] = len(parts)
                parts.append(subset.GetPrim().GetName())
        triangles = triangulate(np.array(points, float), counts, corners)
        owner = np.repeat(np.arange(len(counts)), np.maximum(counts - 2, 0))
        turned = triangles[:, ::-1] if self._value(prim, "orientation") == "leftHanded" else triangles
        number = len(self.meshes)
        self.meshes[path], self.facts["parts"][number] = (number, len(counts)), parts
        own = {"points": np.array(points, float), "faces": turned, "label": label[owner], "colours": colours[owner]}
        self.arrays |= {f"{name}{number}": array for name, array in own.items()}
        return number

    def _count_faces(self, count: int) -> None:
        self.faces += count
        if self.faces > MAX_FACES:
            raise InputError(f"{self.faces} faces; at most {MAX_FACES} are taken: decimate the mesh first")

    def _display_colours(self, prim: Any, counts: np.ndarray, corners: np.ndarray, points: int) -> np.ndarray:
        """Return the linear display colour (F, 3) of each face, means over its corners; nan if not stated."""
        stated = self.geom.PrimvarsAPI(prim).FindPrimvarWithInheritance("displayColor")
        values = stated.ComputeFlattened(self.time) if stated and stated.HasValue() else None
        colours = np.array(values or [], float).reshape(-1, 3)
        if len(colours) == points and stated.GetInterpolation() in ("vertex", "varying"):
            colours = colours[np.clip(corners, 0, points - 1)]
        if len(colours) == len(corners) and len(colours) > 1:
            sums, ends = np.concatenate([np.zeros((1, 3)), np.cumsum(colours, axis=0)]), np.cumsum(counts)
            colours = (sums[ends] - sums[ends - counts]) / np.maximum(counts, 1)[:, None]
        fits = len(colours) in (1, len(counts))
        return np.broadcast_to(colours if fits else np.nan, (len(counts), 3)).copy()

    def _joint(self, joint: Any) -> dict[str, Any]:
        prim = joint.GetPrim()
        targets = [rel.GetForwardedTargets() for rel in (joint.GetBody0Rel(), joint.GetBody1Rel())]
        turns = [self._value(prim, f"physics:localRot{side}") for side in (0, 1)]
        found: dict[str, Any] = {
            "path": str(prim.GetPath()),
            "kind": str(prim.GetTypeName()).removeprefix("Physics").removesuffix("Joint"),
            "targets": [str(paths[0]) if paths else "" for paths in targets],
            "positions": [list(map(float, self._value(prim, f"physics:localPos{side}"))) for side in (0, 1)],
            "rotations": [[float(q.GetReal()), *map(float, q.GetImaginary())] for q in turns],
            "enabled": bool(self._value(prim, "physics:jointEnabled")),
            "excluded": bool(self._value(prim, "physics:excludeFromArticulation")),
            "limits": {},
        }
        values = {name: self._value(prim, f"physics:{name}") for name in ("axis", "lowerLimit", "upperLimit")}
        found |= {name: value for name, value in values.items() if isinstance(value, (float, str))}
        followed = [("newton:mimicJoint", "newton:mimicCoef1", "newton:mimicCoef0", 1)]
        for axis in _AXES:
            if prim.HasAPI(self.physics.DriveAPI, axis):
                terms = [f"drive:{axis}:physics:{name}" for name in ("stiffness", "maxForce")]
                found["drive"] = [self._number(prim, name) for name in terms]
            if prim.HasAPI(self.physics.LimitAPI, axis):
                ends = [self._number(prim, f"limit:{axis}:physics:{name}") for name in ("low", "high")]
                found["limits"][axis] = ends
            of_physx = (f"physxMimicJoint:{axis}:{name}" for name in ("referenceJoint", "gearing", "offset"))
            followed.append((*of_physx, -1))  # type: ignore[arg-type]
        for leader, slope, offset, sign in followed:
            if (rel := prim.GetRelationship(leader)) and (paths := rel.GetForwardedTargets()):
                found["mimic"] = [str(paths[0]), sign * self._number(prim, slope, 1), sign * self._number(prim, offset)]
        for key, of_physx, of_newton in _TERMS:  # type: ignore[assignment]
            found[key] = self._number(prim, of_physx) or self._number(prim, of_newton)  # type: ignore[arg-type]
        return found

    def _number(self, prim: Any, name: str, default: float = 0.0) -> float:
        value = self._value(prim, name)
        return float(default if value is None else value)

    def _value(self, prim: Any, name: str) -> Any:
        attribute = prim.GetAttribute(name)
        return attribute.Get(self.time) if attribute else None


def _matrix(transform: Any) -> np.ndarray:
    return np.array(transform, float).T


if __name__ == "__main__":
    main()
