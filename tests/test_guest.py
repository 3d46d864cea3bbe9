"""A process that imports the package, and calls it, stays as it was; without MPI it gives the same results."""

import ast
import gc
import multiprocessing
import os
import re
import shutil
import subprocess
import sys
import tomllib
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from conftest import ROOT, python
from job_texts import EVERY_OBSERVABLE, rough_job
from mpi4py import MPI

import pgfmd
from pgfmd.application.job import parse
from pgfmd.application.results import Results
from pgfmd.application.simulate import simulate
from pgfmd.physics.problem import ContactProblem

STATE = """
import gc, locale, logging, os, signal, sys, threading, warnings
import h5py, numba, numpy as np, pyfftw, scipy

def state():
    loggers = [logging.root, *map(logging.getLogger, ("pgfmd", "numba"))]
    return {
        "environment": dict(os.environ), "folder": os.getcwd(), "umask": (os.umask(0o22), os.umask(0o22)),
        "garbage": (gc.isenabled(), gc.get_threshold(), gc.get_debug(), gc.get_freeze_count(), *gc.callbacks),
        "interpreter": (sys.getrecursionlimit(), sys.getswitchinterval(), sys.gettrace(), sys.getprofile()),
        "hooks": (sys.excepthook, sys.unraisablehook, sys.displayhook, threading.excepthook, sys.stdout, sys.stderr),
        "imports": (*sys.path, *sys.meta_path, *sys.path_hooks), "locale": locale.setlocale(locale.LC_ALL),
        "signals": [signal.getsignal(number) for number in sorted(signal.valid_signals())],
        "warnings": (*warnings.filters, warnings.showwarning, warnings.formatwarning),
        "logging": [(each.level, *each.handlers, *each.filters, each.propagate, each.disabled) for each in loggers],
        "no logging below": logging.root.manager.disable, "NumPy": (np.geterr(), np.geterrcall(), np.getbufsize()),
        "print": np.get_printoptions(), "FFTW": (pyfftw.config.NUM_THREADS, pyfftw.config.PLANNER_EFFORT),
        "numba": {name: repr(value) for name, value in vars(numba.config).items() if name.isupper()},
    }

before = state()
import pgfmd
"""
SHOW = "print(sorted(name for name, value in state().items() if value != before[name]))"
USE = """
x = np.cos(2 * np.pi * np.arange(16) / 16)
pgfmd.solve(x[:, None] + x, 0.1, threads=2)
"""


@pytest.mark.parametrize("used", ["", USE], ids=["imported", "used"])
def test_the_process_is_left_as_it_was(used):
    """Environment, interpreter, logging, warnings, signals, NumPy and other libraries have the settings of before."""
    fresh = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
    command = [sys.executable, "-c", STATE + used + SHOW]
    done = subprocess.run(command, cwd=ROOT, env=fresh, capture_output=True, text=True)
    assert done.stdout == "[]\n", done.stderr


def test_garbage_is_collected_while_loops_are_compiled(tmp_path):
    """Also those of the package: other threads of the process may need it."""
    code = """
import gc, numba, numpy as np, pgfmd
from numba.core import event

class Look(event.Listener):
    seen = set()
    def on_start(self, _):
        self.seen.add(gc.isenabled())
    on_end = on_start

event.register("numba:compile", Look())
from pgfmd.observables.run_length import _flatten
_flatten(np.zeros(4, int), np.zeros((4, 2), int))
print(Look.seen)
"""
    environment = {"PGFMD_CACHE": str(tmp_path), "PATH": ""}
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.stdout == "{True}\n", done.stderr


def test_private_parts_of_libraries_have_an_upper_bound():
    """The package needs a library below some version where it imports what that may change at any time: a name that
    begins with an underscore, or of `numba.core`, which numba's documentation calls internal."""
    needed = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    bounded = {re.split("[<>=]", need)[0] for need in needed if "<" in need}
    private = set()
    for path in (ROOT / "pgfmd").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import | ast.ImportFrom) else []
            if isinstance(node, ast.ImportFrom):
                names = [f"{node.module}.{name}" for name in names]
            for library, *parts in (name.split(".") for name in names):
                hidden = any(part.startswith("_") for part in parts) or library == "numba" and parts[:1] == ["core"]
                if hidden and library not in ("pgfmd", "__future__"):
                    private.add(library)
    assert "numba" in private
    assert private <= bounded


