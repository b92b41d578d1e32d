"""The object as a grid of signed distances, read by trilinear interpolation: an error of second order in the cell."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any, Final

import numpy as np
import warp as wp

from service.model.cores import available_cores
from worker.simulation.device import DeviceObject
from worker.simulation.kernels import surface

#: How far the grid reaches beyond the object's box [m].
PAD_M: Final = 0.10


def distance_grid(obj: DeviceObject, cells: int) -> Any:
    """A `Surface` whose field has `cells` cells along the longest side of the padded box, sampled from the mesh.

    Distances are exact at the corners; the array lies on the object's device.
    """
    model = obj.model
    low = model.vertices.min(axis=0) - model.centre_of_mass - PAD_M
    high = model.vertices.max(axis=0) - model.centre_of_mass + PAD_M
    cell = float((high - low).max()) / cells
    shape = [int(n) for n in np.ceil((high - low) / cell).astype(int) + 1]
    reach = float(np.linalg.norm(high - low))
    flat = surface.Surface()
    flat.mesh, flat.corner_normals, flat.alpha = obj.surface.mesh, obj.surface.corner_normals, 0.0
    flat.cells = obj.surface.cells
    device = obj.device
    with wp.ScopedDevice(device):
        field = wp.empty(tuple(shape), dtype=wp.float32)
        flat.field = wp.zeros((0, 0, 0), dtype=wp.float32)

    def slab(first: int, last: int) -> None:
        corner = low + np.array([first * cell, 0.0, 0.0])
        with wp.ScopedDevice(device):
            wp.launch(
                surface.sample_field,
                dim=(last - first, shape[1], shape[2]),
                inputs=[flat, wp.vec3(*corner), cell, reach],
                outputs=[field[first:last]],
                device=device,
            )

    threads = 1 if wp.get_device(device).is_cuda else available_cores()
    bounds = np.linspace(0, shape[0], 4 * threads + 1).astype(int)
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(lambda ends: slab(*ends), pairwise(bounds.tolist())))
    out = surface.Surface()
    out.mesh, out.corner_normals, out.alpha, out.cells = flat.mesh, flat.corner_normals, 0.0, flat.cells
    out.field, out.field_origin, out.field_cell = field, wp.vec3(*low), cell
    out.field_error = 0.5 * cell
    return out
