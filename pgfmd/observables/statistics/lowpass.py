"""Contacts of a surface without its short waves, solved on the coarsest grids that resolve them."""

from __future__ import annotations

from functools import partial

import numpy as np

from pgfmd.grid.callbacks import source
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.sub_grid import SubGrid
from pgfmd.grid.transfer import restrict
from pgfmd.observables.contact_line.line import RESOLVED, line_of
from pgfmd.observables.contact_line.table import staircase
from pgfmd.observables.statistics.contact_area import contact_area
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.solution import Solve

BANDWIDTH = 2.0
"""Assumed ratio of the highest wave number to √(Σ q⁴|h̃|² / Σ q²|h̃|²).  For broad self-affine spectra it is
√((4−2H)/(2−2H)): 1.6 for H = .3, 2.4 for H = .8."""


def lowpass_areas(
    problem: ContactProblem, cutoffs: list[tuple[int, float]], solve: Solve, start: np.ndarray
) -> np.ndarray:
    """Relative contact area, of the pixels and inside the line, without modes |q| > each cutoff: (cutoffs, 2), NaN
    where the contact cannot be solved.  Collective.

    cutoffs: by how much the grid is coarsened, a power of 2, and the cutoff in radians per length
    start: a pressure (nx_local, ny) from which contacts on the full grid start; a contact on a coarser grid starts from
    the previous one on that grid
    """
    areas, by_factor = np.empty((len(cutoffs), 2)), dict[int, list[int]]()
    for index, (factor, _) in enumerate(cutoffs):
        by_factor.setdefault(factor, []).append(index)
    for factor, indices in sorted(by_factor.items()):
        highest = [cutoffs[index][1] for index in indices]
        if factor == 1:
            areas[indices] = _areas(problem, highest, solve, start)
            continue
        coarse = SubGrid.coarse(problem.grid, factor)
        heights = restrict(problem.grid, coarse, problem.heights)
        areas[indices] = coarse.on_all(partial(_on_grid, problem, heights, highest, solve))
        coarse.free()
    return areas


def _on_grid(
    problem: ContactProblem, heights: np.ndarray, cutoffs: list[float], solve: Solve, grid: SlabGrid
) -> np.ndarray:
    return _areas(problem.on(grid, heights), cutoffs, solve)


def _areas(
    problem: ContactProblem, cutoffs: list[float], solve: Solve, start: np.ndarray | None = None
) -> np.ndarray:
    """Those of one grid, (cutoffs, 2).  Each contact starts from `start`; without it, from the one before.  Collective.
    """
    grid, areas, before = problem.grid, np.ones((len(cutoffs), 2)), start
    for index, cutoff in enumerate(cutoffs):
        smooth = problem.on(grid, lowpass(grid, problem.heights, cutoff))
        if touches_fully(smooth):
            continue
        solution = solve(smooth, start=before)
        if solution is None:
            areas[index] = np.nan
            continue
        per_pixel = cutoff * max(grid.spacing)
        line = line_of(smooth, solution, per_pixel <= RESOLVED)
        steps = staircase(grid.spacing, smooth.solid, per_pixel / BANDWIDTH) if smooth.law.releases else 0.0
        area = contact_area(grid, solution.pressure_in_contact(), line, smooth.least_area, steps)
        areas[index] = area.fraction, area.corrected
        before = solution.pressure if start is None else start
    return areas


def touches_fully(problem: ContactProblem) -> bool:
    """Whether the pressure of full contact, p̄ + Kh, is nowhere negative: contact is then full.  Collective.

    One transform.  Solvers need not treat a surface that is flat up to rounding, whose energy they cannot certify.
    """
    grid, least = problem.grid, dict[int, float]()

    def keep(first: int, stop: int, rows: np.ndarray) -> None:
        least[first] = float(rows.min())

    stiffness = problem.solid.apply_stiffness(grid, np.float64, 1 / grid.size)
    grid.convolve(source(problem.heights), stiffness, keep)
    return problem.mean_pressure + grid.reduction.min(list(least.values())) >= 0


def lowpass(grid: SlabGrid, field: np.ndarray, cutoff: float) -> np.ndarray:
    """The field (nx_local, ny) without its modes |q| > cutoff.  One transform.  Collective."""
    out, limit = np.empty(grid.local_shape), (cutoff * (1 + 1e-9)) ** 2

    def cut(block: np.ndarray, first: int, stop: int) -> None:
        block[grid.q_squared(first, stop) > limit] = 0

    def keep(first: int, stop: int, rows: np.ndarray) -> None:
        np.divide(rows, float(grid.size), out=out[first:stop])

    grid.convolve(source(field), cut, keep)
    return out
