"""Random jobs over all keys, each answer against a slow reference (tests/reference.py).

    python tools/bench/campaign.py --jobs 20000 --seed 1  # counts, and a minimal job of each that went wrong
    python tools/bench/campaign.py --jobs 500 --ranks 3  # each on three ranks beside one, which are to agree
    python tools/bench/campaign.py --seed 1 --only 4711  # that job alone, as TOML, with its verdict

A job ends right (its true error is within the certified one; pressure, gap, area, mean gap and energy agree with the
reference), or is refused in one line.  Anything else is wrong: an error larger than its bound, a number that does not
fit, a traceback, a warning, a hang.  Jobs run in a process of their own, which is replaced should it hang or crash.
The parts are in campaigns/.
"""

import argparse
import contextlib
import faulthandler
import json
import os
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
from campaigns.drawing import EXTENSIONS, draw
from campaigns.random_case import BAD, HANGS, RIGHT, TRACEBACK, VERDICTS, kind, show
from campaigns.running import HANG, run, run_beside_one
from campaigns.shrinking import shrink
from launching import descendants

ASLEEP = 20  # times HANG, of wall time: a process that waits for nothing


def work_together(seed: int, first: int, count: int, extension: str = "") -> None:
    """Run jobs on the ranks of this program and on one; one line of JSON each.  Collective."""
    from mpi4py import MPI

    comm = MPI.COMM_WORLD
    with tempfile.TemporaryDirectory(prefix="pgfmd-campaign-") as folder:
        place = Path(comm.bcast(folder))
        for number in range(first, first + count):
            if comm.rank == 0:
                print(json.dumps({"begun": number, "pid": os.getpid()}), flush=True)
            began, case = time.perf_counter(), draw(seed, number, extension, comm.size)
            case.way = "simulate" if case.way == "command" else case.way
            verdict, detail = run_beside_one(case, place / str(number), comm)
            request = comm.Ibarrier()  # one rank judges; the others sleep
            while not request.Test():
                time.sleep(2e-3)
            if comm.rank == 0:
                minimal = show(case, "") if verdict in BAD else ""
                shutil.rmtree(place / str(number), ignore_errors=True)
                seconds = time.perf_counter() - began
                found = {"number": number, "verdict": verdict, "detail": detail, "seconds": seconds, "minimal": minimal}
                print(json.dumps(found), flush=True)


def work(seed: int, first: int, count: int, extension: str = "") -> None:
    """Run jobs in this process; one line of JSON each."""
    seen = set()  # one minimal job of each kind is enough
    with tempfile.TemporaryDirectory(prefix="pgfmd-campaign-") as folder:
        for number in range(first, first + count):
            print(json.dumps({"begun": number}), flush=True)
            began = time.perf_counter()
            case = draw(seed, number, extension)
            place = Path(folder) / str(number)
            verdict, detail = run(case, place)
            seconds = time.perf_counter() - began
            minimal = ""
            if verdict in BAD and (like := kind(verdict, detail)) not in seen:
                seen.add(like)
                shrunk, said = shrink(case, verdict, detail, place)
                minimal = show(shrunk, said)
            shutil.rmtree(place, ignore_errors=True)
            found = {"number": number, "verdict": verdict, "detail": detail, "seconds": seconds, "minimal": minimal}
            print(json.dumps(found), flush=True)


def _clocks(process: int) -> tuple[float, float]:
    """Seconds of processor time of a process (of wall time, where the system does not tell), and of wall time."""
    wall = time.monotonic()
    try:
        times = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[11:13]
        return sum(map(int, times)) / os.sysconf("SC_CLK_TCK"), wall
    except (OSError, ValueError):
        return wall, wall


