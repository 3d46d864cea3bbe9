"""Runs of the program started by tests, watched, and killed; results compared with those of an undisturbed run."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from job_texts import rough_job

from pgfmd.application import files
from pgfmd.application.job import tables_as_toml
from pgfmd.application.results import Results

ROOT = Path(__file__).resolve().parent.parent

SIX_LOADS = [0.0005, 0.001, 0.0016, 0.0024, 0.0032, 0.0045]


def write_job(path: Path, n: int, lambda_s: float = 16.0, pressures=SIX_LOADS, interval: float = 0.0) -> Path:
    """A job file; its tolerance is so strict that pressures of equal problems agree to 1e-10."""
    surface = {"lambda_s": lambda_s, "rms_slope": 0.031, "seed": 1}
    path.write_text(rough_job(n, surface, **_strict(pressures, interval, observables=["histogram"])))
    return path


def write_file_job(path: Path, n: int, heights: Path, pressure: float) -> Path:
    """A job of six loads, from that pressure on, on the n × n heights in a file; as strict as that of `write_job`."""
    pressures = [pressure * (1 + 0.3 * number) for number in range(6)]
    surface, solid = {"kind": "file", "path": str(heights)}, {"lame_lambda": 1.0, "lame_mu": 1.0}
    path.write_text(tables_as_toml({"grid": {"n": n}, "surface": surface, "solid": solid, **_strict(pressures, 0.0)}))
    return path


def _strict(pressures, interval: float, **output) -> dict:
    """Sections of a job with a tolerance close to rounding."""
    return {
        "load": {"pressure": list(pressures)},
        "solver": {"tolerance": 1e-23},
        "output": {"fields": ["height", "pressure"], **output},
        "run": {"checkpoint_interval": interval},
    }


def start(ranks: int, *arguments, script=("-m", "pgfmd"), environment=None) -> subprocess.Popen:
    """`mpirun -n ranks python -m pgfmd …`, going on in a session of its own; stderr is a pipe."""
    command = [str(ROOT / "tests" / "mpirun.sh"), str(ranks), sys.executable, *map(str, (*script, *arguments))]
    return subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, cwd=ROOT,
        start_new_session=True, env=dict(os.environ) | (environment or {}),
    )  # fmt: skip


def by_chance() -> random.Random:
    """A random generator of a new seed, which pytest shows if the test fails."""
    seed = time.time_ns()
    print(f"seed {seed}")
    return random.Random(seed)


def until_loads(run: subprocess.Popen, folder: Path, count: int = 1) -> None:
    """Waits until so many loads are in a folder, which may not be there yet."""
    end = time.monotonic() + 1200  # of a run that hangs: loads of tests take seconds
    while not (folder / "observables.h5").exists() or len(Results(folder)) < count:
        assert run.poll() is None and time.monotonic() < end, f"{count} loads are not in {folder}"
        time.sleep(0.2)


def wait_for_folder(run: subprocess.Popen, folder: Path) -> float:
    """Waits until the run has its output folder, or ends; the moment of that, by time.monotonic."""
    while run.poll() is None and "process" not in (files.holder(folder) or ""):
        time.sleep(0.01)
    return time.monotonic()


def descendants(pid: int) -> list[int]:
    """Processes started by that one, and by those."""
    children: dict[int, list[int]] = {}
    for entry in os.listdir("/proc"):
        if entry.isdigit():
            try:
                parent = int(Path("/proc", entry, "stat").read_text().rpartition(")")[2].split()[1])
            except (OSError, IndexError):  # it has just ended
                continue
            children.setdefault(parent, []).append(int(entry))
    found = [pid]
    for each in found:
        found += children.get(each, [])
    return found[1:]


def ranks_of(run: subprocess.Popen) -> list[int]:
    """The Python processes of a run."""
    return [pid for pid in descendants(run.pid) if "python" in _command(pid).split("\0")[0]]


def _command(pid: int) -> str:
    try:
        return Path("/proc", str(pid), "cmdline").read_text()
    except OSError:
        return ""


def _lives(pid: int) -> bool:
    """Whether any thread of a process exists: until the last one is gone, it holds its files and their locks."""
    try:
        tasks = os.listdir(f"/proc/{pid}/task")
        return any(Path("/proc", str(pid), "task", task, "stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
                   for task in tasks)  # fmt: skip
    except OSError:  # a thread has just ended: look again
        return Path("/proc", str(pid)).exists()


def kill(run: subprocess.Popen, way: str = "all", choose=min) -> None:
    """End a run: SIGKILL to the rank that is chosen ("one"), to everything ("all"), or SIGTERM to mpirun ("mpirun")."""
    victims = [run.pid]
    run.family = descendants(run.pid)  # once mpirun is gone, they are nobody's, but may hold files for a moment
    if way == "one":
        victims = [choose(ranks_of(run) or victims)]
    elif way == "all":
        victims += run.family
    for pid in victims:
        try:
            os.kill(pid, signal.SIGTERM if way == "mpirun" else signal.SIGKILL)
        except ProcessLookupError:
            continue


def wait(run: subprocess.Popen, timeout: float = 120) -> tuple[int, str]:
    """Exit code and stderr of a run, once all of its processes are gone; none may outlive `timeout`."""
    family, stderr, end = set(getattr(run, "family", ())), None, time.monotonic() + timeout
    try:
        while stderr is None:
            family |= set(descendants(run.pid))
            try:
                _, stderr = run.communicate(timeout=0.5)
            except subprocess.TimeoutExpired:
                if time.monotonic() > end:
                    raise
    finally:
        if run.poll() is None:
            kill(run)
    while any(_lives(pid) for pid in family):
        assert time.monotonic() < end + 30, "ranks outlived their mpirun"
        time.sleep(0.05)
    return run.returncode, stderr


def run_to_end(ranks: int, *arguments, timeout: float = 900, **options) -> str:
    """Stderr of a run that ends well."""
    code, stderr = wait(start(ranks, *arguments, **options), timeout)
    assert code == 0, stderr
    return stderr


def distance(folder: Path, reference: Path, complete: bool = True) -> tuple[int, float]:
    """Loads of a run, all there if `complete`, and the largest relative L2 difference of pressures from a reference."""
    if not complete and not (folder / "observables.h5").exists():
        return 0, 0.0
    mine, other = Results(folder), Results(reference)
    assert not complete or (mine.status, len(mine)) == ("complete", len(other))
    if len(mine):
        np.testing.assert_allclose(mine.field("height"), other.field("height"), atol=1e-12)
    found = [0.0]
    for index in range(len(mine)):
        a, b = mine.field("pressure", index), other.field("pressure", index)
        found.append(float(np.linalg.norm(a - b) / np.linalg.norm(b)))
        np.testing.assert_allclose(mine.loads["contact_area"][index], other.loads["contact_area"][index], atol=1e-5)
    return len(mine), max(found)
