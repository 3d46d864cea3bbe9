"""Where the time of a whole run goes, phase by phase: a job with three fields and all observables that solve no further
contact.

Each phase is compared with what it is made of: the solve, and a transform pair in double precision of the same grid on
the same ranks, measured in the same process after the run.
"""

from __future__ import annotations

import argparse
import csv
import json
import shutil
import sys
import time
from pathlib import Path

import numpy as np

from .case import launch

COLUMNS = ("n", "lambda_s", "ranks", "phase", "seconds", "share_of_solve", "pairs")
OBSERVABLES = "histogram", "spectra", "acf", "gap_spectrum", "patches", "bearing"
SURFACE = {"kind": "self-affine", "hurst": 0.8, "rms_slope": 0.1}
REST = {
    "solid": {"contact_modulus": 1.0},
    "load": {"pressure": [0.00364]},
    "output": {"fields": ["height", "pressure", "gap"], "observables": OBSERVABLES},
}


def phases(folder: Path, n: int, lambda_s: float, ranks: int, rounds: int) -> None:
    """Measure in so many rounds, of which the median counts; append to DIR/phases.csv, and print the table."""
    runs = []
    for _ in range(rounds):
        process = launch("phases", [str(folder / "phases"), str(n), str(lambda_s)], ranks, 1)
        output, errors = process.communicate()
        if process.returncode:
            raise SystemExit(f"phases failed:\n{errors[-1500:]}")
        runs.append(json.loads(output.strip().splitlines()[-1]))
    shutil.rmtree(folder / "phases", ignore_errors=True)
    times = {name: float(np.median([run[name] for run in runs])) for name in runs[0]}
    pair = times.pop("pair")
    rest = sum(seconds for name, seconds in times.items() if name not in ("solve", "start") and " " not in name)
    times["all but solve"] = rest
    rows = [(n, lambda_s, ranks, name, value, value / times["solve"], value / pair) for name, value in times.items()]
    path = folder / "phases.csv"
    fresh = not path.exists()
    with open(path, "a", newline="") as file:
        writer = csv.writer(file)
        if fresh:
            writer.writerow(COLUMNS)
        writer.writerows([*row[:4], *(f"{value:.4f}" for value in row[4:])] for row in rows)
    print(f"\n{n}², lambda_s = {lambda_s:g}, {ranks} ranks, median of {rounds}; a double pair takes {pair:.3f} s")
    print(f"{'phase':24s}{'seconds':>10s}{'/ solve':>10s}{'pairs':>10s}")
    for *_, name, seconds, share, pairs in rows:
        print(f"{name:24s}{seconds:10.3f}{share:10.3f}{pairs:10.2f}")


def main(arguments: list[str] | None = None) -> int:
    """One run in this process; prints the seconds of its phases as JSON.  Collective over COMM_WORLD."""
    began = time.perf_counter()
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("n", type=int)
    parser.add_argument("lambda_s", type=float)
    options = parser.parse_args(arguments)

    from mpi4py import MPI

    from pgfmd.application.job import parse, tables_as_toml
    from pgfmd.application.results import Results
    from pgfmd.application.simulate import simulate
    from pgfmd.grid.slab_grid import SlabGrid
    from pgfmd.grid.transforms import sink, source

    comm = MPI.COMM_WORLD
    start = time.perf_counter() - began
    small, whole = ({"grid": {"n": n}, "surface": SURFACE | {"lambda_s": lambda_s}, **REST}
                    for n, lambda_s in ((256, 16.0), (options.n, options.lambda_s)))  # fmt: skip
    for tables in (small, whole):  # the small one loads compiled code and libraries
        simulate(parse(tables_as_toml(tables)), comm, options.folder, overwrite=True)
    grid = SlabGrid(comm, (options.n, options.n))
    field = np.ones(grid.local_shape)
    pairs = []
    for _ in range(4):
        comm.Barrier()
        began = time.perf_counter()
        grid.convolve(source(field), lambda *_: None, sink(field))
        pairs.append(comm.allreduce(time.perf_counter() - began, MPI.MAX))
    if comm.rank == 0:
        print(json.dumps({"start": start} | Results(options.folder).phases | {"pair": min(pairs)}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
