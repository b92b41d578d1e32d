"""Inference of a proposal network in NumPy alone: a point cloud in, grasps out.

A cloud contains the visible points of an object on a table, in a frame with z up. A PointNet encoder computes a feature
(Qi et al., CVPR 2017: one network for every point, then the maximum). Conditional flow matching (Lipman et al., ICLR
2023, with straight paths) transforms normal noise to grasps. A grasp is a row of D = 12 + 3 J numbers, standardised by
the network's `mean` and `std`:

    0:3            position of the hand's root link minus the anchor, the mean of the cloud's points [m]
    3:9            first, then second column of the root link's rotation
    9:12           unit direction of the approach, from the standoff to the pregrasp
    12:12+J        joint positions at the grasp [rad or m]
    12+J:12+2J     pregrasp minus grasp
    12+2J:12+3J    squeeze minus grasp

Velocity of a row x at time t: MLP of [x, sin(2 pi 2^k t) k = 0..3, cos(2 pi 2^k t) k = 0..3, condition]. The condition
is [feature of the cloud, height of the anchor above the table / 0.1 m, label]."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from graspd.service.model.errors import InputError
from graspd.service.model.transforms import Floats, cross, quat_from_matrix, quat_to_matrix
from graspd.service.store.network_file import BLOCKS, CONDITION, ENCODER, POSE, Floats32, ProposalNetwork, to_bytes

LENGTH_M: Final = 0.1  # unit of lengths in the encoder's input and in the condition [m]
#: Matrix products are split into parts of 32 rows and at most this many multiplications. OpenBLAS computes such a part
#: on one thread; other sizes or splits would round differently. A proposal is thus independent of the number of
#: proposals and of the machine's cores.
_ROWS: Final = 32
_MULTIPLICATIONS: Final = 2**18
_TINY: Final = 1e-6


@dataclass(frozen=True)
class Proposals:
    """n grasps in the cloud's frame; joints may exceed their limits, which the network does not know."""

    hand_pose: Floats  # (n, 7) pose of the hand's root link at the grasp: x y z [m], quaternion w x y z
    approach: Floats  # (n, 3) unit direction of the approach, from the standoff to the pregrasp
    joints: Floats  # (n, J) joint positions at the grasp [rad or m]
    pregrasp: Floats  # (n, J)
    squeeze: Floats  # (n, J)

    def __len__(self) -> int:
        return len(self.hand_pose)


def save(network: ProposalNetwork, path: Path) -> None:
    """Write a network's file. Raises InputError: the network is invalid, see `to_bytes`."""
    path.write_bytes(to_bytes(network))


def propose(
    network: ProposalNetwork,
    points: ArrayLike,
    normals: ArrayLike,
    *,
    table_height: float,
    count: int,
    rng: np.random.Generator,
    label: float = 1.0,
    spread: float = 1.0,
) -> Proposals:
    """Propose grasps for one cloud. The first proposals do not depend on `count`.
    Raises InputError: the cloud is empty or has another shape, or a number in it or in the output is not finite.

    `points` (P, 3) are visible points of the object [m] and `normals` (P, 3) unit normals toward the camera, in a frame
    with z up; `table_height` is z of the table [m]. `label` is 1 for grasps that hold, 0 for grasps that fail. `spread`
    is the standard deviation of the noise: 1 as in training, below 1 for likelier and less diverse grasps."""
    inputs, anchor = cloud_inputs(points, normals, table_height)
    condition = flow_conditions(network, inputs[None], np.array([anchor[2] - table_height]), label)
    noise = (spread * rng.standard_normal((count, network.row_size))).astype(np.float32)
    return decode(integrate_flow(network, noise, np.repeat(condition, count, axis=0)), anchor)


def cloud_inputs(points: ArrayLike, normals: ArrayLike, table_height: float) -> tuple[Floats32, Floats]:
    """Return the encoder's input (P, 7) of a cloud, and its anchor (3,) [m].
    A row has a point's offset from the anchor / 0.1 m, its normal, and its height above the table / 0.1 m. Raises
    InputError: the cloud is empty, of another shape, or not finite."""
    p, n = np.asarray(points, float), np.asarray(normals, float)
    if p.ndim != 2 or p.shape[1:] != (3,) or not len(p) or n.shape != p.shape:
        raise InputError(f"a cloud has points and normals (P, 3), not {p.shape} and {n.shape}")
    if not (np.isfinite(p).all() and np.isfinite(n).all() and np.isfinite(table_height)):
        raise InputError("a number in the cloud is not finite")
    anchor = p.mean(axis=0)
    height = (p[:, 2:] - table_height) / LENGTH_M
    return np.concatenate([(p - anchor) / LENGTH_M, n, height], axis=1).astype(np.float32), anchor


def flow_conditions(network: ProposalNetwork, clouds: Floats32, height: Floats, label: float = 1.0) -> Floats32:
    """Return conditions (C, 258) of the flow for C clouds (C, P, 7) of `cloud_inputs`.
    `height` (C,) is the height of their anchors above the table [m]; for `label` see `propose`."""
    found = np.empty((len(clouds), CONDITION), np.float32)
    layers = _layers(network)
    with np.errstate(all="ignore"):  # `integrate_flow` checks for overflow
        for row, cloud in zip(found, clouds, strict=True):
            h = np.asarray(cloud, np.float32)
            for i in range(len(ENCODER) - 1):
                h = np.maximum(layers[f"encoder.{i}"](h), 0)
            row[:-2] = np.maximum(layers["encoder.out"](h.max(axis=0, keepdims=True)), 0)
    found[:, -2] = np.asarray(height, float) / LENGTH_M
    found[:, -1] = label
    return found


