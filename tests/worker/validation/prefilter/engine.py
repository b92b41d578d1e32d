"""An engine with the arrays of MuJoCo Warp in which MuJoCo itself steps: its verdicts must be the validator's."""

import enum
from types import SimpleNamespace

import mujoco
import numpy as np
import warp as wp


class Stand:
    """Stands in for the module `mujoco_warp`."""

    class OverflowType(enum.IntFlag):
        NEFC = 1
        NJMAX_NNZ = 2
        BROADPHASE = 4
        NARROWPHASE = 8
        CCD = 16
        EPA_HORIZON = 256

    def __init__(self, *, needs_rows: int = 0, diverges: bool = False) -> None:
        """Worlds overflow where they have fewer constraint rows than `needs_rows`; or one number is none at last."""
        self.needs_rows, self.diverges = needs_rows, diverges
        self.steps = 0

    def put_model(self, model):
        return SimpleNamespace(opt=SimpleNamespace(warn_overflow=1), mjm=model)

    def make_data(self, model, *, nworld: int, nconmax: int, njmax: int):
        def zeros(*shape: int, dtype=wp.float32):
            return wp.zeros((nworld, *shape), dtype=dtype)

        room = nworld * nconmax
        contact = SimpleNamespace(
            worldid=wp.zeros(room, dtype=wp.int32),
            geom=wp.zeros(room, dtype=wp.vec2i),
            dist=wp.zeros(room, dtype=wp.float32),
        )
        return SimpleNamespace(
            each=[mujoco.MjData(model) for _ in range(nworld)],
            njmax=njmax,
            naconmax=room,
            contact=contact,
            qpos=zeros(model.nq),
            qvel=zeros(model.nv),
            qacc_warmstart=zeros(model.nv),
            ctrl=zeros(model.nu),
            mocap_pos=zeros(model.nmocap, dtype=wp.vec3),
            mocap_quat=zeros(model.nmocap, dtype=wp.quat),
            xfrc_applied=zeros(model.nbody, dtype=wp.spatial_vector),
            overflow=zeros(dtype=wp.int32),
            nacon=wp.zeros(1, dtype=wp.int32),
            ncollision=wp.zeros(1, dtype=wp.int32),
        )

    _FIELDS = ("qpos", "qvel", "qacc_warmstart", "ctrl", "mocap_pos", "mocap_quat", "xfrc_applied")

    def _load(self, data) -> None:
        for name in self._FIELDS:
            for one, row in zip(data.each, getattr(data, name).numpy(), strict=True):
                getattr(one, name)[:] = row

    def step(self, model, data) -> None:
        self.steps += 1
        self._load(data)
        for one in data.each:
            mujoco.mj_step(model.mjm, one)
        for name in ("qpos", "qvel", "qacc_warmstart"):
            getattr(data, name).assign(np.array([getattr(one, name) for one in data.each], np.float32))
        if self.diverges and self.steps > 250:
            qpos = data.qpos.numpy()
            qpos[:, -7:] = np.nan
            data.qpos.assign(qpos)
        if data.njmax < self.needs_rows:
            data.overflow.fill_(int(self.OverflowType.NEFC))

    def fwd_position(self, model, data) -> None:
        self._load(data)
        for one in data.each:
            mujoco.mj_forward(model.mjm, one)
        found = [(w, *geoms, dist) for w, one in enumerate(data.each) for geoms, dist in _contacts(one)]
        data.nacon.fill_(len(found))
        data.ncollision.fill_(len(found))
        for name, values in (("worldid", [f[0] for f in found]), ("geom", [f[1:3] for f in found])):
            whole = getattr(data.contact, name).numpy()
            whole[: len(found)] = np.array(values, np.int32).reshape(len(found), *whole.shape[1:])
            getattr(data.contact, name).assign(whole)
        depth = data.contact.dist.numpy()
        depth[: len(found)] = [f[3] for f in found]
        data.contact.dist.assign(depth)


def _contacts(data) -> list[tuple]:
    return list(zip(data.contact.geom.tolist(), data.contact.dist.tolist(), strict=True)) if data.ncon else []
