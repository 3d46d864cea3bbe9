"""Disks that fill up, folders that vanish, ranks that fail: a clear error soon, and what was complete stays good."""

import os
import subprocess
import time
from contextlib import contextmanager, nullcontext

import launching
import pytest
from conftest import broad, starts_mpirun
from job_texts import rough_job

from pgfmd.application.results import Results

pytestmark = starts_mpirun

LOADS = [5e-4, 1e-3, 2e-3, 4e-3]
FAULTY = """
import sys
from pgfmd.application import cli
from pgfmd.parallel import mpi
mpi.PATIENCE = 2.0
from mpi4py import MPI
{fault}
sys.exit(cli.main())
"""
FAILS_AT_CALL = """
import pgfmd.{module}
owner, calls = pgfmd.{owner}, []
original = owner.{name}
def failing(*arguments):
    calls.append(1)
    if MPI.COMM_WORLD.rank == 1 and len(calls) == {call}:
        raise {error}
    return original(*arguments)
owner.{name} = failing
"""


def fails_at_call(call, module, function, error="ArithmeticError('the last straw')"):
    """Code by which that call of a function of a module, or of a method, fails on rank 1."""
    owner, _, name = f"{module}.{function}".rpartition(".")
    return FAILS_AT_CALL.format(call=call, module=module, owner=owner, name=name, error=error)


FAULTS = {  # where a rank fails alone; in the output it is rank 0, since no other makes files
    "in a thread": fails_at_call(9, "solvers.active_set.active_set", "contact_sums"),
    "in a transform": fails_at_call(60, "grid.transpose", "SharedStrips.put"),
    "in a checkpoint": fails_at_call(9, "application.hdf5_slabs", "Field.block"),
    "in the output": """
from pgfmd.application import files
original = files.reserve
def failing(path, size):
    if "load_0001" in path.name:
        raise PermissionError(13, "the last straw")
    return original(path, size)
files.reserve = failing
""",
}


def run_with(fault, job, folder, ranks, timeout, **environment):
    """Exit code and stderr of a run of a job in that folder, with that code before it; fails if it hangs."""
    script = folder / "faulty.py"
    script.write_text(FAULTY.format(fault=fault))
    options = {"script": (script,), "environment": environment}
    return launching.wait(launching.start(ranks, "run", job, "--output", folder / "out", **options), timeout)


@pytest.mark.parametrize("where", broad(FAULTS))
def test_failure_on_one_rank_ends_all(tmp_path, where):
    """An exception on one rank, wherever it is, ends both with its message and an exit code."""
    job = launching.write_job(tmp_path / "job.toml", 64, lambda_s=8, pressures=LOADS)
    code, stderr = run_with(FAULTS[where], job, tmp_path, 2, 180, OMP_NUM_THREADS="2")
    assert code not in (0, 75) and "pgfmd: error:" in stderr and "the last straw" in stderr
    for _ in range(300):  # the launcher may end before the last rank, which holds the folder
        if Results(tmp_path / "out").status != "running":
            break
        time.sleep(0.1)
    assert Results(tmp_path / "out").status in ("failed", "interrupted")


GROUPS = """
import types
from pgfmd.errors import InputError, SolverError
from pgfmd.application import ensemble_run
ensemble_run.Plan = lambda _: types.SimpleNamespace(rank_groups=lambda *_: {})
"""