def pressure(seed: int) -> np.ndarray:
    """Of a rough surface; those with even seeds are large enough for two threads of each solver."""
    n = 16 if seed % 2 else 512
    heights = np.random.default_rng(seed).normal(size=(n, n))
    return pgfmd.solve(heights, 0.1, threads=2, progress=False).pressure


def test_two_threads_at_once():
    """Each gets what it gets alone, also of transforms that nobody has planned yet."""
    with ThreadPoolExecutor(2) as threads:
        together = list(threads.map(pressure, [1, 2, 3, 4]))
    for seed, found in enumerate(together, 1):
        np.testing.assert_array_equal(found, pressure(seed))


def _send(pipe, seed: int) -> None:
    pipe.send(pressure(seed))


def test_a_forked_worker():
    """A process forked from one that has solved with several threads gets what that gets."""
    expected, (mine, its) = pressure(2), multiprocessing.Pipe(duplex=False)
    worker = multiprocessing.get_context("fork").Process(target=_send, args=(its, 2))
    worker.start()
    try:
        assert mine.poll(60), "the worker hangs"
        np.testing.assert_array_equal(mine.recv(), expected)
    finally:
        worker.kill()
        worker.join()


@pytest.mark.breadth
def test_a_thousand_calls_take_no_more_memory():
    """Less than 2 MB, 2 kB a call, which allocators' pages may come to; one field of 16 × 16 points takes as much."""
    code = """
import gc, numpy as np, pgfmd
rng = np.random.default_rng(1)
def resident():
    gc.collect()
    return int(open("/proc/self/statm").read().split()[1]) * 4096
for number in range(1100):
    pgfmd.solve(rng.normal(size=(16, 16)), 0.1, threads=1, progress=False)
    if number == 99:
        before = resident()
print(resident() - before)
"""
    done = python(code)
    assert int(done.stdout) < 2e6, done.stderr


def test_a_run_keeps_no_fields(tmp_path):
    """After a run nothing holds its fields, not even until the garbage collector runs: runs follow one another."""
    job = parse(rough_job(32, load={"pressure": [0.01, 0.02]}))
    gc.collect()
    gc.disable()
    try:
        simulate(job, MPI.COMM_SELF, tmp_path / "out")
        assert not [each for each in gc.get_objects() if isinstance(each, ContactProblem)]
    finally:
        gc.enable()


HIDE = "import sys; sys.modules['mpi4py'] = None\n"  # any import of mpi4py fails, as where it is not installed
MAIN = "import sys\nfrom pgfmd.application.cli import main\nsys.exit(main())"

JOB = rough_job(
    [48, 50],
    load={"contact_area": [0.1]},
    output={"fields": ["height", "pressure", "gap", "labels"], "observables": EVERY_OBSERVABLE},
)

SOLVE = """
import numpy as np, pgfmd
x = 2 * np.pi / 32 * np.arange(32)
contact = pgfmd.solve(np.cos(x[:, None]) * np.cos(x), 0.1)
np.save(sys.argv[1], contact.pressure)
"""

LAUNCH = """
import subprocess, sys
rank = "from mpi4py import MPI; print(MPI.COMM_WORLD.size)"
sys.exit(subprocess.run([sys.argv[2], "-n", "2", sys.executable, "-c", rank]).returncode)
"""


