"""Counts of adhesive solves, and times beside tamaas 2.9 and Adhesion 0.93: tables in jobs/benchmark.

    python tools/bench/adhesion.py counts [n …]      adhesion.csv
    python tools/bench/adhesion.py peer [n …]        adhesion-peer.csv
    python tools/bench/adhesion.py challenge DIR …   challenge.csv, of runs of jobs/adhesive-rough.toml on several grids

H = .8, λ_s = 16 spacings, unit slope, range of 2 spacings, E' = 1.  Work of adhesion .15 (weak), 1.2 (threshold of
stickiness) and 3 (sticky); "hard" is the adhesive solver without work.

counts: 14 loads, each from the last, whose mean gaps fall by .05 rms heights from .9 of the summit.  full: steps that
were tried, some in single precision, and 1; inner: stiffness or compliance for their directions, in single precision;
pairs: `Solution.transforms`, the estimate of the curvature included.

peer: one contact at .6 of the summit from the undeformed solid, ours to an energy error of 1e-12, Adhesion's to the
largest residual that ours has then, tamaas' to its own error of 1e-4 (.03 to .5 times that residual, once 57 times);
processor times, NaN for a program that did not converge.  Of Adhesion's two methods of conjugate gradients the one with
restarts, which took half the time of the other at 256².  excess: energy of each above the lower of both, relative to
that.  Energies, residuals and pressures of all are computed from their gaps.

challenge: on both branches the area at each load, and that for spacing 0, as if the error were of first order in the
spacing, from the two finest grids; area_error is the whole change that this makes.  Grids that the table has, and no
folder is of, stay in it.
"""

import argparse
import contextlib
import io
import math
import time
from collections.abc import Iterator
from pathlib import Path

import csv_rows
import numpy as np

import pgfmd
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.parallel.mpi import ALONE
from pgfmd.physics.laws.adhesive_laws import AdhesiveWall
from pgfmd.physics.problem import ContactProblem
from pgfmd.physics.solids.homogeneous import Homogeneous
from pgfmd.solvers.adhesive_branch import Branch
from pgfmd.solvers.adhesive_model import AdhesiveState
from pgfmd.solvers.options import Load

TABLES = Path(__file__).resolve().parents[2] / "jobs" / "benchmark"
SURFACE = {"kind": "self-affine", "hurst": 0.8, "lambda_s": 16.0, "rms_slope": 1.0, "seed": 1}
WORKS = {"hard": 1e-9, "weak": 0.15, "threshold": 1.2, "sticky": 3.0}
COLUMNS = "n case tolerance full inner pairs seconds area pressure energy_error jumps".split()
TOLERANCE, FINE = 1e-8, 1e-12
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
        rows.append((full, inner, found.transforms, time.process_time() - began, last[1].contact / grid.size,
                     found.mean_pressure, found.certified_error, np.isfinite(known["jump_to"])))  # fmt: skip
    means = np.mean(rows[1:], axis=0)
    return dict(zip(COLUMNS, (n, case, TOLERANCE, *means), strict=True))


def counts(n: list[str]) -> Iterator[Row]:
    """Means over the loads of each work."""
    for points in n or ["128", "256", "512"]:
        for case in WORKS:
            yield measured(int(points), case)


def peer(n: list[str]) -> Iterator[Row]:
    """Processor times, energies and pressures of this program and of each peer."""
    for points in map(int, n or ["128", "256", "512", "1024"]):
        heights = pgfmd.surface({"grid": {"n": points}, "surface": SURFACE})
        gap = 0.6 * (heights.max() - heights.mean())
        for case in ("weak", "threshold", "sticky"):
            law = AdhesiveWall(work=WORKS[case], range=2.0)
            grid = SlabGrid(ALONE, heights.shape)
            problem, load = ContactProblem(grid, heights, Homogeneous(contact_modulus=1.0), law), Load(mean_gap=(gap,))
            Branch(load, problem, FINE).solution(gap)  # loads compiled code
            branch, began = Branch(load, problem, FINE), time.process_time()
            found = branch.solution(gap)
            seconds = time.process_time() - began
            branch.contact.allocate()
            state, pressure, residual = judged(branch, found.gap / law.range)
            for program in (adhesion, tamaas):
                gaps, theirs = program(heights, law, gap, residual)
                other, pressures, left = judged(branch, gaps / law.range)
                energies = np.array([state.energy, other.energy])
                excess = (energies - energies.min()) / abs(energies.min())
                yield {
                    "n": points, "case": case, "peer": program.__name__, "seconds": seconds, "peer_seconds": theirs,
                    "ratio": theirs / seconds, "residual": residual, "peer_residual": left, "excess": excess[0],
                    "peer_excess": excess[1],
                    "pressure_difference": np.linalg.norm(pressures - pressure) / np.linalg.norm(pressure),
                }  # fmt: skip


def judged(branch: Branch, gap: np.ndarray) -> tuple[AdhesiveState, np.ndarray, float]:
    """The state of a gap (n, n), in units of the law; its pressure and its largest residual, over E'."""
    contact = branch.contact
    state, pulled = contact.state(gap), contact.law.traction(gap)
    force, free = state.stress + pulled, gap > 0
    force -= force[free].mean()
    pressure = np.where(free, -pulled, force - pulled)
    return state, pressure * contact.pressure, float(np.abs(force[free]).max()) * contact.pressure


