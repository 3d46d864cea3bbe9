"""Errors of one rank that all ranks raise."""

import pytest

from pgfmd.errors import InputError, SolverError, Uncertifiable, Unreachable
from pgfmd.parallel import collectives, mpi
from pgfmd.parallel.collectives import from_root, raise_together, shared

pytestmark = [pytest.mark.mpi, pytest.mark.uneven]


@pytest.mark.parametrize("kind", [InputError, SolverError, Uncertifiable, Unreachable, OSError, MemoryError])
def test_all_ranks_raise_the_same_kind(comm, kind):
    """An error of the last rank, or of the first, is of its own kind on all ranks, so that those who catch it go on
    together: `simulate` with the next load after Unreachable, a solver with another method unless Uncertifiable."""

    def fails():
        raise kind("no such load")

    for attempt in (lambda: comm.rank < comm.size - 1 or fails(), lambda: comm.rank > 0 or fails()):
        with pytest.raises(kind, match="no such load") as caught, raise_together(comm):
            attempt()
        assert type(caught.value) is kind
    with pytest.raises(kind, match="no such load"):
        from_root(comm, fails)


def test_an_unknown_error_names_its_rank(comm):
    """Any other error is RuntimeError on the ranks that do not have it, with the rank that has."""
    with pytest.raises(ArithmeticError if comm.rank == comm.size - 1 else RuntimeError) as caught, raise_together(comm):
        if comm.rank == comm.size - 1:
            raise ArithmeticError("lost")
    assert comm.rank == comm.size - 1 or str(caught.value) == f"rank {comm.size - 1}: ArithmeticError: lost"

    def fails():
        error = ArithmeticError("lost")
        error.reason = fails  # which is lost on the way to others
        raise error

    with pytest.raises(RuntimeError if comm.rank else ArithmeticError, match="lost"):
        from_root(comm, fails)
    assert comm.bcast("all here") == "all here"


@pytest.mark.parametrize("kind", [InputError, SolverError, OSError])
def test_errors_of_all_ranks_are_shared(comm, kind):
    """Errors of `raise_together` and `from_root` are shared; so is an InputError or SolverError of the same text."""

    def fails():
        raise kind("no such load")

    with pytest.raises(kind) as caught, raise_together(comm):
        if comm.rank == comm.size - 1:
            fails()
    assert shared(comm, caught.value)
    with pytest.raises(kind) as caught:
        from_root(comm, fails)
    assert shared(comm, caught.value)
    assert shared(comm, kind("alike")) == (kind is not OSError or comm.size == 1)


def test_an_error_of_one_rank_is_not_shared(comm, monkeypatch):
    """An error that one rank raises, or each with another text, is not shared: whoever handled it by collective calls
    would wait for ever.  Ranks without an error are not disturbed, and one that is alone waits once only."""
    if comm.size == 1:
        pytest.skip("one rank shares all of its errors")
    monkeypatch.setattr(mpi, "PATIENCE", 0.2)
    if comm.rank == comm.size - 1:
        error = SolverError("no descent")
        assert not shared(comm, error)
        monkeypatch.setattr(mpi, "PATIENCE", 1e6)
        assert not shared(comm, error)
    comm.Barrier()
    while comm.iprobe(tag=collectives.FAILED):  # what the run would have been aborted with
        comm.recv(tag=collectives.FAILED)
    comm.Barrier()
    monkeypatch.setattr(mpi, "PATIENCE", 0.2)
    assert not shared(comm, InputError(f"of rank {comm.rank}"))
    comm.Barrier()
    while comm.iprobe(tag=collectives.FAILED):
        comm.recv(tag=collectives.FAILED)
    comm.Barrier()
