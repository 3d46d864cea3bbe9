#!/usr/bin/env python
"""Run time against error: this solver, the fastest peers and plain Polonsky–Keer, in one run on this machine.

    python tools/bench/benchmark.py run DIR --n 1024 --hurst 0.8 --lambda-s 16 --area 0.08  # measure cases, in turns
    python tools/bench/benchmark.py resolution DIR  # discretisation error against n
    python tools/bench/benchmark.py transforms DIR  # an FFT pair, ours and others'
    python tools/bench/benchmark.py cores DIR  # what a second core gains
    python tools/bench/benchmark.py counts DIR --n 4096 --area .2 .5 --seeds 1 2 --ranks 1 2  # transforms, memory
    python tools/bench/benchmark.py total DIR --hurst 0.8  # to a total error of the area
    python tools/bench/benchmark.py report DIR  # tables, pictures once more

All times are wall seconds of a complete solution: planning, coarse grids and all, but not the start of Python, the
loading of compiled code and the surface.  Errors are relative to a solution certified to 1e-20 on the same grid.  Runs
already in DIR/runs.csv are not repeated, so that an interrupted benchmark goes on, and cases add up.  Peers that are
not installed (`tools/setup.sh bench`) are left out and named.  Processor time is noted too: on a busy machine, on one
core, `report --clock cpu` says more.
"""

import argparse
import contextlib
import dataclasses
import importlib.util
import itertools
import json
import platform
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import csv_rows
from acceptance import processor
from benchmarks import cores, counts, ratios, resolution, total_error, transforms
from benchmarks.case import Case, launch
from benchmarks.methods import PEERS

COLUMNS = (
    "n hurst lambda_s area mean_pressure method setting ranks threads repeat tolerance point "
    "seconds cpu transforms pressure_error area_error truncated certified_error energy_error"
).split()

