"""Tests that run alike on one rank and under mpirun, and end alike on all ranks.

Under mpirun every rank runs the same tests in the same order.  After each step of a test the ranks compare notes: if
it failed on one, it fails on all, with that rank's traceback, and the suite goes on in step.  A rank whose test failed
waits --patience seconds for the others; if they hang in a communication that it left, it says so and ends the run.
"""

import hashlib
import logging
import os
import shutil
import subprocess
import sys
import time
import warnings
from pathlib import Path

import pytest

from pgfmd.parallel.mpi import world

ROOT = Path(__file__).resolve().parent.parent
sys.path += [str(ROOT / "tools" / folder) for folder in ("plots", "paper", "bench", "docs")]  # for tests of tools

WORLD = world()  # this process alone where there is no MPI
SIZE = WORLD.size
CANNOT_LAUNCH = SIZE > 1 or shutil.which("mpirun") is None
if SIZE == 1:  # MPI, once initialised, adds variables to the environment of children, which confuse another mpirun
    inherited = subprocess.run(["env", "-0"], capture_output=True, text=True, check=True).stdout.split("\0")
    for variable in {line.partition("=")[0] for line in inherited if line} - os.environ.keys():
        os.unsetenv(variable)
starts_mpirun = pytest.mark.skipif(CANNOT_LAUNCH, reason="needs mpirun, and not to be under it")


def pytest_addoption(parser):
    parser.addoption("--all", action="store_true", help="also run tests marked `breadth`")
    parser.addoption("--long", action="store_true", help="also run the thorough versions of tests, which take hours")
    parser.addoption("--patience", type=float, default=60.0, help="seconds that a failed rank waits for the others")


def pytest_configure(config):
    try:
        import hypothesis
    except ImportError:
        return
    # No deadline on a noisy machine; the same examples on every rank.
    hypothesis.settings.register_profile("pgfmd", deadline=None, derandomize=True, database=None)
    hypothesis.settings.load_profile("pgfmd")


def pytest_collection_modifyitems(config, items):
    """Leave out what only `--all` or `--long` runs."""
    left_out = [mark for mark, option in (("breadth", "--all"), ("long", "--long")) if not config.getoption(option)]
    chosen, others = [], []
    for item in items:
        mpi = item.get_closest_marker("mpi")
        alone = SIZE > 1 and mpi is not None and "breadth" in mpi.args and not config.getoption("--all")
        # The mark of a whole module means its tests of a communicator: the others would only be repeated.
        own = any(mark.name == "mpi" for mark in item.own_markers) or hasattr(item.module, "comm")  # of test_inner.py
        alone |= SIZE > 1 and not own and not {"comm", "shared_tmp_path"} & set(item.fixturenames)
        (others if alone or any(map(item.get_closest_marker, left_out)) else chosen).append(item)
    config.hook.pytest_deselected(items=others)
    items[:] = chosen


def broad(values, default: int = 1) -> list:
    """Values to parametrise with: the first `default` of them run by default, the others with `--all`."""
    values = [value if isinstance(value, tuple) else (value,) for value in values]
    return [pytest.param(*value, marks=pytest.mark.breadth if i >= default else ()) for i, value in enumerate(values)]


@pytest.fixture(autouse=True, scope="module")
def log_of_before():
    """A command that runs in this process opens the log, for all that follows: that is taken back after the module."""
    log, show = logging.getLogger("pgfmd"), warnings.showwarning
    before = log.handlers[:], log.level, log.propagate
    yield
    log.handlers[:], log.level, log.propagate = before
    log.setLevel(log.level)  # which forgets what was cached
    warnings.showwarning = show


@pytest.fixture(scope="session")
def comm():
    """All ranks of this run; apart from the communicator on which the tests' outcomes are exchanged."""
    copy = WORLD.Dup()
    yield copy
    copy.Free()


@pytest.fixture
def shared_tmp_path(tmp_path) -> Path:
    """An empty directory, the same on all ranks."""
    return tmp_path if SIZE == 1 else WORLD.bcast(tmp_path)


def whole(grid, field):
    """The complete field on every rank.  Collective."""
    return grid.fetch(field, 0, grid.shape[0])


