"""Heights about their mean, and the limits within which their squares neither overflow nor vanish."""

from __future__ import annotations

import math

import numpy as np

from pgfmd.errors import InputError
from pgfmd.grid import kernels
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.physics.elasticity import Elasticity

LARGEST = 1e120  # of heights over the grid spacing, of pressures over the contact modulus; the inverse is the smallest


def dimensionless(
    grid: SlabGrid, heights: np.ndarray, mean_pressure: float, elasticity: Elasticity, overwrite: bool = False
) -> tuple[np.ndarray, float]:
    """(heights − ⟨heights⟩)/rms (nx_local, ny), as a new array or in the place of the heights, and their rms; zeros
    and 0 for a plane.  Collective.

    Raises InputError, saying what is out of range, for a surface that is not flat, or a pressure, beyond `LARGEST`.
    """
    reduce, threads, rows = grid.reduction, grid.threads, grid.local_shape[0]
    origin = grid.comm.bcast(float(heights[0, 0]) if grid.comm.rank == 0 else None)  # heights may lie far from zero

    def measure(first: int, stop: int) -> tuple[float, ...]:
        part = heights[first:stop]
        return part.min(), part.max(), *kernels.sums_about(origin, part)

    lows, highs, sums, squares = zip(*threads.collect(measure, rows, grid.band), strict=True)
    low, high = reduce.min(lows), reduce.max(highs)
    limits = (
        ("range of heights / grid spacing", high / 2 - low / 2, min(grid.spacing)),
        ("mean pressure / contact modulus", mean_pressure, elasticity.contact_modulus),
    )
    for name, value, unit in limits:
        if value != 0 and not 1 / LARGEST <= value / unit <= LARGEST:
            raise InputError(f"{name} = {value / unit:.1e}: must lie between {1 / LARGEST:g} and {LARGEST:g}")
    if low == high:
        return np.zeros(grid.local_shape), 0.0
    above, square = reduce.sums(math.fsum(sums), math.fsum(squares)) / grid.size
    mean, rms = np.float64(origin + above), math.sqrt(square - above**2)
    out = heights if overwrite else np.empty(grid.local_shape)

    def divide(_: int, first: int, stop: int):
        part = np.subtract(heights[first:stop], mean, out=out[first:stop])
        part /= rms

    threads.share(divide, rows, grid.band)
    return out, rms
