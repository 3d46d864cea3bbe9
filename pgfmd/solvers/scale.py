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
    reduce = grid.reduction
    low, high = reduce.min(heights), reduce.max(heights)
    limits = (
        ("range of heights / grid spacing", high / 2 - low / 2, min(grid.spacing)),
        ("mean pressure / contact modulus", mean_pressure, elasticity.contact_modulus),
    )
    for name, value, unit in limits:
        if value != 0 and not 1 / LARGEST <= value / unit <= LARGEST:
            raise InputError(f"{name} = {value / unit:.1e}: must lie between {1 / LARGEST:g} and {LARGEST:g}")
    if low == high:
        return np.zeros(grid.local_shape), 0.0
    heights = np.subtract(heights, low, out=heights if overwrite else None)
    heights -= reduce.sum(heights) / grid.size
    return heights, math.sqrt(reduce.dot(heights, heights) / grid.size)
