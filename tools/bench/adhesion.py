"""Counts of adhesive solves, and times beside tamaas 2.9: tables in jobs/benchmark.

    python tools/bench/adhesion.py counts [n …]      adhesion.csv
    python tools/bench/adhesion.py peer [n …]        adhesion-peer.csv
    python tools/bench/adhesion.py challenge DIR …   challenge.csv, of runs of jobs/adhesive-rough.toml on several grids

H = .8, λ_s = 16 spacings, unit slope, range of 2 spacings, E' = 1.  Work of adhesion .15 (weak), 1.2 (threshold of
stickiness) and 3 (sticky); "hard" is the adhesive solver without work.

counts: 14 loads, each from the last, whose mean gaps fall by .05 rms heights from .9 of the summit.  full: stiffness
applied in double precision; inner: stiffness or compliance in single; pairs: what `Solution.transforms` counts, the
estimate of the curvature apart.

peer: one contact at .6 of the summit from the undeformed solid, to tamaas' error of 1e-9 and our energy error of 1e-9;
processor times.  excess: energy of each above the lower of both, relative to that.

challenge: on both branches the area at each load, and that for spacing 0, as if the error were of first order in the
spacing, from the two finest grids; area_error is the whole change that this makes.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Iterator
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

TABLES = Path(__file__).resolve().parents[2] / "jobs" / "benchmark"
SURFACE = {"kind": "self-affine", "hurst": 0.8, "lambda_s": 16.0, "rms_slope": 1.0, "seed": 1}
WORKS = {"hard": 1e-9, "weak": 0.15, "threshold": 1.2, "sticky": 3.0}
COLUMNS = "n case tolerance full inner pairs seconds area pressure energy_error jumps".split()
TOLERANCE = 1e-8
Row = dict[str, float | str]


def measured(n: int, case: str) -> Row:
    """Means over the loads."""
    heights = pgfmd.surface({"grid": {"n": n}, "surface": SURFACE})
    grid = SlabGrid(ALONE, heights.shape)
    gaps = 0.9 * (heights.max() - heights.mean()) - 0.05 * heights.std() * np.arange(15)
    law = AdhesiveWall(work=WORKS[case], range=2.0)
    problem = ContactProblem(grid, heights, Homogeneous(contact_modulus=1.0), law)
    branch = Branch(Load(mean_gap=tuple(gaps), jump_accuracy=0.0), problem, TOLERANCE)
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
    return dict(zip(COLUMNS, (n, case, TOLERANCE, *means), strict=True))


def counts(n: list[str]) -> Iterator[Row]:
    """Means over the loads of each work."""
    for points in n or ["128", "256", "512"]:
        for case in WORKS:
            yield measured(int(points), case)


def peer(n: list[str]) -> Iterator[Row]:
    """Processor times, energies and pressures of both programs."""
    import tamaas

    tamaas.set_log_level(tamaas.LogLevel.error)
    for points in map(int, n or ["128", "256", "512", "1024"]):
        heights = pgfmd.surface({"grid": {"n": points}, "surface": SURFACE})
        gap = 0.6 * (heights.max() - heights.mean())
        for case in ("weak", "threshold", "sticky"):
            law = AdhesiveWall(work=WORKS[case], range=2.0)
            grid = SlabGrid(ALONE, heights.shape)
            problem, load = ContactProblem(grid, heights, Homogeneous(contact_modulus=1.0), law), Load(mean_gap=(gap,))
            Branch(load, problem, 1e-9).solution(gap)  # loads compiled code
            branch, began = Branch(load, problem, 1e-9), time.process_time()
            found = branch.solution(gap)
            seconds = time.process_time() - began
            model = tamaas.Model(tamaas.model_type.basic_2d, [float(points)] * 2, list(heights.shape))
            model.E, model.nu, kind = 1.0, 0.0, tamaas.PolonskyKeerRey.gap
            solver = tamaas.PolonskyKeerRey(model, heights, 1e-9, kind, kind)
            solver.max_iter = 100_000
            term = tamaas.ExponentialAdhesionFunctional(heights)
            term.parameters = {"rho": law.range, "surface_energy": law.work}
            solver.addFunctionalTerm(term)
            began = time.process_time()
            left = solver.solve(gap)
            theirs = time.process_time() - began
            branch.contact.allocate()
            gaps = np.maximum(np.array(model.displacement).reshape(heights.shape) - heights, 0) / law.range
            energies = np.array([found.details["energy"], branch.contact.state(gaps).energy * law.work])
            excess = (energies - energies.min()) / abs(energies.min())
            pressure = np.array(model.traction).reshape(heights.shape)
            yield {
                "n": points, "case": case, "seconds": seconds, "tamaas_seconds": theirs, "ratio": theirs / seconds,
                "tamaas_error": float(left), "excess": excess[0], "tamaas_excess": excess[1],
                "pressure_difference": np.linalg.norm(pressure - found.pressure) / np.linalg.norm(found.pressure),
            }  # fmt: skip


def challenge(folders: list[str]) -> Iterator[Row]:
    """Areas at the loads of both branches."""
    runs = sorted((pgfmd.Results(folder) for folder in folders), key=lambda run: run.shape[0])
    tables = [run.to_dataframe() for run in runs]
    sizes = [run.shape[0] for run in runs]
    if len(set(sizes)) < max(2, len(runs)) or any(list(each["target"]) != list(tables[0]["target"]) for each in tables):
        raise SystemExit("challenge: folders of two or more grids with the same loads are needed")
    turn = int(np.argmax(tables[0]["target"]))
    for place in range(len(tables[0])):
        areas = [float(table["contact_area"][place]) for table in tables]
        change = (areas[-1] - areas[-2]) / (sizes[-1] / sizes[-2] - 1)
        yield {
            "branch": "loading" if place <= turn else "unloading", "pressure": float(tables[0]["target"][place]),
            **{f"area_{n}": area for n, area in zip(sizes, areas, strict=True)},
            "area": areas[-1] + change, "area_error": abs(change),
            **{f"pairs_{n}": float(table["transforms"][place]) for n, table in zip(sizes, tables, strict=True)},
        }  # fmt: skip


PARTS = {"counts": ("adhesion", counts), "peer": ("adhesion-peer", peer), "challenge": ("challenge", challenge)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("of", nargs="*", help="points of a side, or folders")
    asked = parser.parse_args()
    table, part = PARTS[asked.part]
    rows: list[Row] = []  # the table is written whole after each of them, as long parts may be stopped
    for row in part(asked.of):
        rows.append({name: f"{value:.5g}" if isinstance(value, float) else value for name, value in row.items()})
        print(*rows[-1].values(), flush=True)
        with open(TABLES / f"{table}.csv", "w", newline="") as file:
            writer = csv.DictWriter(file, list(row), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    main()
