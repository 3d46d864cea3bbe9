"""Time to a total error of the contact area, of solver and pixels together, against the limit of ever finer grids.

Each method has the coarsest grid on which every surface gets within the error and stays there, at its best setting.
This solver takes the area inside the contact line; peers take pixels less the correction of Yastrebov et al. (2017,
doi:10.1016/j.triboint.2017.04.023), whose time is not counted.  `python -m benchmarks.total_error JOB` is one run.
"""

import contextlib
import importlib.util
import json
import math
import sys
import time
from pathlib import Path

import csv_rows
import error_bars
import numpy as np

from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables.contact_area import contact_area, contact_line
from pgfmd.parallel.mpi import ALONE
from pgfmd.solvers.active_set.contact_from_coarse import solve_hard_wall

from .case import CONTACT_MODULUS, RMS_SLOPE, Case, hard_contact, launch, surface_of
from .methods import LADDERS, METHODS, PEERS
from .recorder import EnoughError, Recorder
from .worker import TIGHTEST, TOLERANCES, warm_up

WITHIN = 0.003  # relative error of the area
AREA = 0.08
SEEDS = (1, 2, 3, 4)
GRIDS = (4, 8, 16, 32, 64)  # points per λ_s
LARGEST = 8192  # points per side of the grids that limits are from
STAYS = 20  # successive iterations that must be within the error, for methods that are watched at each
STILL = (50, 2e-5)  # if the area changes by less in so many iterations, it has converged on this grid
PIXELS = (math.pi - 1 + math.log(2)) / 24  # part of the length of pixel edges by which pixels overestimate the area
COLUMNS = "hurst across method setting points seed seconds cpu error reached".split()


class AreaRecorder(Recorder):
    """Records the error of the contact area in place of that of the pressure."""

    def __init__(self, limit: float, budget: float) -> None:
        self.limit, self.budget, self.comm = limit, budget, None
        self.points: list[dict] = []
        self.truncated = False

    def note(self, pressure: np.ndarray, transforms: float, scale: float = 1.0, may_stop: bool = False) -> None:
        """Records the corrected area of the pixels."""
        now, cpu = time.perf_counter(), time.process_time()
        contact = np.asarray(pressure) * scale > 0
        edges = sum(np.count_nonzero(contact != np.roll(contact, 1, axis)) for axis in (0, 1))
        self.note_area((np.count_nonzero(contact) - PIXELS * edges) / contact.size, now, cpu)
        if may_stop and (self.over() or self.reached(STAYS) is not None or self._still()):
            raise EnoughError

    def note_area(self, area: float, now: float, cpu: float) -> None:
        """Records the area that was known at these times."""
        seconds, busy = now - self._began - self._paused, cpu - self._began_cpu - self._paused_cpu
        self.points.append({"seconds": seconds, "cpu": busy, "error": area / self.limit - 1})
        self._paused += time.perf_counter() - now
        self._paused_cpu += time.process_time() - cpu

    def reached(self, stays: int) -> dict | None:
        """The first of the last `stays` points, if these are all within the error."""
        last = self.points[-stays:]
        return last[0] if len(last) == stays and all(abs(point["error"]) <= WITHIN for point in last) else None

    def over(self) -> bool:
        """Whether the budget is spent."""
        return bool(self.points) and self.points[-1]["seconds"] > self.budget

    def _still(self) -> bool:
        errors = [point["error"] for point in self.points[-STILL[0] :]]
        return len(errors) == STILL[0] and max(errors) - min(errors) < STILL[1]


def _ours(case: Case, heights, mean_pressure, recorder: AreaRecorder, tolerance: float, threads: int) -> None:
    """A solution and its contact line, from nothing."""
    recorder.start()
    grid = SlabGrid(ALONE, (case.n, case.n), threads=threads)
    problem = hard_contact(grid, heights, mean_pressure)
    solution = solve_hard_wall(problem, tolerance)
    line = contact_line(grid, solution.pressure, solution.gap, problem.solid)
    area = contact_area(grid, solution.pressure, line).corrected
    recorder.note_area(area, time.perf_counter(), time.process_time())
    grid.free()


def main(arguments: list[str] | None = None) -> None:
    """One method on one surface: prints the point that counts, and whether it is within the error, as JSON."""
    job = json.loads((sys.argv[1:] if arguments is None else arguments)[0])
    method = _ours if job["method"] == "pgfmd" else METHODS[job["method"]]
    case = Case(job["points"] * job["across"], job["hurst"], job["points"], AREA)
    pressure = job["load"] * CONTACT_MODULUS * RMS_SLOPE
    heights, ladder = surface_of(case, job["seed"]), job["method"] in LADDERS
    warm_up(METHODS[job["method"]], job, None)
    recorder = AreaRecorder(job["limit"], job["budget"])
    found = None
    for tolerance in TOLERANCES[job["method"]] if ladder else (TIGHTEST,):
        with contextlib.suppress(EnoughError):
            method(case, heights, pressure, recorder, tolerance, job["threads"], **job["setting"])
        found = recorder.reached(2 if ladder else STAYS)
        if found or recorder.over() or recorder.truncated:
            break
    print(json.dumps((found or recorder.points[-1]) | {"reached": int(found is not None)}))


