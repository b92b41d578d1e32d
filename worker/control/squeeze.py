"""Contact forces that balance and hold an object, and the joint torques that exert them.

The hand is position-controlled: q_squeeze = q + Kp^-1 sum_i J_i^T f_i (Dexonomy). The forces f are non-negative
combinations of friction pyramid edges without a net wrench, and their normal components sum to a given force."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import warp as wp

from graspd.service.model.transforms import Floats
from graspd.worker.grasps import Posture
from graspd.worker.quality.posed import PostureData
from graspd.worker.quality.probe import FACING_COS
from graspd.worker.simulation.kernels import balance as kernels
from graspd.worker.simulation.kernels import touching
from graspd.worker.simulation.launches import launch

#: Weight of the squared size of each edge force. It distributes the load over equally good contacts.
SPREAD: Final = 0.1
#: Weight of joint torques relative to their limits. It favours forces that need little torque.
TORQUE: Final = 0.05
#: Weight of the sum of normal forces in the fit. Scaling afterwards makes the sum exact.
SUM: Final = 10.0


@dataclass(frozen=True)
class HoldForces:
    residual: Floats
    """(N,) net wrench over the sum of normal forces, with torques divided by the object's radius.
    It is 0 if balanced, 1 if nothing presses. The residual predicts whether a grasp holds."""
    torque: Floats
    """(N, D) torques of the dofs that exert the forces [N m or N]."""


def balance_forces(
    posing: PostureData, grasp: Posture, total: float, friction: float, reach: tuple[float, float], most: int
) -> tuple[Floats, Floats]:
    """Compute balanced contact forces within torque limits: residuals and torques of `HoldForces`.
    Normal forces sum to `total` [N]. If a torque exceeds its limit, all forces are scaled down together, which keeps
    the balance. Points press within the first distance of `reach` [m]; on a finger without such points, within the
    second distance. At most `most` of these points are used, far apart from each other."""
    bodies, near = posing.nearest_points(grasp, max(reach))
    count, points, radius = len(grasp), len(posing.probe.points), posing.probe.obj.radius
    rows = int(touching.FIRST_TORQUE) + posing.hand.dofs
    with wp.ScopedDevice(posing.device):
        scratch = [wp.empty((count, points), dtype=kind) for kind in (wp.int32, wp.float64)]
        touches = wp.empty((count, posing.fingers), dtype=wp.bool)
        chosen, used = wp.empty((count, most), dtype=wp.int32), wp.empty(count, dtype=wp.int32)
        places = [wp.float64(FACING_COS), wp.float64(radius)]
        inputs = [posing.points, posing.finger, near, *reach, *places]
        launch(touching.choose_contacts, count, inputs=inputs, outputs=[touches, *scratch, chosen, used])
        matrix = wp.empty((count, most * int(touching.EDGES), rows), dtype=wp.float64)
        inputs = [posing.chain, posing.effort, posing.points, bodies, near, chosen, used]
        inputs += [wp.float64(friction), wp.float64(radius), wp.float64(SUM)]
        launch(touching.balance_columns, chosen.shape, inputs=inputs, outputs=[matrix])
        unit = wp.empty(count, dtype=wp.float64)
        launch(touching.scale_torques, count, inputs=[wp.float64(TORQUE)], outputs=[used, matrix, unit])
        target = np.zeros(rows)
        target[6] = SUM
        share = solve_nonnegative(matrix, target, SPREAD, used)
        residual = wp.empty(count, dtype=wp.float64)
        torque = wp.empty((count, posing.hand.dofs), dtype=wp.float64)
        inputs = [posing.effort, matrix, share, used, unit, wp.float64(total)]
        launch(touching.net_wrench, count, inputs=inputs, outputs=[residual, torque])
    return residual.numpy(), torque.numpy()


def solve_nonnegative(matrix: Any, target: Floats, ridge: float, count: Any) -> Any:
    """Return the x >= 0 (B, K) that minimise |M x - t|^2 + ridge^2 |x|^2 for B systems, on their device.
    `matrix` (B, K, R) has the columns of M; the first `count` (B,) of them are used; x is 0 for the others."""
    (batch, columns, rows), device = matrix.shape, matrix.device
    with wp.ScopedDevice(device):
        work = kernels.Workspace()
        work.normal, work.factor = (wp.empty((batch, rows, rows), dtype=wp.float64) for _ in range(2))
        work.residual, work.wanted = (wp.empty((batch, rows), dtype=wp.float64) for _ in range(2))
        work.used = wp.empty((batch, columns), dtype=wp.int32)
        x = wp.empty((batch, columns), dtype=wp.float64)
        feasible = wp.empty(batch, dtype=wp.int32)
        inputs = [matrix, wp.array(target, dtype=wp.float64), wp.float64(ridge), count]
        launch(kernels.solve_nonnegative, batch, inputs=inputs, outputs=[work, x, feasible])
    unsolved = np.flatnonzero(feasible.numpy() == 0)
    if len(unsolved):
        found, columns, used = x.numpy(), matrix.numpy(), count.numpy()
        for b in unsolved:
            found[b] = _solve_by_scipy(columns[b], target, ridge, int(used[b]))
        x.assign(found)
    return x


def _solve_by_scipy(matrix: Floats, target: Floats, ridge: float, count: int) -> Floats:
    from scipy.optimize import nnls

    system = np.vstack([matrix[:count].T, ridge * np.eye(count)])
    out = np.zeros(len(matrix))
    out[:count] = nnls(system, np.concatenate([target, np.zeros(count)]))[0]
    return out
