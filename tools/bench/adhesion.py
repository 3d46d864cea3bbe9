"""Counts of adhesive solves: `python tools/bench/adhesion.py [n …]` writes jobs/benchmark/adhesion.csv.

H = .8, λ_s = 16 spacings, unit slope, range of 2 spacings, E' = 1: 14 loads, each from the last, whose mean gaps fall
by .05 rms heights from .9 of the summit.  Work of adhesion .15 (weak), 1.2 (threshold of stickiness) and 3 (sticky);
"hard" is the adhesive solver without work.  full: stiffness applied in double precision; inner: stiffness or
compliance in single; pairs: what `Solution.transforms` counts, the estimate of the curvature apart.
"""

from __future__ import annotations

import argparse
import csv
import time
from pathlib import Path

import numpy as np

import pgfmd
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.parallel.mpi import ALONE
from pgfmd.physics.laws.adhesive_laws import AdhesiveWall
from pgfmd.physics.problem import ContactProblem
from pgfmd.physics.solids.homogeneous import Homogeneous
from pgfmd.solvers.adhesive_branch import Branch
from pgfmd.solvers.options import Load

TABLE = Path(__file__).resolve().parents[2] / "jobs" / "benchmark" / "adhesion.csv"
WORKS = {"hard": 1e-9, "weak": 0.15, "threshold": 1.2, "sticky": 3.0}
COLUMNS = "n case tolerance full inner pairs seconds area pressure energy_error jumps".split()


def measured(n: int, case: str, tolerance: float) -> dict[str, float | str]:
    """Means over the loads."""
    surface = {"kind": "self-affine", "hurst": 0.8, "lambda_s": 16.0, "rms_slope": 1.0, "seed": 1}
    heights = pgfmd.surface({"grid": {"n": n}, "surface": surface})
    grid = SlabGrid(ALONE, heights.shape)
    gaps = 0.9 * (heights.max() - heights.mean()) - 0.05 * heights.std() * np.arange(15)
    law = AdhesiveWall(work=WORKS[case], range=2.0)
    problem = ContactProblem(grid, heights, Homogeneous(contact_modulus=1.0), law)
    branch = Branch(Load(mean_gap=tuple(gaps), jump_accuracy=0.0), problem, tolerance)
    rows = []
    for gap in gaps:
        began = time.process_time()
        found = branch.solution(gap)
        known, last = found.details, branch.last
        assert last is not None
        full, inner = known["newton_steps"] + known["trials_refused"] + 1, known["inner_applications"]
        rows.append((full, inner, full + inner / 2, time.process_time() - began, last[1].contact / grid.size,
                     found.mean_pressure, found.certified_error, np.isfinite(known["jump_to"])))  # fmt: skip
    means = np.mean(rows[1:], axis=0)
    return dict(zip(COLUMNS, (n, case, tolerance, *means), strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("n", nargs="*", type=int, default=[128, 256, 512])
    parser.add_argument("--tolerance", nargs="*", type=float, default=[1e-8])
    asked = parser.parse_args()
    with open(TABLE, "w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        for n in asked.n:
            for case in WORKS:
                for tolerance in asked.tolerance:
                    row = measured(n, case, tolerance)
                    row = {name: f"{value:.5g}" if isinstance(value, float) else value for name, value in row.items()}
                    writer.writerow(row)
                    print(*row.values(), flush=True)


if __name__ == "__main__":
    main()