def integrate_flow(network: ProposalNetwork, noise: Floats32, condition: Floats32) -> Floats32:
    """Integrate normal noise (n, D) under conditions (n, 258) to grasp rows: Euler steps, t = 0 to 1.
    Raises InputError: the result is not finite."""
    layers = _layers(network)
    x, c = np.asarray(noise, np.float32), np.asarray(condition, np.float32)
    with np.errstate(all="ignore"):  # checked below
        for step in range(network.steps):
            angles = 2 * np.pi * 2.0 ** np.arange(4) * (step / network.steps)
            time = np.concatenate([np.sin(angles), np.cos(angles)]).astype(np.float32)
            given = np.concatenate([x, np.broadcast_to(time, (len(x), len(time))), c], axis=1)
            h = _silu(layers["flow.in"](given))
            for block in range(BLOCKS):
                h = h + layers[f"flow.{block}.b"](_silu(layers[f"flow.{block}.a"](h)))
            x = x + layers["flow.out"](h) / np.float32(network.steps)
        found = np.asarray(x * network.std + network.mean, np.float32)
    if not np.isfinite(found).all():
        raise InputError(f"the network of {network.hand} proposes numbers that are not finite")
    return found


def encode(proposals: Proposals, anchor: ArrayLike) -> Floats:
    """Return rows (n, D) of grasps before standardisation: input of `decode`, and training target."""
    position = proposals.hand_pose[:, :3] - np.asarray(anchor, float)
    rotation = quat_to_matrix(proposals.hand_pose[:, 3:])
    joints = proposals.joints
    opened, pressed = proposals.pregrasp - joints, proposals.squeeze - joints
    parts = [position, rotation[:, :, 0], rotation[:, :, 1], proposals.approach, joints, opened, pressed]
    return np.concatenate(parts, axis=1)


def decode(rows: ArrayLike, anchor: ArrayLike) -> Proposals:
    """Return the grasps of rows (n, D); `anchor` (3,) or (n, 3). Gram-Schmidt makes rotations orthogonal."""
    x = np.asarray(rows, float)
    joints, opened, pressed = np.split(x[:, POSE:], 3, axis=1)
    first = _unit(x[:, 3:6], np.array([1.0, 0, 0]))
    second = x[:, 6:9] - (x[:, 6:9] * first).sum(axis=1, keepdims=True) * first
    # If both columns are parallel, any direction orthogonal to the first is valid.
    least = np.eye(3)[np.argmin(np.abs(first), axis=1)]
    second = _unit(second, least - (least * first).sum(axis=1, keepdims=True) * first)
    rotation = np.stack([first, second, cross(first, second)], axis=-1)
    position = x[:, :3] + np.asarray(anchor, float)
    pose = np.concatenate([position, quat_from_matrix(rotation)], axis=1)
    return Proposals(pose, _unit(x[:, 9:12], np.array([0.0, 0, -1])), joints, joints + opened, joints + pressed)


@dataclass(frozen=True)
class _Layer:
    """A linear layer, split as the comment on `_MULTIPLICATIONS` describes."""

    weight: Floats32
    """(T, inputs, outputs of a part) transposed weight in T parts; the last part is padded with zeros."""
    bias: Floats32

    @classmethod
    def from_network(cls, network: ProposalNetwork, name: str) -> _Layer:
        weight, bias = network.weights[f"{name}.weight"], network.weights[f"{name}.bias"]
        out, into = weight.shape
        width = max(1, _MULTIPLICATIONS // (_ROWS * into))
        parts = -(-out // width)
        filled = np.zeros((parts * width, into), np.float32)
        filled[:out] = weight
        return cls(np.ascontiguousarray(filled.reshape(parts, width, into).transpose(0, 2, 1)), bias)

    def __call__(self, x: Floats32) -> Floats32:
        """Return rows (n, out) for rows (n, in)."""
        n, into = x.shape
        blocks = -(-n // _ROWS)
        rows = np.zeros((blocks * _ROWS, into), np.float32)
        rows[:n] = x
        product = rows.reshape(blocks, 1, _ROWS, into) @ self.weight
        whole = product.transpose(0, 2, 1, 3).reshape(blocks * _ROWS, -1)
        return np.asarray(whole[:n, : len(self.bias)] + self.bias, np.float32)


def _layers(network: ProposalNetwork) -> Mapping[str, _Layer]:
    """Return the layers by name, cached in the network."""
    if "layers" not in vars(network):
        names = [name.removesuffix(".bias") for name in network.weights if name.endswith(".bias")]
        vars(network)["layers"] = {name: _Layer.from_network(network, name) for name in names}
    found: Mapping[str, _Layer] = vars(network)["layers"]
    return found


def _silu(x: Floats32) -> Floats32:
    """Return x times its logistic function, computed by tanh, which cannot overflow."""
    half = np.float32(0.5)
    return np.asarray(x * half * (1 + np.tanh(x * half)), np.float32)


def _unit(vectors: Floats, otherwise: Floats) -> Floats:
    """Normalise vectors (n, 3); replace zero vectors by `otherwise`."""
    chosen = np.where(np.linalg.norm(vectors, axis=1, keepdims=True) > _TINY, vectors, otherwise)
    return np.asarray(chosen / np.linalg.norm(chosen, axis=1, keepdims=True))
