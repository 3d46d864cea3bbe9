"""One process (or one per rank) that times one method on one case and appends a line of JSON per run to a file.

Started by tools/benchmark.py.  A small problem is solved first, unmeasured: it loads libraries and compiled kernels.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np

from .case import CONTACT_MODULUS, RMS_SLOPE, Case, prepare
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
    parser.add_argument("job", help="the run as JSON, as tools/benchmark.py writes it")
    job = json.loads(parser.parse_args(arguments).job)
    case, folder = Case(**job["case"]), Path(job["folder"])
    if job["method"] == "prepare":
        prepare(case, folder)
    else:
        _measure(job, case, folder)


def _measure(job: dict, case: Case, folder: Path) -> None:
    comm, rows = None, slice(None)
    if job["method"].startswith("pgfmd"):
        from mpi4py import MPI

        from pgfmd.parallel.collectives import slab

        comm = MPI.COMM_WORLD
        rows = slab(case.n, comm.size, comm.rank)
    method = METHODS[job["method"]]
    warm_up(method, job, comm)
    heights, reference = case.heights(folder, rows), case.reference(folder, rows)
    pressure = case.facts(folder)["mean_pressure"]
    for tolerance in TOLERANCES.get(job["method"], (TIGHTEST,)):
        recorder = Recorder(reference, comm, job["floor"], job["budget"])
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


def warm_up(method, job: dict, comm) -> None:
    """A small problem, which loads libraries and compiled kernels."""
    n, (hurst, slope) = 128, (0.8, RMS_SLOPE)
    rng = np.random.default_rng(0)
    q = np.hypot(np.fft.fftfreq(n)[:, None], np.fft.rfftfreq(n)[None, :])
    spectrum = np.fft.rfft2(rng.standard_normal((n, n))) * np.maximum(q, 1 / n) ** (-1 - hurst)
    heights = np.fft.irfft2(spectrum, s=(n, n))
    heights *= slope / np.sqrt(np.mean(np.gradient(heights)[0] ** 2) * 2)
    rows = slice(None)
    if comm is not None:
        from pgfmd.parallel.collectives import slab

        rows = slab(n, comm.size, comm.rank)
    slice_ = np.ascontiguousarray(heights[rows])
    recorder = Recorder(np.ones_like(slice_), comm, budget=1.0)
    pressure = 0.1 * CONTACT_MODULUS * slope
    method(Case(n, hurst, 1.0, 0.0), slice_, pressure, recorder, 1e-8, job["threads"], **job["setting"])


if __name__ == "__main__":
    sys.exit(main())
