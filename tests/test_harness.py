"""The test harness itself: what fails on one rank fails on all, at once and with a message."""

import pytest
from conftest import ROOT, SIZE


@pytest.mark.mpi
def test_ranks_see_each_other(comm):
    """Every rank takes part: the ranks sum to size (size − 1) / 2."""
    assert comm.allreduce(comm.rank) == comm.size * (comm.size - 1) // 2


@pytest.mark.mpi
def test_shared_directory_is_one(comm, shared_tmp_path):
    """What rank 0 writes, every rank reads."""
    if comm.rank == 0:
        (shared_tmp_path / "note").write_text("written by rank 0")
    comm.Barrier()
    assert (shared_tmp_path / "note").read_text() == "written by rank 0"


@pytest.mark.mpi
@pytest.mark.xfail(SIZE > 1, reason="fails on the last rank, hence on all", strict=True)
def test_failure_on_one_rank_is_a_failure_on_all(comm):
    """A test that fails on the last rank only counts as failed everywhere (strict: rank 0 would report a pass)."""
    assert comm.size == 1 or comm.rank < comm.size - 1


SUITE = """
def test_lonely_failure(comm):
    assert comm.rank != 1, "rank one says no"
{barrier}

def test_next(comm):
    assert comm.allreduce(1) == comm.size
"""


def _suite(mpirun, folder, barrier: str):
    """Output and exit code of two tests on two ranks, the first of which fails on rank 1 only."""
    (folder / "conftest.py").write_text((ROOT / "tests" / "conftest.py").read_text())
    (folder / "test_it.py").write_text(SUITE.format(barrier=barrier))
    done = mpirun(2, "-m", "pytest", "--patience", "3", "--color", "no", "--rootdir", folder, folder)
    return done.stdout + done.stderr, done.returncode


def test_suite_goes_on_after_a_failure(mpirun, tmp_path):
    """The failing rank's message appears on both ranks, and the next test runs in step."""
    output, code = _suite(mpirun, tmp_path, barrier="")
    assert code != 0
    assert output.count("failed on ranks [1]; on rank 1:") >= 1
    assert "rank one says no" in output
    assert output.count("1 failed, 1 passed") == 2


@pytest.mark.breadth
def test_hang_ends_with_a_message(mpirun, tmp_path):
    """Where one rank fails before a communication, the run ends when its patience (3 s) does, with a message."""
    output, code = _suite(mpirun, tmp_path, barrier="    comm.Barrier()")
    assert code != 0
    assert "failed on rank 1 alone" in output
    assert "rank one says no" in output
