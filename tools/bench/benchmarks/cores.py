"""Speed-up by a second core: one relaxation on one thread, on two threads and on two ranks, in turns.

Two relaxations at once, each on one thread, give the limit of this machine: cores share caches, memory and their clock,
and a virtual machine's host may take them away.  The share of time that it took is recorded with each run; runs that
lost much time say little.
"""

import json
import statistics
import sys
import time
from pathlib import Path

import csv_rows

from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.parallel.mpi import world
from pgfmd.solvers.active_set.contact_from_coarse import solve_hard_wall
from pgfmd.surfaces.self_affine import self_affine

from .case import RMS_SLOPE, SEED, hard_contact, launch, likely_pressure

PLAN = {  # ranks, threads, copies at once
    "one thread": (1, 1, 1),
    "two threads": (1, 2, 1),
    "two ranks": (2, 1, 1),
    "two copies": (1, 1, 2),
}
ASKED = {"two threads": 1.8, "two ranks": 1.7}
COLUMNS = ("n", "hurst", "lambda_s", "area", "tolerance", "cores", "round", "seconds", "stolen")


def main(folder: Path, case: tuple[int, float, float, float, float], rounds: int) -> None:
    """Measure all of PLAN in each round, append to DIR/cores.csv, and print a table of its rows of this case.

    case: n, hurst, lambda_s, area, tolerance.
    """
    path = folder / "cores.csv"
    number = 1 + max((int(row["round"]) for row in csv_rows.read(path)), default=-1)
    for turn in range(number, number + rounds):
        for cores, (ranks, threads, copies) in PLAN.items():
            stolen, busy = _processor_times()
            running = [launch("cores", list(map(str, case)), ranks, threads) for _ in range(copies)]
            ended = [(process.communicate(), process.returncode) for process in running]
            for (_, errors), status in ended:
                if status:
                    raise SystemExit(f"{cores} failed:\n{errors[-1500:]}")
            stolen, busy = (now - then for now, then in zip(_processor_times(), (stolen, busy), strict=True))
            found = [json.loads(output.strip().splitlines()[-1]) for (output, _), _ in ended]
            share = f"{stolen / busy:.3f}" if busy else ""
            seconds = [max(each) for each in zip(*found, strict=True)]
            rows = [(*case, cores, turn, f"{value:.4f}", share) for value in seconds]
            csv_rows.append(path, COLUMNS, [dict(zip(COLUMNS, row, strict=True)) for row in rows], digits=0)
            print(f"  {cores:12} {' '.join(f'{value:.2f}' for value in seconds)} s, stolen {share}", flush=True)
    _print([row for row in csv_rows.read(path) if tuple(float(row[name]) for name in COLUMNS[:5]) == case])


def _print(rows: list[dict]) -> None:
    times = {cores: [float(row["seconds"]) for row in rows if row["cores"] == cores] for cores in PLAN}
    print(f"\n{'':12} {'best':>8} {'median':>8}   gain: {'best':>6} {'median':>8}  asked")
    for cores, seconds in times.items():
        factor = PLAN[cores][2]
        gains = [factor * of(times["one thread"]) / of(seconds) for of in (min, statistics.median)]
        wanted = f"≥ {ASKED[cores]}" if cores in ASKED else "(limit)" if factor > 1 else ""
        print(
            f"{cores:12} {min(seconds):8.2f} {statistics.median(seconds):8.2f}         "
            f"{gains[0]:6.2f} {gains[1]:8.2f}  {wanted}"
        )


def _processor_times() -> tuple[int, int]:
    """Ticks that the host took away, and ticks in use or taken away; zeros without /proc/stat."""
    try:
        fields = [int(field) for field in Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:]]
    except OSError:
        return 0, 0
    return fields[7], sum(fields[:3]) + sum(fields[5:8])


# ---- in the process that measures ----------------------------------------------------------------------------------


def _measure(n: int, hurst: float, lambda_s: float, area: float, tolerance: float) -> list[float]:
    """Seconds of two relaxations, after a small one that loads libraries and compiled kernels.  Collective."""
    comm, seconds = world(), []
    for size, runs in ((min(n, 512), 1), (n, 2)):
        grid = SlabGrid(comm, (size, size))
        for _ in range(runs):
            heights = self_affine(grid, hurst, lambda_s * size / n if size < n else lambda_s, RMS_SLOPE, SEED)
            comm.Barrier()
            began = time.perf_counter()
            solve_hard_wall(hard_contact(grid, heights, likely_pressure(area)), tolerance)
            comm.Barrier()
            seconds.append(time.perf_counter() - began)
    return seconds[1:]


if __name__ == "__main__":
    result = _measure(int(sys.argv[1]), *map(float, sys.argv[2:]))
    if world().rank == 0:
        print(json.dumps(result))
