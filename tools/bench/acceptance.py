"""Acceptance of a machine: whether runs on its ranks are right, what they take, and a report of one page.

mpirun -n P python -m mpi4py tools/bench/acceptance.py check FOLDER --ranks P --rows 256  # one rank first
python tools/bench/acceptance.py report FOLDER [--failed P …]  # with measured.jsonl of `scaling.py measure`, if there

`check` adds one line to FOLDER/checks.jsonl.  `jobs/acceptance.sh` does all of it.
"""

import argparse
import json
import math
import os
import platform
import sys
from collections import Counter
from pathlib import Path

import numpy as np

JOB = """
[grid]
n = [{rows}, 256]
[surface]
kind = "self-affine"
hurst = 0.8
lambda_s = 4.0
rms_slope = 0.1
[solid]
contact_modulus = 1.0
[load]
pressure = [0.004, 0.02]
[solver]
tolerance = 1e-20
[output]
observables = ["patches", "spectra"]
fields = ["pressure", "gap", "labels"]
"""
# Allowed: wave against the exact pressure; pressure, gap and numbers against one rank, relative (at this tolerance a
# pressure is known to 1e-10 of its rms value); whether patches differ; number of damaged files.
ALLOWED = {"wave": 1e-10, "pressure": 1e-9, "gap": 1e-9, "numbers": 1e-8, "patches differ": 0.0, "damaged files": 0.0}
NUMBERS = ("contact_area", "mean_gap", "elastic_energy", "contact_perimeter")


def check(folder: Path, ranks: int, rows: int) -> None:
    """A run on these ranks beside that on one, and a wave in full contact beside its exact pressure.  Collective.

    rows: of the run, for all numbers of ranks.  Raises InputError if MPI has not joined that many ranks.
    """
    # Here, and not above: a report is written also where these cannot be imported.
    from pgfmd.application import info, machine
    from pgfmd.application.job import parse
    from pgfmd.application.results import Results
    from pgfmd.application.simulate import simulate
    from pgfmd.errors import InputError
    from pgfmd.parallel.mpi import library, world

    comm = world()
    if comm.size != ranks:
        raise InputError(
            f"{ranks} ranks were asked for, and MPI has joined {comm.size}: is this the mpirun of mpi4py's MPI?"
        )
    hosts = comm.gather(platform.node())
    found: dict[str, object] = {"ranks": comm.size, "errors": {"wave": wave(comm)}}
    simulate(parse(JOB.format(rows=rows)), comm, folder / f"run-{comm.size}", overwrite=True)
    if comm.rank > 0:
        return
    run, one = Results(folder / f"run-{comm.size}"), Results(folder / "run-1")
    pairs = list(zip(run, one, strict=True))
    errors = {  # np.max, since Python's loses a NaN
        name: float(np.max([_apart(a.field(name), b.field(name)) for a, b in pairs])) for name in ("pressure", "gap")
    }
    changes = [abs(a.numbers[name] / b.numbers[name] - 1) for a, b in pairs for name in NUMBERS]
    errors["numbers"] = float(np.max(changes))
    same = all(np.array_equal(a.field("labels"), b.field("labels")) for a, b in pairs)
    same &= all(np.array_equal(a["patches"]["area"], b["patches"]["area"]) for a, b in pairs)
    found["errors"] |= errors | {"patches differ": float(not same), "damaged files": float(len(info.damage(run)))}  # type: ignore[operator]
    found["nodes"] = sorted(Counter(hosts).values(), reverse=True)  # type: ignore[arg-type]
    found["machine"] = {
        "commit": machine.git_commit(), "MPI": library(), "processor": processor(), "time": machine.now(),
        "threads": os.environ.get("OMP_NUM_THREADS", ""), "versions": machine.versions().replace("\n", ", "),
    }  # fmt: skip
    with open(folder / "checks.jsonl", "a") as file:
        file.write(json.dumps(found) + "\n")
    bad = failed_checks(found)
    print(f"{comm.size} ranks: " + ("all is right" if not bad else "WRONG: " + ", ".join(bad)))


