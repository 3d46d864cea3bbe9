"""Many runs, N at a time, each in one process.

    printf '%s\\n' "NAME JOB.toml section.key=value …" … | python tools/paper/runs.py RESULTS [--jobs 2]

Reads one run per line; those whose folder RESULTS/NAME holds a complete run of the same job are not repeated.  Each
run has OMP_NUM_THREADS threads, and its log is RESULTS/NAME.log.  The first run that fails ends all, with its message;
so does Ctrl-C, at once.
"""

import argparse
import logging
import multiprocessing
import signal
import sys
import time
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor, as_completed
from pathlib import Path

from pgfmd.application import job as config
from pgfmd.application.results import Results
from pgfmd.errors import InputError, SolverError


def is_done(folder: Path, path: str, overrides: list[str]) -> bool:
    """Whether the folder holds a complete run of the job in the file `path`; InputError if the job is not valid."""
    wanted = config.load(path, overrides)
    try:
        results = Results(folder)
        done = config.parse(results.provenance["effective_toml"], str(folder))
        return results.status == "complete" and not config.differences(done, wanted)
    except InputError:
        return False


def run(line: str, folder: Path) -> str:
    """Do one run in this process; its name and seconds.  Raises what the run raises."""
    from mpi4py import MPI

    from pgfmd.application.simulate import simulate

    name, path, *overrides = line.split()
    began, log = time.perf_counter(), logging.getLogger("pgfmd")
    handler = logging.FileHandler(folder / f"{name}.log", "w", encoding="utf-8")
    log.setLevel(logging.INFO)
    log.propagate = False
    log.addHandler(handler)
    try:
        simulate(config.load(path, overrides), MPI.COMM_SELF, folder / name, overwrite=True)
    except (InputError, SolverError, OSError, MemoryError) as error:
        reason = str(error) or type(error).__name__
        raise RuntimeError(f"{name}: {reason}") from None  # an exception that can be sent to the parent process
    finally:
        log.removeHandler(handler)
        handler.close()
    return f"{name}: {time.perf_counter() - began:.1f} s"


def main(arguments: list[str] | None = None) -> int:
    """The command line; exit code 0, 2 if a job is not valid, 1 if a run failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path, metavar="RESULTS", help="folder of the result folders")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="runs at a time (default 1)")
    options = parser.parse_args(arguments)
    options.results.mkdir(parents=True, exist_ok=True)
    lines = [line for line in map(str.strip, sys.stdin) if line]
    try:
        todo = [line for line in lines if not is_done(options.results / line.split()[0], *_parts(line))]
    except InputError as error:
        print(f"runs.py: error: {error}", file=sys.stderr)
        return 2
    print(f"{len(todo)} of {len(lines)} runs to do, {options.jobs} at a time, into {options.results}", flush=True)
    began = time.perf_counter()
    for stop in (signal.SIGINT, signal.SIGTERM):
        signal.signal(stop, _end)
    with ProcessPoolExecutor(options.jobs, multiprocessing.get_context("spawn")) as pool:
        tasks = [pool.submit(run, line, options.results) for line in todo]
        try:
            for number, task in enumerate(as_completed(tasks), 1):
                print(f"{time.perf_counter() - began:6.0f} s  {number} of {len(todo)}: {task.result()}", flush=True)
        except BaseException as error:
            _end_runs()
            pool.shutdown(cancel_futures=True)
            if not isinstance(error, RuntimeError):
                raise
            lost = "a run ended without a result (killed, perhaps for lack of memory, or crashed)"
            print(f"runs.py: error: {lost if isinstance(error, BrokenExecutor) else error}", file=sys.stderr)
            return 1
    return 0


def _end(number: int, _) -> None:
    """End with all runs, which would go on, as each catches this signal itself."""
    _end_runs()
    sys.exit(128 + number)


def _end_runs() -> None:
    for process in multiprocessing.active_children():
        process.kill()


def _parts(line: str) -> tuple[str, list[str]]:
    _, path, *overrides = line.split()
    return path, overrides


if __name__ == "__main__":
    sys.exit(main())