def total(folder: Path, surface: tuple[float, int], plan: list, budget: float, clock: str) -> None:
    """Adds to DIR/total.csv what it lacks, and prints the best of each method.

    surface: H, and λ_s to a side of the cell.  plan: (method, setting).  Limits are those of `error_bars.area`, in
    DIR/area.csv.
    """
    hurst, across = surface
    load = next(load for h, area, load in error_bars.cases() if (h, area) == (hurst, AREA))
    first = error_bars.Case(math.nan, math.nan, SEEDS[0], across)
    error_bars.area(folder / "area.csv", first, LARGEST // across, 1, (hurst, AREA))
    limits = {seed: error_bars.limit(folder / "area.csv", (hurst, AREA, seed, across)) for seed in SEEDS}
    path = folder / "total.csv"
    for method, setting in plan:
        if method in PEERS and importlib.util.find_spec(PEERS[method]) is None:
            print(f"{method} is not installed: left out")
            continue
        for points in GRIDS:
            for seed in SEEDS:
                job = {"hurst": hurst, "across": across, "method": method, "setting": setting, "points": points}
                job |= {"seed": seed, "limit": limits[seed], "load": load, "budget": budget, "threads": 1}
                row = _row(path, job)
                if not row["reached"]:
                    break
            else:
                break  # finer grids take longer
            if row[clock] > _best(path, surface, clock).get(method, (math.inf,))[0]:
                break  # another setting is faster on the grid that it needs
    _print(path, surface, clock)


def _row(path: Path, job: dict) -> dict:
    """What the run found, from the table or measured now."""
    name = " ".join(map(str, job["setting"].values()))
    for row in _rows(path):
        if [row[key] for key in COLUMNS[:6]] == [{**job, "setting": name}[key] for key in COLUMNS[:6]]:
            return row
    process = launch("total_error", [json.dumps(job)], 1, 1)
    output, errors = process.communicate()
    if process.returncode:
        raise SystemExit(f"{job['method']} failed:\n{errors[-1500:]}")
    row = job | json.loads(output.splitlines()[-1]) | {"setting": name}
    csv_rows.append(path, COLUMNS, [{key: row[key] for key in COLUMNS}])
    print("  {method:17s} {setting:26s} {points:3d} points per λ_s, seed {seed}: error {error:8.4f} in {seconds:.3f} s"
          " ({cpu:.3f} s processor time)".format(**row), flush=True)  # fmt: skip
    return row


def _rows(path: Path) -> list[dict]:
    return [{key: value if key in ("method", "setting") else float(value) for key, value in row.items()}
            for row in csv_rows.read(path)]  # fmt: skip


def _best(path: Path, surface: tuple[float, int], clock: str) -> dict[str, tuple[float, float, float, str]]:
    """Mean time, points per λ_s, worst error and setting with which each method was fastest."""
    best: dict[str, tuple[float, float, float, str]] = {}
    rows = [row for row in _rows(path) if (row["hurst"], row["across"]) == surface]
    for method, setting, points in {(row["method"], row["setting"], row["points"]) for row in rows}:
        runs = [row for row in rows if (row["method"], row["setting"], row["points"]) == (method, setting, points)]
        if len(runs) == len(SEEDS) and all(row["reached"] for row in runs):
            error = max(abs(row["error"]) for row in runs)
            found = (float(np.mean([row[clock] for row in runs])), points, error, setting)
            best[method] = min(best.get(method, found), found)
    return best


def _print(path: Path, surface: tuple[float, int], clock: str) -> None:
    best = _best(path, surface, clock)
    print(f"\nTime in s to a total error of the area of {WITHIN:.1%}, one core, H = {surface[0]:g}, {surface[1]} λ_s to"
          f" a side, f_c {AREA:g}, mean of {len(SEEDS)} surfaces")  # fmt: skip
    print(f"{'':17} {'points per λ_s':>14} {'worst error':>11} {'time':>9} {'ratio':>7}")
    for method in dict.fromkeys(row["method"] for row in _rows(path) if (row["hurst"], row["across"]) == surface):
        if method not in best:
            print(f"{method:17} on no grid")
            continue
        seconds, points, error, setting = best[method]
        ratio = seconds / best["pgfmd"][0] if "pgfmd" in best else math.nan
        print(f"{method:17} {points:14.0f} {error:11.2%} {seconds:9.3f} {ratio:7.1f}  {setting}")


if __name__ == "__main__":
    main()