@pytest.mark.breadth
@pytest.mark.parametrize(("kind", "ranks"), [("OSError", 4), ("InputError", 2), ("SolverError", 4)])
def test_failure_on_one_rank_of_a_group_ends_an_ensemble(tmp_path, kind, ranks):
    """A rank fails while another of its group waits for it in the solver: whatever the error, the run ends, with one
    message.  It is not a seed that failed, since the group cannot go on to the next."""
    fault = fails_at_call(60, "grid.transpose", "SharedStrips.put", f"{kind}('the last straw')")
    surface = {"lambda_s": 8.0, "rms_slope": 0.03, "seed": [1, 2, 3]}
    (tmp_path / "job.toml").write_text(rough_job(64, surface, load={"pressure": LOADS}))
    code, stderr = run_with(GROUPS.format(ranks // 2) + fault, tmp_path / "job.toml", tmp_path, ranks, 120)
    assert code not in (0, 75) and sum(line.startswith("pgfmd: ") for line in stderr.splitlines()) == 1, stderr
    assert "the last straw" in stderr


FAULTY_SOLVE = """
import numpy as np, pgfmd
from mpi4py.MPI import COMM_WORLD as comm
from pgfmd.grid.transforms import Transform
original = Transform.rows_forward
def failing(self, *arguments):
    if comm.rank == 1:
        raise MemoryError("the last straw")
    original(self, *arguments)
Transform.rows_forward = failing
heights = np.cos(2 * np.pi * np.arange(320) / 320)[:, None] + np.zeros(320)
pgfmd.solve(np.split(heights, 2)[comm.rank], 0.1, comm=comm)
"""


FAULTY_SEARCH = """
import numpy as np, pgfmd
from mpi4py.MPI import COMM_WORLD as comm
from pgfmd.solvers.load_control import LoadControl
original = LoadControl.solution
def failing(self, target):
    if comm.rank == 1 and self.grid.shape[0] == 300:
        raise pgfmd.SolverError("the last straw")
    return original(self, target)
LoadControl.solution = failing
x = np.arange(600) - 299.5
heights = -(x[:, None] ** 2 + x**2) / 4000
pgfmd.solve(np.split(heights, 2)[comm.rank], mean_gap=3.0, boundary="open", comm=comm)
"""  # the first guess of a mean gap is from half as many points each way


@pytest.mark.parametrize("script", broad([FAULTY_SOLVE, FAULTY_SEARCH]), ids=["a solution", "coarse grid of a search"])
def test_failure_on_one_rank_ends_a_script(mpirun, tmp_path, script):
    """An exception of one rank in `pgfmd.solve` does not wait for the others: `python -m mpi4py` ends them all."""
    (tmp_path / "script.py").write_text(script)
    run = mpirun(2, tmp_path / "script.py", timeout=120)
    assert run.returncode != 0 and "the last straw" in run.stderr


@pytest.mark.breadth
def test_lost_folder(tmp_path):
    """The output folder is removed during the run: an error that names it, no hang."""
    job = launching.write_job(tmp_path / "job.toml", 64, lambda_s=8, pressures=[1e-3 + 1e-6 * n for n in range(1000)])
    folder = tmp_path / "out"
    run = launching.start(2, "run", job, "--output", folder)
    while not (folder / "fields" / "load_0001.h5").exists():
        assert run.poll() is None
        time.sleep(0.1)
    os.rename(folder, tmp_path / "elsewhere")
    code, stderr = launching.wait(run, 60)
    assert code == 1 and str(folder) in stderr and "Traceback" not in stderr


@contextmanager
def small_disk(path, size: int):
    """A file system of that many bytes."""
    path.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(path)]
    if os.geteuid() != 0 or subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("needs the right to mount a file system")
    try:
        yield path
    finally:
        subprocess.run(["umount", "-l", str(path)], check=True)


def fill_disks(tmp_path, n: int, times: int, ranks: int):
    """Runs on small disks that something else fills at random moments; then space is made, and they go on."""
    chance = launching.by_chance()
    job = launching.write_job(tmp_path / "job.toml", n, lambda_s=n / 64, pressures=LOADS, interval=0.2)
    run = launching.start(ranks, "run", job, "--output", tmp_path / "reference")
    began = launching.wait_for_folder(run, tmp_path / "reference")
    code, stderr = launching.wait(run, 900)
    assert code == 0, stderr
    length, done = time.monotonic() - began, 0
    while done < times:
        with small_disk(tmp_path / f"disk {done} {time.time_ns()}", 12 * 8 * n * n) as disk:
            run = launching.start(ranks, "run", job, "--output", disk / "out")
            launching.wait_for_folder(run, disk / "out")
            time.sleep(chance.uniform(0, 0.8 * length))
            subprocess.run(["dd", "if=/dev/zero", f"of={disk}/filler", "bs=4k"], capture_output=True, check=False)
            code, stderr = launching.wait(run, 300)
            if code == 0:  # it needed no more space
                continue
            done += 1
            said = [line for line in stderr.splitlines() if line.startswith("pgfmd: error:")]
            assert code == 1 and len(said) == 1 and "Traceback" not in stderr, stderr
            assert f"'{disk}/out" in said[0]
            there, found = launching.distance(disk / "out", tmp_path / "reference", complete=False)
            assert found < 1e-10
            saved = (disk / "out" / "fields" / "checkpoint.h5").exists()
            (disk / "filler").unlink()
            stderr = launching.run_to_end(1, "run", job, "--output", disk / "out", "--restart")
            assert not saved or f"load {there + 1} continues from its checkpoint" in stderr
            _, found = launching.distance(disk / "out", tmp_path / "reference")
            print(f"full {done:2}: {there} loads{' + checkpoint' * saved}; then {found:.0e}; {said[0]}", flush=True)
            assert found < 1e-10


@pytest.mark.breadth
def test_full_disk(tmp_path):
    """A disk that fills up: one line, the last checkpoint good, and the run goes on once there is space."""
    fill_disks(tmp_path, 128, 1, 2)


@pytest.mark.long
def test_full_disks(tmp_path):
    """The same ten times, at 512²."""
    fill_disks(tmp_path, 512, 10, 2)


@pytest.mark.breadth
@pytest.mark.parametrize("cause", ["none", "small"])
def test_without_shared_memory(tmp_path, cause):
    """Without shared windows, or space for them, ranks exchange messages, which one line says: the same pressures."""
    job = launching.write_job(tmp_path / "job.toml", 64, lambda_s=8, pressures=LOADS[:1])
    launching.run_to_end(1, "run", job, "--output", tmp_path / "one")
    with small_disk(tmp_path / "disk", 2**14) if cause == "small" else nullcontext() as disk:
        name = "OMPI_MCA_osc" + "_sm_backing_directory" * (cause == "small")
        environment = {name: "^sm" if disk is None else str(disk)}
        stderr = launching.run_to_end(3, "run", job, "--output", tmp_path / "out", timeout=120, environment=environment)
        assert stderr.count("all exchange messages") == 1, stderr
    assert launching.distance(tmp_path / "out", tmp_path / "one")[1] < 1e-10


@pytest.mark.breadth
@pytest.mark.parametrize("what", ["folder", "file"])
def test_read_only(tmp_path, what):
    """A file system that is read-only is refused before anything is computed; a file that turns so, as it is met."""
    job = launching.write_job(tmp_path / "job.toml", 64, lambda_s=8, pressures=LOADS)
    with small_disk(tmp_path / "disk", 2**24) as disk:
        if what == "file":
            launching.run_to_end(1, "run", job, "--output", disk / "out", timeout=120)
            before = {path: path.read_bytes() for path in disk.rglob("*.h5")}
        subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
        code, stderr = launching.wait(launching.start(2, "run", job, "--output", disk / "out", "--overwrite"), 120)
        assert code == 2 and "Read-only file system" in stderr and "Traceback" not in stderr
        if what == "file":
            assert all(path.read_bytes() == content for path, content in before.items())
            assert Results(disk / "out").status == "complete"


@pytest.mark.breadth
def test_an_interrupt_of_one_rank_does_not_wait_for_the_others(tmp_path):
    """A KeyboardInterrupt on one rank belongs to it alone: a file that both write must not be closed together."""
    fault = """
from pgfmd.application import hdf5_slabs
def failing(self, rows):
    raise KeyboardInterrupt("the last straw")
if MPI.COMM_WORLD.rank == 1:
    hdf5_slabs.Field.block = failing
"""
    job = launching.write_job(tmp_path / "job.toml", 64, lambda_s=8, pressures=LOADS[:1])
    code, stderr = run_with(fault, job, tmp_path, 2, 60)
    assert code == 130 and "Traceback" not in stderr, stderr