def supervise(seed: int, first: int, count: int, extension: str = "", ranks: int = 1):
    """Results of jobs, run in other processes, which are replaced when one hangs or dies."""
    number, stop = first, first + count
    while number < stop:
        command = [str(Path(__file__).resolve().parents[2] / "tests/mpirun.sh"), str(ranks)] if ranks > 1 else []
        command += [sys.executable, __file__, "--ranks", str(ranks), "--seed", str(seed), "--extension", extension]
        command += ["--work", str(number), str(stop - number)]
        with tempfile.TemporaryFile("w+") as errors:
            worker = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, stdin=subprocess.DEVNULL,
                                      start_new_session=True)  # fmt: skip
            pid = worker.pid
            verdict, buffer, since, patience = None, b"", _clocks(pid), 4 * HANG
            while number < stop:
                ready, _, _ = select.select([worker.stdout], [], [], 1.0)
                chunk = os.read(worker.stdout.fileno(), 1 << 16) if ready else b""
                buffer += chunk
                *lines, buffer = buffer.split(b"\n")
                for line in map(json.loads, lines):
                    pid = line.get("pid", pid)
                    since, patience = _clocks(pid), HANG
                    if "verdict" in line:
                        number = line["number"] + 1
                        patience = 4 * HANG
                        yield line
                if ready and not chunk:
                    verdict = TRACEBACK  # it died
                    break
                busy, wall = np.subtract(_clocks(pid), since)
                if busy > patience or wall > ASLEEP * patience:
                    verdict = HANGS
                    for process in {pid, *descendants(worker.pid)}:  # say where they are
                        os.kill(process, signal.SIGUSR2)
                    time.sleep(1)
                    break
            for process in [*descendants(worker.pid), worker.pid]:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(process, signal.SIGKILL)
            worker.wait()
            if verdict is not None:
                errors.seek(0)
                detail = f"the process ended: {errors.read()[-2000:]}"
                yield {"number": number, "verdict": verdict, "detail": detail, "seconds": HANG,
                       "minimal": show(draw(seed, number, extension, ranks), "")}  # fmt: skip
                number += 1


def report(seed: int, first: int, count: int, extension: str = "", ranks: int = 1, log=None) -> int:
    """Run jobs, print what goes wrong and the counts; 0 if nothing did."""
    verdicts, kinds, began = Counter(), Counter(), time.perf_counter()
    for found in supervise(seed, first, count, extension, ranks):
        verdicts[found["verdict"]] += 1
        if found["verdict"] != RIGHT:
            kinds[kind(found["verdict"], found["detail"])] += 1
        if found["minimal"]:
            print(f"--- seed {seed}, {found['verdict']}: {found['detail']}\n{found['minimal']}", flush=True)
        if log is not None:
            log.write(json.dumps(found) + "\n")
            log.flush()
    print(*(f"{number:6}  {name}" for name, number in kinds.most_common()), sep="\n")
    total = ", ".join(f"{verdicts[name]} {name}" for name in VERDICTS)
    print(f"seed {seed}, {ranks} ranks: {sum(verdicts.values())} jobs: {total}; {time.perf_counter() - began:.0f} s")
    return int(any(verdicts[name] for name in BAD))


def main(arguments: list[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--jobs", type=int, default=300, help="how many")
    parser.add_argument("--seed", type=int, default=1, help="of all of them")
    parser.add_argument("--first", type=int, default=0, help="number of the first")
    parser.add_argument("--only", type=int, help="show the job of that number and its verdict")
    parser.add_argument("--ranks", type=int, default=1, help="of each job; several are compared with one")
    parser.add_argument("--extension", choices=("", *EXTENSIONS), default="", help="only jobs with it")
    parser.add_argument("--log", type=Path, help="file for every verdict, a line of JSON each")
    parser.add_argument("--work", type=int, nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.work:
        faulthandler.register(signal.SIGUSR2)
        (work_together if options.ranks > 1 else work)(options.seed, *options.work, options.extension)
        return 0
    if options.only is not None:
        case = draw(options.seed, options.only, options.extension, options.ranks)
        with tempfile.TemporaryDirectory(prefix="pgfmd-campaign-") as folder:
            verdict, detail = run(case, Path(folder) / "case")
        print(f"{show(case, '')}{verdict}: {detail}")
        return int(verdict in BAD)
    given = options.seed, options.first, options.jobs, options.extension, options.ranks
    with options.log.open("w") if options.log else contextlib.nullcontext() as log:
        return report(*given, log)


if __name__ == "__main__":
    raise SystemExit(main())
