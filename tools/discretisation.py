"""How good the error bars of the grid are: contacts of fresh surfaces, their bars, and the same on finer grids.

    python tools/discretisation.py [--seed N] [--across 16] [--finest 64]

Prints, for each number and λ_s/a, how many of the bars are at least as large as the error, and the median of bar over
error.  `finest`: λ_s/a of the grid that serves as the limit.
"""

from __future__ import annotations

import argparse
import math
import sys

import numpy as np
from mpi4py import MPI
from scipy.special import erfinv

from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables.observer import Observer
from pgfmd.observables.table import OBSERVABLES
from pgfmd.physics.elasticity import Elasticity
from pgfmd.physics.laws.hard import HardWall
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.active_set.nested_iteration import solve_hard_wall
from pgfmd.surfaces.self_affine import self_affine

NUMBERS = ("contact_area_corrected", "contact_perimeter", "mean_gap", "elastic_energy", "mean_square_pressure")


def numbers(points: int, across: int, hurst: float, load: float, seed: int) -> dict[str, float]:
    """The numbers of one contact and their bars, on a grid of λ_s = points·a, in a cell of 1."""
    n = points * across
    grid = SlabGrid(MPI.COMM_SELF, (n, n), (1.0, 1.0))
    heights = self_affine(grid, hurst, 1 / across, 1.0, seed)
    problem = ContactProblem(grid, heights, Elasticity(1.0), HardWall(), load)
    observer = Observer(problem, [OBSERVABLES["discretisation"]()], 2 * math.pi * across)
    contact = observer.contact(solve_hard_wall(problem, 1e-7))
    bars = observer.groups(contact)["discretisation"]
    return observer.row(contact) | {name: float(value) for name, value in bars.items()}


def main(arguments: list[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--across", type=int, default=16, help="λ_s to a side of the cell")
    parser.add_argument("--finest", type=int, default=64, help="λ_s/a of the limit")
    options = parser.parse_args(arguments)
    ratios: dict[tuple[str, int], list[float]] = {}
    grids = [points for points in (4, 8, 16, 32) if 2 * points <= options.finest]
    for hurst in (0.3, 0.5, 0.8):
        for area in (0.02, 0.08, 0.3, 0.6):
            load = float(erfinv(0.85 * area)) / math.sqrt(2) if area > 0.1 else area / 2.1
            limit = numbers(options.finest, options.across, hurst, load, options.seed)
            for points in grids:
                found = numbers(points, options.across, hurst, load, options.seed)
                for name in NUMBERS:
                    ratio = found[f"{name}_error"] / abs(found[name] - limit[name])
                    ratios.setdefault((name, points), []).append(ratio)
            options.seed += 1
    print("number                    λ_s/a  cases  held  bar/error (median)")
    for name in NUMBERS:
        every = [ratios[name, points] for points in grids]
        for label, values in [*zip(map(str, grids), every, strict=True), ("all", sum(every, []))]:
            held = np.mean(np.array(values) >= 1)
            print(f"{name:25s} {label:>5s}  {len(values):5d}  {held:4.2f}  {np.median(values):8.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
