"""One process without MPI: the same results, and `mpirun` can still be started from it."""

import shutil

import numpy as np
import pytest
from conftest import python
from job_texts import EVERY_OBSERVABLE, rough_job

from pgfmd.application.results import Results

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
    import pgfmd

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
    import pgfmd

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
