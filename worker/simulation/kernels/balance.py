"""Non-negative least squares with a ridge, for many small systems at once.

Each system is min |M x - t|^2 + s^2 |x|^2 over x >= 0, with R rows and K columns, R much less than K. The minimum has
s^2 x = max(0, M^T r) with the residual r = t - M x. So r minimises the convex, piecewise quadratic phi(r) = s^2 |r|^2 /
2 + |max(0, M^T r)|^2 / 2 - s^2 t r, with R unknowns instead of K. Newton's method ends at the exact minimum after
finitely many steps, once the set of columns with M^T r > 0 stays the same."""

import warp as wp

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

#: Largest number of Newton steps, and of halvings of one step: 4 to 9 steps and no halving are usual.
STEPS = wp.constant(60)
HALVINGS = wp.constant(30)


@wp.struct
class Workspace:
    """Arrays of B systems."""

    normal: wp.array3d(dtype=wp.float64)
    factor: wp.array3d(dtype=wp.float64)
    residual: wp.array2d(dtype=wp.float64)
    wanted: wp.array2d(dtype=wp.float64)
    used: wp.array2d(dtype=wp.int32)


@wp.func
def column_dot(matrix: wp.array3d(dtype=wp.float64), b: int, k: int, r: wp.array2d(dtype=wp.float64)):
    """Return the product of column k of system b and the vector r[b]."""
    total = wp.float64(0.0)
    for i in range(matrix.shape[2]):
        total = total + matrix[b, k, i] * r[b, i]
    return total


@wp.func
def update_normal_matrix(matrix: wp.array3d(dtype=wp.float64), b: int, k: int, sign: wp.float64, work: Workspace):
    """Add column k to the normal matrix, or remove it."""
    for i in range(matrix.shape[2]):
        for j in range(i + 1):
            work.normal[b, i, j] = work.normal[b, i, j] + sign * matrix[b, k, i] * matrix[b, k, j]


@wp.func
def solve(target: wp.array(dtype=wp.float64), scale: wp.float64, b: int, work: Workspace):
    """Compute `wanted` = normal^-1 scale target, by Cholesky."""
    rows = target.shape[0]
    for i in range(rows):
        for j in range(i + 1):
            total = work.normal[b, i, j]
            for k in range(j):
                total = total - work.factor[b, i, k] * work.factor[b, j, k]
            if i == j:
                work.factor[b, i, j] = wp.sqrt(wp.max(total, wp.float64(1.0e-300)))
            else:
                work.factor[b, i, j] = total / work.factor[b, j, j]
    for i in range(rows):
        total = scale * target[i]
        for k in range(i):
            total = total - work.factor[b, i, k] * work.wanted[b, k]
        work.wanted[b, i] = total / work.factor[b, i, i]
    for back in range(rows):
        i = rows - 1 - back
        total = work.wanted[b, i]
        for k in range(i + 1, rows):
            total = total - work.factor[b, k, i] * work.wanted[b, k]
        work.wanted[b, i] = total / work.factor[b, i, i]


@wp.func
def objective(
    matrix: wp.array3d(dtype=wp.float64),
    target: wp.array(dtype=wp.float64),
    square: wp.float64,
    count: int,
    b: int,
    r: wp.array2d(dtype=wp.float64),
):
    """Return phi, as defined in the docstring of the module."""
    total = wp.float64(0.0)
    for i in range(target.shape[0]):
        total = total + square * r[b, i] * (wp.float64(0.5) * r[b, i] - target[i])
    for k in range(count):
        above = wp.max(wp.float64(0.0), column_dot(matrix, b, k, r))
        total = total + wp.float64(0.5) * above * above
    return total


@wp.kernel
def solve_nonnegative(
    matrix_in: wp.array3d(dtype=wp.float64),
    target_in: wp.array(dtype=wp.float64),
    ridge_in: wp.float64,
    count_in: wp.array(dtype=wp.int32),
    work_inout: Workspace,
    x_out: wp.array2d(dtype=wp.float64),
    sound_out: wp.array(dtype=wp.int32),
):
    """Solve B systems, launched over B.
    `matrix` (B, K, R) holds their columns, `count` (B,) the number of used columns. `x` is (B, K); `sound` (B,) is 0
    if `STEPS` are not enough."""
    b = wp.tid()
    work = work_inout
    rows = matrix_in.shape[2]
    count = count_in[b]
    square = ridge_in * ridge_in
    for i in range(rows):
        work.residual[b, i] = target_in[i]
        for j in range(rows):
            work.normal[b, i, j] = wp.float64(0.0)
        work.normal[b, i, i] = square
    for k in range(count):
        work.used[b, k] = 0
    done = wp.int32(0)
    # After a whole step without a change of the columns' set, r is the minimum.
    whole = wp.int32(0)
    for _step in range(STEPS):
        if done == 0:
            changed = wp.int32(0)
            for k in range(count):
                above = wp.int32(0)
                if column_dot(matrix_in, b, k, work.residual) > wp.float64(0.0):
                    above = 1
                if above != work.used[b, k]:
                    update_normal_matrix(matrix_in, b, k, wp.float64(2 * above - 1), work)
                    work.used[b, k] = above
                    changed = 1
            if changed == 0 and whole == 1:
                done = 1
            else:
                solve(target_in, square, b, work)
                before = objective(matrix_in, target_in, square, count, b, work.residual)
                share = wp.float64(1.0)
                whole = wp.int32(1)
                lower = wp.int32(0)
                for _half in range(HALVINGS):
                    if lower == 0:
                        # The factor is no longer needed: its first row stores r in case the step is rejected.
                        for i in range(rows):
                            at = work.residual[b, i]
                            work.factor[b, 0, i] = at
                            work.residual[b, i] = at + share * (work.wanted[b, i] - at)
                        if objective(matrix_in, target_in, square, count, b, work.residual) <= before:
                            lower = 1
                        else:
                            for i in range(rows):
                                work.residual[b, i] = work.factor[b, 0, i]
                            share = wp.float64(0.5) * share
                            whole = wp.int32(0)
                if lower == 0:
                    # Only rounding errors remain.
                    done = 1
    for k in range(x_out.shape[1]):
        x_out[b, k] = wp.float64(0.0)
    for k in range(count):
        x_out[b, k] = wp.max(wp.float64(0.0), column_dot(matrix_in, b, k, work.residual)) / square
    sound_out[b] = done