def test_a_run_without_mpi_writes_the_same(tmp_path):
    """Without mpi4py a run of all observables writes the same fields byte for byte, the same numbers, and says so."""
    (tmp_path / "job.toml").write_text(JOB)
    for code, name in ((HIDE + MAIN, "alone"), (MAIN, "mpi")):
        done = python(code, "run", tmp_path / "job.toml", "--output", tmp_path / name)
        assert done.returncode == 0, done.stderr
    for path in (tmp_path / "mpi" / "fields").iterdir():
        assert path.read_bytes() == (tmp_path / "alone" / "fields" / path.name).read_bytes()
    alone, mpi = Results(tmp_path / "alone"), Results(tmp_path / "mpi")
    for title, table in mpi.load(0).items():
        for key, values in table.items():
            np.testing.assert_array_equal(alone.load(0)[title][key], values)
    assert "MPI none" in alone.provenance["libraries"] and "MPI none" not in mpi.provenance["libraries"]


def test_solve_needs_no_mpi_and_leaves_mpirun_usable(comm, tmp_path):
    """`pgfmd.solve` gives the same pressures without mpi4py as on MPI's COMM_SELF, and a process that has called it
    starts two ranks of mpirun with the environment as it is (an initialised Open MPI makes its children refuse)."""
    x = 2 * np.pi / 32 * np.arange(32)
    expected = pgfmd.solve(np.cos(x[:, None]) * np.cos(x), 0.1, comm=comm).pressure
    done = python(HIDE + SOLVE, tmp_path / "alone.npy")
    assert done.returncode == 0, done.stderr
    np.testing.assert_array_equal(np.load(tmp_path / "alone.npy"), expected)
    mpirun = shutil.which("mpirun")
    if mpirun is None:
        pytest.skip("needs mpirun")
    done = python("import sys" + SOLVE + LAUNCH, tmp_path / "two.npy", mpirun)
    assert (done.returncode, done.stdout.count("2")) == (0, 2), done.stderr


@pytest.mark.parametrize("rank", [0, 1])
def test_ranks_without_mpi_are_refused(tmp_path, rank):
    """Two ranks without mpi4py, each of which would run all: exit code 2, one line of rank 0, nothing written."""
    (tmp_path / "job.toml").write_text(JOB)
    launched = {"OMPI_COMM_WORLD_SIZE": "2", "OMPI_COMM_WORLD_RANK": str(rank)}
    done = python(HIDE + MAIN, "run", tmp_path / "job.toml", "--output", tmp_path / "out", **launched)
    assert done.returncode == 2
    lines = done.stderr.splitlines()
    assert len(lines) == 1 - rank and all("launched as 2 ranks, but mpi4py cannot be used" in line for line in lines)
    assert not (tmp_path / "out").exists()


def test_the_package_lists_its_public_names():
    """Also those that are imported when first used: an interactive session completes them."""
    assert set(pgfmd.__all__) <= set(dir(pgfmd)) and {"solve", "run", "Results"} <= set(pgfmd.__all__)


@pytest.mark.parametrize("size", ["SLURM_STEP_NUM_TASKS", "PMI_SIZE"])
def test_tasks_that_mpi_does_not_join_are_refused(tmp_path, size):
    """A launcher starts two tasks with which the MPI library does not speak, as `srun` without PMI or another library's
    mpirun: each would run the whole job.  One line of rank 0 says how to start them; both end with 2."""
    (tmp_path / "job.toml").write_text(JOB)
    name = {"SLURM_STEP_NUM_TASKS": "SLURM_PROCID", "PMI_SIZE": "PMI_RANK"}[size]
    for rank in range(2):
        launched = {size: "2", name: str(rank)}
        done = python(MAIN, "run", tmp_path / "job.toml", "--output", tmp_path / "out", **launched)
        assert done.returncode == 2 and not (tmp_path / "out").exists()
        lines = done.stderr.splitlines()
        assert len(lines) == 1 - rank and all("launched as 2 ranks, but" in line and size in line for line in lines)


def test_one_process_in_an_allocation_is_alone():
    """A process that a batch script or `salloc` starts without srun is one rank, whatever the job's number of tasks."""
    allocation = {"SLURM_NTASKS": "4", "SLURM_PROCID": "0", "SLURM_JOB_ID": "7"}
    done = python("from pgfmd.parallel.mpi import launched, world; print(launched().size, world().size)", **allocation)
    assert done.stdout == "1 1\n", done.stderr