def wave(comm) -> float:
    """Error of p = p̄ + K h in full contact of the wave h = cos(2πx/n), over the amplitude.  Collective."""
    from pgfmd.grid.slab_grid import SlabGrid
    from pgfmd.physics.laws.hard import HardWall
    from pgfmd.physics.problem import ContactProblem
    from pgfmd.physics.solids.homogeneous import Homogeneous
    from pgfmd.solvers.dispatch import solve_contact

    n = max(128, comm.size)
    grid = SlabGrid(comm, (n, 128))
    heights = np.cos(2 * np.pi * np.arange(n)[grid.rows, None] / n) * np.ones(128)
    amplitude = np.pi / n  # E' q/2
    problem = ContactProblem(grid, heights, Homogeneous(contact_modulus=1.0), HardWall(), 2 * amplitude)
    pressure = solve_contact(problem).pressure
    errors = np.abs(pressure - amplitude * (2 + heights)) / amplitude
    error = grid.reduction.max(errors)
    grid.free()
    return math.nan if grid.reduction.any(not np.isfinite(errors).all()) else error  # MPI_MAX may lose a NaN


def failed_checks(found: dict) -> list[str]:
    """The errors of a line of checks that are not allowed."""
    return [f"{name} {value:.1e}" for name, value in found["errors"].items() if not value <= ALLOWED[name]]


def report(folder: Path, failed: list[int]) -> int:
    """Writes FOLDER/acceptance.md; 1 if something is wrong, else 0.  failed: ranks that ended with an error."""
    checks = _lines(folder / "checks.jsonl")
    times = [line for line in _lines(folder / "measured.jsonl") if "solve" in line]
    bad = [f"{line['ranks']} ranks: {', '.join(failed_checks(line))}" for line in checks if failed_checks(line)]
    bad += [f"{ranks} ranks: ended with an error, or did not end" for ranks in failed]
    bad += [] if checks else ["no run has ended"]
    lines = ["# pgfmd on this machine", ""]
    lines += [f"**{'WRONG: ' + '; '.join(bad) if bad else f'All is right on {_list(checks)} ranks.'}**", ""]
    lines += ["| | |", "|---|---|"]
    lines += [f"| {name} | {value} |" for line in checks[-1:] for name, value in line["machine"].items()]
    lines += [
        "",
        "Differences from one rank (a rough surface of 256 points a side or more, to 1e-20), and from the exact wave:",
        "",
    ]
    lines += ["| ranks | on each node | " + " | ".join(ALLOWED) + " |", "|---" * (2 + len(ALLOWED)) + "|"]
    lines += [f"| allowed | | {' | '.join(f'{value:.0e}' if value else '0' for value in ALLOWED.values())} |"]
    for line in checks:
        values = " | ".join(f"{line['errors'][name]:.1e}" if line["errors"][name] else "0" for name in ALLOWED)
        lines.append(f"| {line['ranks']} | {' + '.join(map(str, line['nodes']))} | {values} |")
    if times:
        lines += [
            "",
            "A solve, certified to 1e-8 (λ_s = n/64, some 8 % in contact), best of three; messages counted on rank 0:",
            "",
        ]
        head = ("n", "ranks", "threads", "seconds", "speed-up", "transforms", "all-to-alls", "reductions", "halos")
        lines += ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
        lines += [_row(line, times) for line in times]
    path = folder / "acceptance.md"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    print(path)
    return int(bool(bad))


def _row(line: dict, times: list[dict]) -> str:
    alone = [other["solve"] for other in times if other["ranks"] == 1 and other["n"] == line["n"]]
    counts = [sum(value for key, value in line.items() if key.startswith("count ") and key.endswith(name))
              for name in ("all-to-alls", "reductions", "halos")]  # fmt: skip
    faster = f"{min(alone) / line['solve']:.2f}" if alone else ""
    cells = (line["n"], line["ranks"], line["threads"], f"{line['solve']:.3g}", faster, f"{line['transforms']:.2f}")
    return "| " + " | ".join(map(str, (*cells, *counts))) + " |"


def _apart(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


def _list(checks: list[dict]) -> str:
    return ", ".join(str(line["ranks"]) for line in checks)


def processor() -> str:
    """Its model, and how many threads it has."""
    with open("/proc/cpuinfo") as file:
        names = [line.partition(":")[2].strip() for line in file if line.startswith("model name")]
    return f"{names[0] if names else platform.machine()}, {os.cpu_count()} hardware threads"


def _lines(path: Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=["check", "report"])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--ranks", type=int, default=1, help="of `check`: how many were launched")
    parser.add_argument("--rows", type=int, default=256, help="of the surface, at least the largest number of ranks")
    parser.add_argument("--failed", type=int, nargs="*", default=[], help="of `report`: ranks whose runs failed")
    options = parser.parse_args(arguments)
    if options.command == "report":
        return report(options.folder, options.failed)
    options.folder.mkdir(parents=True, exist_ok=True)
    check(options.folder, options.ranks, options.rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
