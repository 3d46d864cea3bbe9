"""Counts of transforms and iterations, time and memory of single solves, each in a process of its own.

Surfaces are self-affine, rms slope .1, E' = 1; the load is that of the wanted contact area by Persson's theory with the
factor that `pgfmd check` takes.  A small contact is solved first: it loads libraries and compiled code.

Methods beside "pgfmd" and the peers': "pgfmd area 0.005" imposes the area itself, to that tolerance; "pgfmd gap 0.5" a
mean gap of .5 rms heights, to 1e-4; "pgfmd free 0.06" solves on a slab with a free base, .06 of the cell thick; "pgfmd
layer 0.05" on a layer that is 1000 times as stiff as its base; "pgfmd open" on a patch with open boundaries.
"""

import itertools
import json
import math
import resource
import sys
import time
from pathlib import Path

import csv_rows
import numpy as np
from scipy.special import erfinv

import pgfmd
from pgfmd.application.estimate import AREA_EXCESS
from pgfmd.grid.domain import OPEN, PERIODIC
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.parallel.mpi import world
from pgfmd.physics.laws.hard import HardWall
from pgfmd.physics.problem import ContactProblem
from pgfmd.physics.solids.homogeneous import Homogeneous
from pgfmd.physics.solids.layered import Layered
from pgfmd.solvers.active_set.cropping import solve_hard_wall
from pgfmd.solvers.load_control import LoadControl
from pgfmd.solvers.options import Load

from .case import CONTACT_MODULUS, Case, launch
from .methods import METHODS
from .recorder import Recorder

KEYS = ("n", "lambda_s", "hurst", "area", "seed", "tolerance", "ranks", "method")
MEASURED = "mean_pressure found_area transforms iterations seconds cpu bytes_per_point certified_error errors".split()
RMS_SLOPE = 0.1
WARM_UP = {"n": 512, "lambda_s": 4.0, "hurst": 0.8, "seed": 1, "tolerance": 1e-8}


def main(folder: Path, cases: dict[str, list]) -> None:
    """Solve each combination of the values of `KEYS` that DIR/counts.csv does not have, and append its row."""
    path = folder / "counts.csv"
    done = {tuple(row[key] for key in KEYS) for row in csv_rows.read(path)}
    for values in itertools.product(*(cases[key] for key in KEYS)):
        case = dict(zip(KEYS, values, strict=True))
        if tuple(map(csv_rows.shown, values)) in done:
            continue
        output, errors = launch("counts", [json.dumps(case)], case["ranks"], 1).communicate()
        row = json.loads(output.strip().splitlines()[-1]) if output.strip() else {"errors": errors.strip()[-200:]}
        csv_rows.append(path, (*KEYS, *MEASURED), [case | row])
        print(*(f"{name}={csv_rows.shown(value)}" for name, value in (case | row).items()), flush=True)


def pressure_of(area: float) -> float:
    """The mean pressure for a contact area A by theory: A = a (1 + c (1 − a)), a = erf(√2 p̄/(E' g))."""
    c = AREA_EXCESS
    persson = (1 + c - math.sqrt((1 + c) ** 2 - 4 * c * area)) / (2 * c)
    return float(erfinv(persson)) * RMS_SLOPE / math.sqrt(2)


class Last(Recorder):
    """Keeps the last pressure that a method notes, without a reference."""

    def __init__(self) -> None:
        self.start = self.add_tail = lambda: None

    def note(self, pressure, transforms, scale=1.0, may_stop=False) -> None:
        self.pressure, self.row = pressure * scale, {"transforms": transforms}


def solve(case: dict, comm, pressure: float) -> dict:
    """The row of one case: peak memory above what the process had before, all ranks together.  Collective."""
    n, before, errors = case["n"], resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, []
    surface = {name: case[name] for name in ("lambda_s", "hurst", "seed")}
    surface |= {"kind": "self-affine", "rms_slope": RMS_SLOPE}
    heights = pgfmd.surface({"grid": {"n": n}, "surface": surface, "solid": {"contact_modulus": 1.0}}, comm)
    last, began, cpu = Last(), time.perf_counter(), time.process_time()
    grid = SlabGrid(comm, (n, n), threads=1, domain=OPEN if "open" in case["method"] else PERIODIC)
    if case["method"].startswith("pgfmd"):
        _, kind, value = (*case["method"].split(), "", "0")[:3]
        solid, load = Homogeneous(contact_modulus=1.0), Load(pressure=(pressure,))
        if kind == "free":
            solid = Homogeneous(contact_modulus=1.0, thickness=float(value) * n, base="free", poisson=0.3)
        elif kind == "layer":
            layer = {"contact_modulus": 1.0, "poisson": 0.3, "thickness": float(value) * n}
            solid = Layered(**layer, base_modulus=1e-3, base_poisson=0.3)
        elif kind == "area":
            load = Load(contact_area=(case["area"],), area_tolerance=float(value))
        elif kind == "gap":
            load = Load(mean_gap=(float(value) * math.sqrt(grid.reduction.dot(heights, heights)) / n,))

        def watch(level, state) -> None:
            errors.append(f"{state.error:.1e}" * (level is grid))

        def solved(problem, start, tolerance):
            return solve_hard_wall(problem, tolerance, start, watch)

        control = LoadControl(load, ContactProblem(grid, heights, solid, HardWall()), case["tolerance"], solved)
        found = control.solution(load.targets[0])
        last.pressure, last.row = found.pressure, {"transforms": found.transforms, "iterations": found.iterations}
        last.row["certified_error"], pressure = found.certified_error, found.mean_pressure
    else:
        of = Case(n, case["hurst"], case["lambda_s"], 0.0)
        METHODS[case["method"]](of, heights, pressure * CONTACT_MODULUS, last, case["tolerance"], 1)
    seconds, cpu = time.perf_counter() - began, time.process_time() - cpu
    peak = comm.allreduce(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
    if "certified_error" not in last.row:
        last.row["certified_error"] = pgfmd.certify(heights, last.pressure, pressure).certified_error
    area = comm.allreduce(int(np.count_nonzero(last.pressure > 0))) / n**2
    return last.row | {
        "mean_pressure": pressure, "found_area": area, "seconds": seconds, "cpu": comm.allreduce(cpu),
        "bytes_per_point": peak * 1024 / n**2, "errors": " ".join(filter(None, errors)),
    }  # fmt: skip


if __name__ == "__main__":
    asked = json.loads(sys.argv[1])
    solve(asked | WARM_UP, world(), pressure_of(asked["area"]))
    result = solve(asked, world(), pressure_of(asked["area"]))
    if world().rank == 0:
        print(json.dumps(result))
