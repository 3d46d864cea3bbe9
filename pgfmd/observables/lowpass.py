"""f(q) numerically determined: the contact area of the surface low-passed at q, under the same load."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from ..grid import SlabGrid
from ..hierarchy import restrict
from ..solvers.solution import ContactSolution
from .staircase import contact_area

POINTS_PER_WAVE = 8
"""Grid points to the shortest wavelength that is left.  With the staircase correction the area is then within 1 % of
that of an infinitely fine grid."""

Relax = Callable[[SlabGrid, np.ndarray], ContactSolution]
"""Solves the contact of heights (nx_local, ny) on a grid, at the load in question.  Collective."""


def lowpass_areas(grid: SlabGrid, heights: np.ndarray, cutoffs: np.ndarray, relax: Relax) -> np.ndarray:
    """Relative contact area, corrected for the staircase, of the surface without modes |q| > each cutoff.  Collective.

    heights (nx_local, ny); cutoffs in radians per length.  Each surface is solved on the coarsest grid that gives its
    shortest wave POINTS_PER_WAVE points, but on no finer one than `grid`.
    """
    areas, levels = np.empty(len(cutoffs)), {}
    for index, cutoff in enumerate(cutoffs):
        levels.setdefault(coarsening(grid, cutoff), []).append(index)
    for factor, indices in levels.items():
        if factor == 1:
            for index in indices:
                areas[index] = _area(grid, lowpass(grid, heights, cutoffs[index]), relax)
            continue
        coarse = grid.coarse(factor)
        smooth = restrict(grid, coarse, heights)
        for index in indices:
            areas[index] = _area(coarse, lowpass(coarse, smooth, cutoffs[index]), relax)
        coarse.free()
    return areas


def _area(grid: SlabGrid, heights: np.ndarray, relax: Relax) -> float:
    return contact_area(grid, relax(grid, heights).pressure).corrected


def coarsening(grid: SlabGrid, cutoff: float) -> int:
    """The largest power of two by which the grid may be coarsened so that waves up to `cutoff` are resolved."""
    finest = 2 * math.pi / (POINTS_PER_WAVE * cutoff)
    factor = 1
    while 2 * factor * max(grid.spacing) <= finest * (1 + 1e-9) and min(grid.shape) // (2 * factor) >= POINTS_PER_WAVE:
        factor *= 2
    return factor


def lowpass(grid: SlabGrid, field: np.ndarray, cutoff: float) -> np.ndarray:
    """The field (nx_local, ny) without its modes |q| > cutoff.  One transform.  Collective."""
    out, limit = np.empty(grid.local_shape), (cutoff * (1 + 1e-9)) ** 2

    def fill(first: int, stop: int, rows: np.ndarray):
        rows[...] = field[first:stop]

    def cut(block: np.ndarray, first: int, stop: int):
        block[grid.qx**2 + grid.qy[first:stop] ** 2 > limit] = 0

    def keep(first: int, stop: int, rows: np.ndarray):
        np.divide(rows, float(grid.size), out=out[first:stop])

    grid.convolve(fill, cut, keep)
    return out


def octaves(grid: SlabGrid, q_max: float | None) -> np.ndarray:
    """Cut-offs doubled from the longest wave of the cell on; the last is q_max, or the highest one along an axis."""
    lowest = 2 * math.pi / max(grid.lengths)
    highest = max(math.pi / step for step in grid.spacing)
    top = highest if q_max is None else min(q_max, highest)
    cutoffs = lowest * 2.0 ** np.arange(max(math.ceil(math.log2(top / lowest) - 1e-9), 0) + 1)
    return np.append(cutoffs[:-1], max(top, lowest))