def contents(folder: Path) -> dict[Path, bytes]:
    """Every file below a folder, by its path."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def python(code: str, *arguments: object, **environment: str) -> subprocess.CompletedProcess:
    """What a fresh interpreter makes of `code`, in the folder of this checkout."""
    command = [sys.executable, "-c", code, *map(str, arguments)]
    kept = {"cwd": ROOT, "env": os.environ | environment, "capture_output": True, "text": True}
    return subprocess.run(command, timeout=900, check=False, **kept)


def once(comm, action, *arguments, **keywords) -> None:
    """Rank 0 calls action(*arguments, **keywords), after all ranks have come and before any goes on.  Collective."""
    comm.Barrier()
    if comm.rank == 0:
        action(*arguments, **keywords)
    comm.Barrier()


def saved(comm, path: Path, write) -> Path:
    """The path of a file that rank 0 has made by write(path).  Collective."""
    once(comm, write, path)
    return path


def apart(grid, one, two) -> float:
    """‖one − two‖/‖two‖ of the pressures of two contacts.  Collective."""
    difference = one.pressure - two.pressure
    return (grid.reduction.dot(difference, difference) / grid.reduction.dot(two.pressure, two.pressure)) ** 0.5


@pytest.fixture
def mpirun():
    """mpirun(ranks, *arguments, timeout=300): `python -m mpi4py *arguments` on that many ranks, for tests run serially.

    Returns the subprocess.CompletedProcess with its output as text.  Raises subprocess.TimeoutExpired.
    """
    if CANNOT_LAUNCH:
        pytest.skip("needs mpirun, and not to be under it")

    def run(ranks: int, *arguments, timeout: float = 300, **keywords) -> subprocess.CompletedProcess:
        command = [str(ROOT / "tests" / "mpirun.sh"), str(ranks), sys.executable, *map(str, arguments)]
        # A copy of the environment as it was: MPI, once initialised here, adds variables that confuse another mpirun.
        keywords = {"env": dict(os.environ), "stdin": subprocess.DEVNULL, "cwd": ROOT} | keywords
        return subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False, **keywords)

    return run


# ---- one outcome for all ranks --------------------------------------------------------------------------------------


def _together(name: str, failure: BaseException | None, patience: float) -> None:
    """Raise on all ranks if a step of test `name` failed or was skipped on some rank.  Collective."""
    skipped = isinstance(failure, pytest.skip.Exception)
    mine = bytearray([0 if failure is None else 1 if skipped else 2])
    states = bytearray(SIZE)
    request = WORLD.Iallgather(mine, states)  # not blocking, so that a failed rank need not wait for ever
    deadline = time.monotonic() + patience
    while not request.Test():
        if mine[0] == 2 and time.monotonic() > deadline:
            _give_up(name, failure)
        time.sleep(1e-4)
    worst = max(states)
    if worst == 0:
        return
    texts = WORLD.allgather("" if failure is None else _text(failure))
    if mine[0] == 2 or min(states) == 1 == worst:
        raise failure
    ranks = [rank for rank in range(SIZE) if states[rank] == worst]
    what = "failed" if worst == 2 else "was skipped"
    pytest.fail(f"{what} on ranks {ranks}; on rank {ranks[0]}:\n{texts[ranks[0]]}", pytrace=False)


def _text(failure: BaseException) -> str:
    return str(pytest.ExceptionInfo.from_exception(failure).getrepr(style="short"))


def _give_up(name: str, failure: BaseException) -> None:
    """End all ranks: this one failed, and the others did not come within the time allowed."""
    os.write(2, f"\n{name} failed on rank {WORLD.rank} alone, and the others hang:\n{_text(failure)}\n".encode())
    sys.stderr.flush()
    WORLD.Abort(1)


def _collective(item):
    """A hook around one step of a test: what happened on any rank happens on all."""
    failure = result = None
    try:
        result = yield
    except (KeyboardInterrupt, pytest.exit.Exception):
        raise
    except BaseException as error:  # skips and failures are no Exceptions
        failure = error
    if SIZE > 1:
        _together(item.nodeid, failure, item.config.getoption("--patience"))
    elif failure is not None:
        raise failure
    return result


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_setup(item):
    return (yield from _collective(item))


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_call(item):
    return (yield from _collective(item))


@pytest.hookimpl(trylast=True)
def pytest_collection_finish(session):
    """The ranks must have found the same tests."""
    if SIZE == 1:
        return
    names = "\n".join(item.nodeid for item in session.items)
    if len(set(WORLD.allgather(hashlib.sha256(names.encode()).hexdigest()))) > 1:
        pytest.exit("the ranks found different tests", returncode=3)


def pytest_unconfigure():
    """Leave together: mpirun kills the ranks still at their report when the first one ends with an error."""
    if SIZE > 1:
        WORLD.Barrier()
