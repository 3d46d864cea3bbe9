"""Errors of one rank that all ranks raise."""

from __future__ import annotations

import pytest

from pgfmd.errors import InputError, SolverError, Uncertifiable, Unreachable
from pgfmd.parallel.collectives import from_root, raise_together

pytestmark = pytest.mark.mpi


@pytest.mark.parametrize("kind", [InputError, SolverError, Uncertifiable, Unreachable, OSError, MemoryError])
def test_all_ranks_raise_the_same_kind(comm, kind):
    """An error of the last rank, or of the first, is of its own kind on all ranks, so that those who catch it go on
    together: `simulate` with the next load after Unreachable, a solver with another method unless Uncertifiable.
    """

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
