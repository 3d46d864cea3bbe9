"""One process (or one per rank) that times one method on one case and appends a line of JSON per run to a file.

Started by tools/bench/benchmark.py.  A small problem is solved first, unmeasured, to load libraries and compiled loops.
"""

import argparse
import json
import math
import sys
from functools import partial
from pathlib import Path

import numpy as np

import pgfmd
from pgfmd.parallel.collectives import slab
from pgfmd.parallel.mpi import world

from .case import CONTACT_MODULUS, RMS_SLOPE, Case, prepare, surface_of
from .methods import METHODS
from .recorder import Recorder

TOLERANCES = {
    "pgfmd": tuple(10.0**-exponent for exponent in range(2, 16)),  # of second order: pressures to 1e-1 … 1e-7
    "pgfmd steps": (1e-15,),
    "ASPHER": tuple(10.0**-exponent for exponent in range(3, 12)),
}
TIGHTEST = 1e-12  # what methods that are watched at each iteration are asked for


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("job", help="the run as JSON, as tools/bench/benchmark.py writes it")
    job = json.loads(parser.parse_args(arguments).job)
    case, folder = Case(**job["case"]), Path(job["folder"])
    if job["method"] == "prepare":
        prepare(case, folder)
    else:
        _measure(job, case, folder)


def _measure(job: dict, case: Case, folder: Path) -> None:
    comm, rows = None, slice(None)
    if job["method"].startswith("pgfmd"):
        comm = world()
        rows = slab(case.n, comm.size, comm.rank)
    method = METHODS[job["method"]]
    warm_up(method, job, comm)
    heights, reference = case.heights(folder, rows), case.reference(folder, rows)
    pressure = case.facts(folder)["mean_pressure"]
    certify = partial(certified, heights, reference, comm=comm)
    for tolerance in TOLERANCES.get(job["method"], (TIGHTEST,)):
        recorder = Recorder(reference, comm, job["floor"], job["budget"], certify)
        method(case, heights, pressure, recorder, tolerance, job["threads"], **job["setting"])
        if comm is None or comm.rank == 0:
            with open(job["out"], "a") as out:
                line = {"tolerance": tolerance, "truncated": recorder.truncated, "points": recorder.points}
                out.write(json.dumps(line) + "\n")
        last = recorder.points[-1]
        over = last["seconds"] > job["budget"] / 2  # the next one would take longer
        over = over if comm is None else comm.bcast(over)
        if last["pressure_error"] <= job["floor"] or recorder.truncated or over:
            break


def certified(heights, reference, pressure, comm=None) -> tuple[float, float]:
    """The bound of a pressure's energy error by `pgfmd.certify`, and J(p) − J(p*) = ½⟨d, Gd⟩ + ⟨g*, d⟩ with d = p − p*,
    p* the reference and g* its gap, both over 2 E_el; the second is NaN on several ranks.  Collective.
    """
    load = {"mean_pressure": mean(reference, comm), "contact_modulus": CONTACT_MODULUS, "comm": comm}
    found = pgfmd.certify(heights, pressure, **load)
    if comm is not None and comm.size > 1:
        return found.certified_error, math.nan
    change = pressure * (load["mean_pressure"] / mean(pressure, comm)) - reference
    q = 2 * np.pi * np.hypot(*np.meshgrid(*map(np.fft.fftfreq, change.shape), indexing="ij"))
    q[0, 0] = math.inf
    square = np.sum(np.abs(np.fft.fft2(change)) ** 2 / q) / change.size * 2 / CONTACT_MODULUS
    true = square / 2 + np.vdot(pgfmd.certify(heights, reference, **load).gap, change)
    return found.certified_error, float(true / change.size / (2 * found.elastic_energy))


def mean(field, comm) -> float:
    """Of a field (rows, n) over all ranks."""
    sums = np.array([np.sum(field), np.size(field)])
    return float(np.divide(*(sums if comm is None else comm.allreduce(sums))))


def warm_up(method, job: dict, comm) -> None:
    """A small problem, which loads libraries and compiled kernels."""
    case = Case(128, 0.8, 1.0, 0.0)
    rows = slice(None) if comm is None else slab(case.n, comm.size, comm.rank)
    heights = surface_of(case)[rows]
    recorder = Recorder(np.ones_like(heights), comm, budget=1.0)
    pressure = 0.1 * CONTACT_MODULUS * RMS_SLOPE
    method(case, heights, pressure, recorder, 1e-8, job["threads"], **job["setting"])


if __name__ == "__main__":
    sys.exit(main())
