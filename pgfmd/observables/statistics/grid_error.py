"""Errors of a contact's numbers on a finite grid, from the same contact on a grid of half as many points each way.

Each number is the mean of a field F over the surface.  The difference of the two means is often small by chance,
since local errors of either sign cancel in the sum.  The long waves of F show the typical size of such sums:

    error = c √(|ΔF̃_0|² + mean_{1 ≤ k ≤ MODES} |ΔF̃_k|²),        ΔF̃_k = F̃_k − F̃'_k − s (p̃_k − p̃'_k),

F̃_k the coefficient of the wave number 2πk/lx along x, primed on the coarse grid.  The mean load is imposed, that of a
region is not: it moves between regions until their gaps fit the elastic deformation, and F follows.  The slope
s = Σ Re p̃_k* F̃_k / Σ |p̃_k|², 1 ≤ k ≤ MODES, tells how F follows the load, and its term brings regions to equal
loads, like the mean.  Without it, at f_c = .02, ΔF̃_k is a tenth of ΔF̃_0 for the gap and three times as large for the
energy; with it they are of one size at all loads.

c is from contacts of 72 self-affine surfaces (H = .3, .5, .8; f_c from .02 to .6; 16 λ_s across; λ_s = 4a … 32a, for
area and perimeter of 24 of them from 8a),
compared with λ_s = 64a, such that the error is large enough in nine cases of ten: `tools/discretisation.py bars` checks
it on others.
"""

from __future__ import annotations

import numpy as np

from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.sub_grid import SubGrid
from pgfmd.grid.transfer import restrict
from pgfmd.observables.contact_line.line import ContactLine, contact_line
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.options import Solver
from pgfmd.solvers.solution import ContactSolution, Solve

MODES = 4  # long waves that count
FACTORS = {"area": 0.4, "perimeter": 0.5, "mean_gap": 0.32, "elastic_energy": 0.27, "mean_square_pressure": 0.42}
"""c of each number."""


def grid_errors(
    problem: ContactProblem, solution: ContactSolution, line: ContactLine | None, solve: Solve
) -> dict[str, float]:
    """Estimated errors of the numbers of FACTORS; NaN of the area and perimeter without a line, and of all without the
    second contact.  Collective.
    """
    coarse = SubGrid.coarse(problem.grid)
    fine = long_waves(problem, solution, line)
    heights = restrict(problem.grid, coarse, problem.heights)
    options = Solver(method=problem.law.methods[0])

    def measure(grid: SlabGrid) -> dict[str, np.ndarray] | None:
        found = solve(problem.on(grid, heights.copy()), start=None, options=options)
        if found is None:
            return None
        other = None if line is None else contact_line(grid, found.pressure, found.gap, line.modulus)
        return long_waves(problem.on(grid, heights), found, other)

    waves = coarse.on_all(measure)
    coarse.free()
    if waves is None:
        return dict.fromkeys(FACTORS, np.nan)
    errors = {}
    for name, factor in FACTORS.items():
        squares = np.abs(change_at_equal_load(fine, waves, name)) ** 2
        errors[name] = float(factor * np.sqrt(squares[0] + np.mean(squares[1:])))
    if line is None:
        errors["area"] = errors["perimeter"] = np.nan
    return errors


def change_at_equal_load(fine: dict[str, np.ndarray], coarse: dict[str, np.ndarray], name: str) -> np.ndarray:
    """ΔF̃_k, k = 0 … MODES, from the `long_waves` of both grids."""
    load, field = fine["load"][1:], fine[name][1:]
    slope = np.vdot(load, field).real / (np.vdot(load, load).real or np.inf)
    return fine[name] - coarse[name] - slope * (fine["load"] - coarse["load"])


def long_waves(problem: ContactProblem, solution: ContactSolution, line: ContactLine | None) -> dict[str, np.ndarray]:
    """(1/N) Σ F exp(−2πikx/lx), k = 0 … MODES, of the fields whose means are the numbers of FACTORS, and of the
    pressure, "load".  Collective.
    """
    grid, pressure, gap = problem.grid, solution.pressure, solution.gap
    rows = {name: np.zeros(grid.local_shape[0]) for name in (*FACTORS, "load")}

    def add(first: int, stop: int) -> None:
        p, g = pressure[first:stop], gap[first:stop]
        rows["load"][first:stop] = p.sum(axis=1)
        rows["mean_gap"][first:stop] = g.sum(axis=1)
        rows["mean_square_pressure"][first:stop] = np.einsum("ij,ij->i", p, p)
        work = np.einsum("ij,ij->i", p - problem.mean_pressure, g + problem.heights[first:stop])
        rows["elastic_energy"][first:stop] = work / 2
        rows["area"][first:stop] = np.count_nonzero(p > 0, axis=1)

    grid.threads.share(lambda _, first, stop: add(first, stop), grid.local_shape[0], 64)
    if line is not None:
        area, perimeter = line.of_rows()
        rows["area"] += area / grid.pixel_area
        rows["perimeter"] += perimeter / grid.pixel_area
    place = np.arange(grid.rows.start, grid.rows.stop) / grid.shape[0]
    waves = np.exp(-2j * np.pi * np.outer(np.arange(MODES + 1), place))
    sums = np.array([waves @ row for row in rows.values()]) / grid.size
    total = grid.reduction.sums(*sums.real.ravel(), *sums.imag.ravel()).reshape(2, len(rows), MODES + 1)
    return dict(zip(rows, total[0] + 1j * total[1], strict=True))
