"""The discretisation error: one band-limited surface on ever finer grids, against one four times finer than these."""

from pathlib import Path

import csv_rows
import numpy as np

from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables.contact import Contact
from pgfmd.observables.rough_surface import RoughSurface
from pgfmd.parallel.mpi import ALONE
from pgfmd.solvers.active_set.contact_from_coarse import solve_hard_wall
from pgfmd.surfaces.self_affine import self_affine

from .case import RMS_SLOPE, SEED, hard_contact

HURST, RATIO, PRESSURE, LENGTH = 0.3, 32, 0.0032, 1024.0  # λ_l/λ_s and the cell; the surface of PHYSICS section 6
REFINEMENTS = (2, 4, 8, 16, 32, 128)  # points per λ_s; the last one is the reference
COLUMNS = ("points_per_lambda_s", "n", "area_raw", "area_corrected", "mean_gap", "second_moment", "energy")


def main(folder: Path) -> None:
    """Solve on all grids, print the errors, write DIR/resolution.csv and draw."""
    rows = [_solve(refinement) for refinement in REFINEMENTS]
    csv_rows.write(folder / "resolution.csv", [dict(zip(COLUMNS, row, strict=True)) for row in rows], digits=8)
    print(f"\nRelative discretisation error, H = {HURST:g}, lambda_l = {RATIO} lambda_s, load {PRESSURE:g}")
    print("".join(f"{name:>20}" for name in COLUMNS))
    *coarser, limit = rows
    best = (limit[3], limit[3], *limit[4:])  # raw and corrected area tend to the same
    for row in coarser:
        errors = [value / right - 1 for value, right in zip(row[2:], best, strict=True)]
        print(f"{row[0]:20.0f}{row[1]:20.0f}" + "".join(f"{error:20.2e}" for error in errors))


def _solve(refinement: int) -> tuple:
    n = RATIO * refinement
    grid = SlabGrid(ALONE, (n, n), (LENGTH, LENGTH))
    heights = self_affine(grid, HURST, LENGTH / RATIO, RMS_SLOPE, SEED)
    problem = hard_contact(grid, heights, PRESSURE)
    solution = solve_hard_wall(problem, 1e-9)
    area = Contact.of(RoughSurface(problem), solution).area
    second = float(np.mean(solution.pressure**2)) / PRESSURE**2
    gap = solution.mean_gap / float(np.std(heights))
    return refinement, n, area.fraction, area.corrected, gap, second, solution.elastic_energy
