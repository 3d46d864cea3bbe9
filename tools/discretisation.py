"""The error of the grid: how large it is, and how good the error bars are, on contacts of fresh surfaces.

    python tools/discretisation.py bars [--seed 1] [--across 16] [--finest 64]
    python tools/discretisation.py area FILE.csv [--seed 1] [--across 32] [--finest 128]

bars: for each number and λ_s/a, how many of the bars are at least as large as the error against λ_s = finest · a, and
the median of bar over error.  area: the contact area of four surfaces for each Hurst exponent and load, raw and inside
the contact line, from λ_s = 4a to finest · a; rows that FILE.csv has already are not computed again.  Prints the mean
errors against the limit of the raw areas, extrapolated from the three finest grids.
"""

from __future__ import annotations

import argparse
import csv
import math
import sys
from collections.abc import Iterator
from pathlib import Path

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

TOLERANCE = 1e-11  # at 1e-7 the areas of the finest grids are .3 % off
NUMBERS = ("contact_area_corrected", "contact_perimeter", "mean_gap", "elastic_energy", "mean_square_pressure")


def solved(points: int, across: int, hurst: float, load: float, seed: int, bars: bool) -> dict[str, float]:
    """The numbers of one contact, with their bars if asked for, on a grid of λ_s = points·a, in a cell of 1."""
    n = points * across
    grid = SlabGrid(MPI.COMM_SELF, (n, n), (1.0, 1.0))
    heights = self_affine(grid, hurst, 1 / across, 1.0, seed)
    problem = ContactProblem(grid, heights, Elasticity(1.0), HardWall(), load)
    observer = Observer(problem, [OBSERVABLES["discretisation"]()] if bars else [], 2 * math.pi * across)
    contact = observer.contact(solve_hard_wall(problem, TOLERANCE))
    found = observer.groups(contact).get("discretisation", {})
    return observer.row(contact) | {name: float(value) for name, value in found.items()}


def cases() -> Iterator[tuple[float, float, float]]:
    """Hurst exponent, contact area, about, and the load for it."""
    for hurst in (0.3, 0.5, 0.8):
        for area in (0.02, 0.08, 0.3, 0.6):
            yield hurst, area, float(erfinv(0.85 * area)) / math.sqrt(2) if area > 0.1 else area / 2.1


def bars(seed: int, across: int, finest: int) -> None:
    """Prints how good the bars are."""
    ratios: dict[tuple[str, int], list[float]] = {}
    grids = [points for points in (4, 8, 16, 32) if 2 * points <= finest]
    for number, (hurst, _, load) in enumerate(cases()):
        limit = solved(finest, across, hurst, load, seed + number, True)
        for points in grids:
            found = solved(points, across, hurst, load, seed + number, True)
            for name in NUMBERS:
                ratio = found[f"{name}_error"] / abs(found[name] - limit[name])
                ratios.setdefault((name, points), []).append(ratio)
    print("number                    λ_s/a  cases  held  bar/error (median)")
    for name in NUMBERS:
        every = [ratios[name, points] for points in grids]
        for label, values in [*zip(map(str, grids), every, strict=True), ("all", sum(every, []))]:
            held = np.mean(np.array(values) >= 1)
            print(f"{name:25s} {label:>5s}  {len(values):5d}  {held:4.2f}  {np.median(values):8.2f}")


COLUMNS = "hurst area seed across points contact_area contact_area_corrected".split()


def area(path: Path, seed: int, across: int, finest: int) -> None:
    """Adds to the table what it lacks, and prints the mean errors of its areas."""
    grids = [4 << power for power in range(int(math.log2(finest)) - 1)]
    rows = _rows(path)
    if not path.exists():
        path.write_text(",".join(COLUMNS) + "\n")
    for hurst, aim, load in cases():
        for number in range(seed, seed + 4):
            for points in grids:
                if (hurst, aim, number, across, points) not in rows:
                    found = solved(points, across, hurst, load, number, False)
                    with open(path, "a", newline="") as file:
                        areas = (f"{found[name]:.10g}" for name in COLUMNS[5:])
                        csv.writer(file).writerow([hurst, aim, number, across, points, *areas])
    rows = _rows(path)
    print("  H   area   " + "".join(f"{f'raw {points}a':>10s}" for points in grids)
          + "".join(f"{f'line {points}a':>10s}" for points in grids) + "   (per cent)")  # fmt: skip
    for hurst, aim, _ in cases():
        errors: list[np.ndarray] = []
        for number in range(seed, seed + 4):
            raw, line = np.array([rows[hurst, aim, number, across, points] for points in grids]).T
            limit = (8 * raw[-1] - 6 * raw[-2] + raw[-3]) / 3  # of c₀ + c₁ a + c₂ a²
            errors.append(np.concatenate([raw, line]) / limit - 1)
        mean = 100 * np.mean(errors, axis=0)
        print(f"{hurst:4.1f}  {aim:5.2f}  " + "".join(f"{value:10.3f}" for value in mean))


def _rows(path: Path) -> dict[tuple[float, ...], tuple[float, float]]:
    if not path.exists():
        return {}
    with open(path, newline="") as file:
        table = [tuple(float(row[name]) for name in COLUMNS) for row in csv.DictReader(file)]
    return {row[:5]: (row[5], row[6]) for row in table}


def main(arguments: list[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="what", required=True)
    for name, across, finest in (("bars", 16, 64), ("area", 32, 128)):
        command = commands.add_parser(name)
        if name == "area":
            command.add_argument("path", type=Path, metavar="FILE.csv")
        command.add_argument("--seed", type=int, default=1, help="of the first surface")
        command.add_argument("--across", type=int, default=across, help="λ_s to a side of the cell")
        command.add_argument("--finest", type=int, default=finest, help="λ_s/a of the finest grid")
    options = vars(parser.parse_args(arguments))
    {"bars": bars, "area": area}[options.pop("what")](**options)
    return 0


if __name__ == "__main__":
    sys.exit(main())
