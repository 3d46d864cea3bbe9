"""Heights about their mean, and the limits within which their squares neither overflow nor vanish."""

from __future__ import annotations

import math

import numpy as np

from ..elasticity import Elasticity
from ..errors import InputError
from ..grid import SlabGrid

LARGEST = 1e120  # of heights over the grid spacing, of pressures over the contact modulus; the inverse is the smallest


def centred(
    grid: SlabGrid, heights: np.ndarray, mean_pressure: float, elasticity: Elasticity, overwrite: bool = False
) -> tuple[np.ndarray, float]:
    """heights − ⟨heights⟩ (nx_local, ny), as a new array or in the place of the heights, and its rms.  Collective.

    Raises InputError, saying what is out of range, for a surface that is not flat, or a pressure, beyond `LARGEST`.
    """
    reduce, threads, rows = grid.reduction, grid.threads, grid.local_shape[0]

    def extremes(first: int, stop: int) -> tuple[float, float]:
        return heights[first:stop].min(), heights[first:stop].max()

    lows, highs = zip(*threads.collect(extremes, rows), strict=True)
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
    out = heights if overwrite else np.empty(grid.local_shape)

    def shift(first: int, stop: int) -> float:
        return np.subtract(heights[first:stop], low, out=out[first:stop]).sum()

    def centre(first: int, stop: int) -> float:
        part = out[first:stop]
        part -= mean
        return np.einsum("ij,ij->", part, part)

    mean = reduce.sum(threads.collect(shift, rows)) / grid.size
    squares = threads.collect(centre, rows)
    return out, math.sqrt(reduce.sum(squares) / grid.size)