def tamaas(heights: np.ndarray, law: AdhesiveWall, gap: float, residual: float) -> tuple[np.ndarray, float]:
    """(gap (n, n), seconds) by tamaas' Polonsky–Keer–Rey method, to its own error of 1e-4."""
    import tamaas as peer

    peer.set_log_level(peer.LogLevel.error)
    model = peer.Model(peer.model_type.basic_2d, [float(len(heights))] * 2, list(heights.shape))
    model.E, model.nu, kind = 1.0, 0.0, peer.PolonskyKeerRey.gap
    solver = peer.PolonskyKeerRey(model, heights, 1e-4, kind, kind)
    solver.max_iter = 100_000
    term = peer.ExponentialAdhesionFunctional(heights)
    term.parameters = {"rho": law.range, "surface_energy": law.work}
    solver.addFunctionalTerm(term)
    began = time.process_time()
    ended = solver.solve(gap) <= solver.tolerance
    seconds = time.process_time() - began if ended else math.nan
    return np.maximum(np.array(model.displacement).reshape(heights.shape) - heights, 0), seconds


def adhesion(heights: np.ndarray, law: AdhesiveWall, gap: float, residual: float) -> tuple[np.ndarray, float]:
    """(gap (n, n), seconds) by Adhesion's faster conjugate gradients at a mean gap, to our largest residual."""
    from Adhesion.Interactions import Exponential
    from Adhesion.System import BoundedSmoothContactSystem, make_system
    from ContactMechanics import PeriodicFFTElasticHalfSpace
    from NuMPI.Optimization.CCGWithRestart import constrained_conjugate_gradients_with_restart
    from SurfaceTopography import Topography

    sides = (float(len(heights)),) * 2
    system = make_system(
        Topography(heights - heights.mean(), sides, periodic=True), Exponential(law.work, law.range),
        PeriodicFFTElasticHalfSpace(heights.shape, 1.0, sides), system_class=BoundedSmoothContactSystem,
    )  # fmt: skip
    start = heights.max() - heights
    for _ in range(60):  # the undeformed solid, overlaps cut off
        start = np.maximum(start + (start > 0) * (gap - start.mean()) * start.size / np.count_nonzero(start > 0), 0)
    began = time.process_time()
    with contextlib.redirect_stdout(io.StringIO()):  # a line for each direction of negative curvature
        found = constrained_conjugate_gradients_with_restart(
            system.primal_objective(0, gradient=True), system.primal_hessian_product, start.ravel(), mean_val=gap,
            gtol=residual, maxiter=100_000,
        )  # fmt: skip
    seconds = time.process_time() - began if found.success else math.nan
    return np.maximum(found.x.reshape(heights.shape), 0), seconds


def challenge(folders: list[str]) -> Iterator[Row]:
    """Areas at the loads of both branches."""
    runs = [pgfmd.Results(folder) for folder in folders]
    tables = {run.shape[0]: run.to_dataframe() for run in runs}
    earlier = csv_rows.read(TABLES / "challenge.csv", needed=True)
    targets = [float(row["pressure"]) for row in earlier]
    if len(tables) < len(runs) or any(list(table["target"]) != targets for table in tables.values()):
        raise SystemExit("challenge: two folders of one grid, or other loads than in jobs/benchmark/challenge.csv")
    turn = int(np.argmax(targets))
    for place, before in enumerate(earlier):
        areas, pairs = of_grids(before, "area_"), of_grids(before, "pairs_")
        areas |= {n: float(table["contact_area"][place]) for n, table in tables.items()}
        pairs |= {n: float(table["transforms"][place]) for n, table in tables.items()}
        coarse, fine = sorted(areas)[-2:]
        change = (areas[fine] - areas[coarse]) / (fine / coarse - 1)
        yield {
            "branch": "loading" if place <= turn else "unloading", "pressure": targets[place],
            **{f"area_{n}": areas[n] for n in sorted(areas)}, "area": areas[fine] + change, "area_error": abs(change),
            **{f"pairs_{n}": pairs[n] for n in sorted(pairs)},
        }  # fmt: skip


def of_grids(row: dict[str, str], name: str) -> dict[int, float]:
    """The values of columns name + points of a side, by these points."""
    return {int(key.removeprefix(name)): float(row[key]) for key in row if key.removeprefix(name).isdigit()}


PARTS = {"counts": ("adhesion", counts), "peer": ("adhesion-peer", peer), "challenge": ("challenge", challenge)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("of", nargs="*", help="points of a side, or folders")
    asked = parser.parse_args()
    table, part = PARTS[asked.part]
    rows: list[Row] = []  # the table is written whole after each of them, as long parts may be stopped
    for row in list(part(asked.of)) if part is challenge else part(asked.of):  # which reads the table that it writes
        rows.append(row)
        print(*(csv_rows.shown(value, 5) for value in row.values()), flush=True)
        csv_rows.write(TABLES / f"{table}.csv", rows, digits=5)


if __name__ == "__main__":
    main()