# ASPHER's precisions and preconditioners; which is best depends on the case.
ASPHER = [
    {"precision": precision, "engine": engine}
    for engine in ("fft", "stencil")
    for precision in ("float", "double", "float_then_double")
]
PLAN = [  # (method, setting, ranks, threads)
    ("pgfmd", {}, 1, 1),
    *[("ASPHER", setting, 1, 1) for setting in ASPHER],
    ("pgfmd", {}, 2, 1),
    ("pgfmd", {}, 1, 2),
    *[("ASPHER", setting, 1, 2) for setting in ASPHER],
    ("pgfmd steps", {}, 1, 1),
    ("Polonsky-Keer", {}, 1, 1),
    ("GFMD", {}, 1, 1),
    ("tamaas", {}, 1, 1),
    ("tamaas", {}, 1, 2),
    ("ContactMechanics", {}, 1, 1),
]


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("run", "resolution", "transforms", "cores", "counts", "total", "report"))
    parser.add_argument("folder", type=Path, help="for results; made if missing")
    parser.add_argument("--n", type=int, nargs="+", help="points per side (512; transforms, cores: 4096)")
    parser.add_argument("--hurst", type=float, nargs="+", default=[0.8])
    parser.add_argument("--lambda-s", nargs="+", help="in grid spacings; n/64 is allowed (16; cores: n/64)")
    parser.add_argument("--across", type=int, nargs="+", default=[64], help="λ_s to a side of the cell (total)")
    parser.add_argument("--area", type=float, nargs="+", default=[0.08], help="relative contact areas")
    parser.add_argument(
        "--methods", nargs="+", help=f"of {', '.join(dict.fromkeys(p[0] for p in PLAN))}; all by default"
    )
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2], help="cores (ranks × threads) to run on")
    parser.add_argument("--repeat", type=int, default=3, help="repeats, of which the best counts")
    parser.add_argument("--budget", type=float, default=120.0, help="seconds that one solution may take")
    parser.add_argument("--floor", type=float, default=1e-7, help="pressure error at which a method may stop")
    parser.add_argument("--tolerance", type=float, help="certified error (cores: 1e-4; counts: 1e-8)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1], help="of the surfaces (counts)")
    parser.add_argument("--ranks", type=int, nargs="+", default=[1], help="processes of a solve (counts)")
    parser.add_argument("--clock", choices=("seconds", "cpu"), default="seconds", help="which time the tables compare")
    parser.add_argument("--keep", action="store_true", help="keep surfaces and references, each 8 bytes per point")
    options = parser.parse_args(arguments)
    options.folder.mkdir(parents=True, exist_ok=True)
    (options.folder / "machine.txt").write_text(describe_machine() + "\n")
    sizes = options.n or [4096]
    if options.what == "run":
        measure(options)
    elif options.what == "resolution":
        resolution.main(options.folder)
    elif options.what == "transforms":
        for n in sizes:
            transforms.main(options.folder, n)
    elif options.what == "cores":
        for n, hurst, length, area in itertools.product(
            sizes, options.hurst, options.lambda_s or ["n/64"], options.area
        ):
            case = (n, hurst, _wavelength(length, n), area, options.tolerance or 1e-4)
            cores.main(options.folder, case, options.repeat)
    elif options.what == "counts":
        for n, length in itertools.product(sizes, options.lambda_s or ["16"]):
            case = {"n": [n], "lambda_s": [_wavelength(length, n)], "hurst": options.hurst, "area": options.area}
            more = {"seed": options.seeds, "tolerance": [options.tolerance or 1e-8], "ranks": options.ranks}
            counts.main(options.folder, case | more | {"method": options.methods or ["pgfmd"]})
    elif options.what == "total":
        peers = ("pgfmd", "ASPHER", "tamaas", "ContactMechanics")
        plan = [p[:2] for p in PLAN if p[2:] == (1, 1) and p[0] in (options.methods or peers)]
        for surface in itertools.product(options.hurst, options.across):
            total_error.total(options.folder, surface, plan, options.budget, options.clock)
    if options.what in ("run", "resolution", "report"):
        ratios.report(options.folder, options.clock)
    return 0


def measure(options) -> None:
    """All cases × methods × repeats that are asked for and not yet in runs.csv."""
    plan = [p for p in PLAN if (not options.methods or p[0] in options.methods) and p[2] * p[3] in options.threads]
    for name in sorted({p[0] for p in plan} & set(PEERS)):
        if importlib.util.find_spec(PEERS[name]) is None:
            print(f"{name} is not installed: left out")
            plan = [p for p in plan if p[0] != name]
    done = _done(options.folder)
    for n, hurst, length, area in itertools.product(
        options.n or [512], options.hurst, options.lambda_s or ["16"], options.area
    ):
        case = Case(n, hurst, _wavelength(length, n), area)
        jobs = [
            (p, repeat) for repeat in range(options.repeat) for p in plan if (case.name, *_key(p), repeat) not in done
        ]
        if not jobs:
            continue
        print(case.name, flush=True)
        if not case.prepared(options.folder):
            _start({"case": dataclasses.asdict(case), "folder": str(options.folder), "method": "prepare"}, 1, 2, None)
        slow = set()
        for step, repeat in jobs:
            if _key(step) not in slow and _one(options, case, step, repeat):
                slow.add(_key(step))
        if not options.keep:
            for path in options.folder.glob("*.npy"):
                path.unlink()


def _wavelength(length: str, n: int) -> float:
    """In grid spacings, as given on the command line: a number, or n/ a number."""
    return n / float(length[2:]) if length.startswith("n/") else float(length)


def _key(step) -> tuple[str, str, int, int]:
    method, setting, ranks, threads = step
    return method, " ".join(str(value) for value in setting.values()), ranks, threads


def _one(options, case: Case, step, repeat: int) -> bool:
    """Run one method and add its points to runs.csv.  True if it is too slow to be repeated."""
    method, setting, ranks, threads = step
    out = options.folder / "points.jsonl"
    out.unlink(missing_ok=True)
    job = {"case": dataclasses.asdict(case), "folder": str(options.folder), "method": method, "setting": setting}
    job |= {"threads": threads, "budget": options.budget, "floor": options.floor, "out": str(out)}
    ended = _start(job, ranks, threads, 6 * options.budget + 120)
    runs = [json.loads(line) for line in out.read_text().splitlines()] if out.exists() else []
    facts = case.facts(options.folder)
    rows, known = [], dataclasses.asdict(case) | {"mean_pressure": facts["mean_pressure"]}
    known |= dict(zip(("method", "setting", "ranks", "threads"), _key(step), strict=True)) | {"repeat": repeat}
    for run in runs:
        for number, point in enumerate(run["points"]):
            extra = {"tolerance": run["tolerance"], "point": number, "truncated": int(run["truncated"])}
            rows.append(known | point | extra)
    csv_rows.append(options.folder / "runs.csv", COLUMNS, rows or [known | {"truncated": 1}])
    best = min((row["pressure_error"] for row in rows), default=float("inf"))
    slowest = max((row["seconds"] for row in rows), default=0.0)
    name = " ".join(filter(None, _key(step)[:2]))
    print(
        f"  {name:34s} {ranks} × {threads}  {best:9.1e} in {slowest:8.2f} s {'' if ended else '(stopped)'}", flush=True
    )
    return not rows or slowest > options.budget / 4


def _start(job: dict, ranks: int, threads: int, timeout: float | None) -> bool:
    """Run the worker in its own process or processes.  False if it was stopped after `timeout` seconds."""
    process = launch("worker", [json.dumps(job)], ranks, threads)
    try:
        _, errors = process.communicate(timeout=timeout)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        return False
    if process.returncode:
        print(f"  {job['method']} failed:\n{errors[-1500:]}", file=sys.stderr)
        if job["method"] == "prepare":
            raise SystemExit(1)
    return True


def _done(folder: Path) -> set[tuple]:
    """Case, method and repeat of each run in the table."""
    return {
        (
            Case(int(row["n"]), float(row["hurst"]), float(row["lambda_s"]), float(row["area"])).name,
            *(row["method"], row["setting"], int(row["ranks"]), int(row["threads"]), int(row["repeat"])),
        )
        for row in csv_rows.read(folder / "runs.csv")
    }


def describe_machine() -> str:
    """One line: processor, system, Python and the versions of all that is compared."""
    parts = [f"{processor()}, {platform.system()}, Python {platform.python_version()}"]
    for name in ("pgfmd", "numpy", "numba", "pyfftw", "aspher", "tamaas", "ContactMechanics", "mkl_fft"):
        with contextlib.suppress(PackageNotFoundError):
            parts.append(f"{name} {version(name)}")
    return "; ".join(parts)


if __name__ == "__main__":
    sys.exit(main())
