"""f(q) numerically determined: the contact area of the surface low-passed at q, under the same load."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.transfer import restrict
from pgfmd.observables.staircase import contact_area
from pgfmd.solvers.solution import ContactSolution

POINTS_PER_WAVE = 8
"""Grid points to the shortest wavelength that is left.  With the staircase correction the area is then within 1 % of
that of an infinitely fine grid."""
FEWEST_POINTS = 4
"""The same where more would take the full grid; the area is then within 2 %."""
TOLERANCE = 1e-4
"""Certified error of the contacts that are solved: their area has converged to a few parts in 1e4."""

Relax = Callable[..., ContactSolution]
"""relax(grid, heights, start=None) solves the contact of heights (nx_local, ny) on a grid at the load in question, from
a neighbour's pressure if one is given.  Collective."""


def lowpass_areas(
    grid: SlabGrid, heights: np.ndarray, cutoffs: np.ndarray, relax: Relax, start: np.ndarray | None = None
) -> np.ndarray:
    """Relative contact area, corrected for the staircase, of the surface without modes |q| > each cutoff.  Collective.

    heights, start (nx_local, ny); cutoffs in radians per length.  Each surface is solved on the coarsest grid that
    resolves it, from the one before on the same grid; on `grid` itself from `start`, so that no third field is kept.
    """
    areas, levels = np.empty(len(cutoffs)), {}
    for index, cutoff in enumerate(cutoffs):
        levels.setdefault(coarsening(grid, cutoff), []).append(index)
    for index in levels.pop(1, ()):
        areas[index] = _area(grid, relax(grid, lowpass(grid, heights, cutoffs[index]), start=start))
    finer = grid
    for factor, indices in sorted(levels.items()):
        coarse, before = grid.coarse(factor), None
        heights = restrict(finer, coarse, heights)
        if finer is not grid:
            finer.free()
        finer = coarse
        for index in indices:
            solution = relax(coarse, lowpass(coarse, heights, cutoffs[index]), start=before)
            areas[index], before = _area(coarse, solution), solution.pressure
    if finer is not grid:
        finer.free()
    return areas


def _area(grid: SlabGrid, solution: ContactSolution) -> float:
    return contact_area(grid, solution.pressure).corrected


def coarsening(grid: SlabGrid, cutoff: float) -> int:
    """The largest power of two by which the grid may be coarsened so that waves up to `cutoff` are resolved."""
    points = 2 * math.pi / (cutoff * max(grid.spacing)) * (1 + 1e-9)  # of `grid` to the shortest wave
    factor = 1
    while points >= 2 * factor * POINTS_PER_WAVE and min(grid.shape) >= 2 * factor * POINTS_PER_WAVE:
        factor *= 2
    return 2 if factor == 1 and points >= 2 * FEWEST_POINTS and min(grid.shape) >= 2 * POINTS_PER_WAVE else factor


def highest_wave_number(grid: SlabGrid) -> float:
    """|q| beyond which a grid has no modes, that of its corners."""
    return float(np.hypot(*(math.pi / step for step in grid.spacing)))


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


def octaves(grid: SlabGrid, q_max: float) -> np.ndarray:
    """Cut-offs doubled from the longest wave of the cell on, and last q_max."""
    lowest = 2 * math.pi / max(grid.lengths)
    if q_max <= lowest:
        return np.array([lowest])
    cutoffs = lowest * 2.0 ** np.arange(max(math.ceil(math.log2(q_max / lowest) - 1e-9), 0) + 1)
    return np.append(cutoffs[:-1], q_max)
