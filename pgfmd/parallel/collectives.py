"""Slabs of rows, reductions over ranks, errors raised on all ranks together, communicators of some of the ranks."""

from __future__ import annotations

import pickle
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache, partial
from typing import Any, TypeVar
from zlib import crc32

import numpy as np
from numpy.typing import ArrayLike

from pgfmd.errors import InputError, SolverError, Uncertifiable, Unreachable
from pgfmd.parallel.mpi import MPI, patiently

T = TypeVar("T")

BUSY_WAIT = 0.05  # seconds for which a rank polls without sleeping
SLEEP = 2e-4  # seconds between polls after that; sleeps of 2 % of the time waited made barriers of 64 ranks 8 % late

FAILED = 32000  # tag of messages between ranks that have failed, below the least upper bound in the MPI standard


def slab(count: int, size: int, rank: int) -> slice:
    """The part of a rank of `count` rows over `size` ranks; the first have one more if need be, as in mpi4py-fft."""
    base, extra = divmod(count, size)
    start = rank * base + min(rank, extra)
    return slice(start, start + base + (rank < extra))


def slab_starts(count: int, size: int) -> np.ndarray:
    """First row of each rank and, last, the row count: shape (size + 1,)."""
    base, extra = divmod(count, size)
    ranks = np.arange(size + 1)
    return ranks * base + np.minimum(ranks, extra)


class Reduction:
    """Reductions over the ranks of `comm`, which all get the same result.  Each method is collective."""

    def __init__(self, comm: MPI.Comm) -> None:
        self.comm = comm

    def sum(self, local: ArrayLike) -> float:
        """Sum of all entries of `local` over all ranks.  Collective."""
        return self._one(float(np.sum(local, dtype=np.float64)), MPI.SUM)

    def max(self, local: ArrayLike) -> float:
        """Largest entry over all ranks (-inf if there is none).  Collective."""
        return self._one(float(np.max(local, initial=-np.inf)), MPI.MAX)

    def min(self, local: ArrayLike) -> float:
        """Smallest entry over all ranks (inf if there is none).  Collective."""
        return self._one(float(np.min(local, initial=np.inf)), MPI.MIN)

    def dot(self, a: np.ndarray, b: np.ndarray) -> float:
        """Σ a b over all entries and ranks, accumulated in float64.  Collective."""
        return self._one(float(np.einsum("i,i->", np.ravel(a), np.ravel(b), dtype=np.float64)), MPI.SUM)

    def sums(self, *values: float) -> np.ndarray:
        """Several local numbers summed over the ranks in one message.  Collective."""
        out = np.array(values, dtype=np.float64)
        if self.comm.size > 1:
            self.comm.Allreduce(MPI.IN_PLACE, out, MPI.SUM)
        return out

    def sums_of_blocks(self, parts: Mapping[int, ArrayLike], count: int) -> np.ndarray:
        """Sums (count,) of `count` numbers per block of rows or columns, over the blocks of all ranks.  Collective.

        parts: first row of a block → its numbers, for each block of this rank, if any.  Blocks are added in the order
        of their rows, so that the sums do not depend on the order of the threads.
        """
        blocks = np.array([parts[first] for first in sorted(parts)], dtype=np.float64)
        out = blocks.reshape(-1, count).sum(axis=0)
        if self.comm.size > 1:
            self.comm.Allreduce(MPI.IN_PLACE, out, MPI.SUM)
        return out

    def any(self, flag: bool) -> bool:
        """Whether the flag is set on at least one rank.  Collective."""
        return bool(self._one(float(flag), MPI.MAX))

    def _one(self, value: float, operation: MPI.Op) -> float:
        """A number reduced over the ranks; as a buffer, in half the time of a pickled object."""
        if self.comm.size == 1:
            return value
        out = np.array([value])
        self.comm.Allreduce(MPI.IN_PLACE, out, operation)
        return float(out[0])


def await_all(comm: MPI.Comm) -> None:
    """A barrier that sleeps between polls after `BUSY_WAIT` seconds; MPI's own keeps a core busy.  Collective."""
    request, began = comm.Ibarrier(), time.monotonic()
    while not request.Test():
        waited = time.monotonic() - began
        time.sleep(SLEEP if waited > BUSY_WAIT else 0)


@contextmanager
def raise_together(comm: MPI.Comm) -> Iterator[None]:
    """If the block fails on any rank, all ranks raise an error.  Collective at the end of the block.

    A rank that failed raises its own error, the others that of the lowest failing rank (see `_for_others`).  The block
    must not contain collective calls (a rank that failed would not reach them).
    """
    failure = None
    try:
        yield
    except Exception as error:  # any failure must reach the other ranks, which would otherwise wait for ever
        failure = error
    first = comm.allreduce(comm.size if failure is None else comm.rank, MPI.MIN)
    if first == comm.size:
        return
    reported = comm.bcast(None if failure is None else _for_others(failure, comm.rank), first)
    raise mark_shared(comm, reported if failure is None else failure)


def mark_shared(comm: MPI.Comm, error: Exception) -> Exception:
    """The error, marked as one that all ranks of `comm` raise."""
    vars(error)["ranks"] = comm.size
    return error


def shared(comm: MPI.Comm, error: BaseException) -> bool:
    """Whether all ranks of `comm` raise this error, so that they may handle it by collective calls.  If not, the caller
    must let it propagate: other ranks may be blocked in a collective call, which only an abort of the run ends.

    Errors of `raise_together` and `from_root` carry the mark of shared errors.  An InputError or SolverError without it
    may follow from numbers that all ranks have: it is shared if all ranks call this with the same text within their
    patience (`patiently`).  Any other error belongs to the rank that raises it.
    """
    ranks = vars(error).get("ranks", 1)
    if 0 < ranks < comm.size and isinstance(error, (InputError, SolverError)):
        ranks = comm.size if _all_raise(comm, f"{type(error).__name__}: {error}") else 0
        vars(error)["ranks"] = ranks  # 0: not shared; a second call does not wait again
    return comm.size == 1 or ranks >= comm.size


def _all_raise(comm: MPI.Comm, text: str) -> bool:
    """Whether all ranks call this with the same text: rank 0 compares checksums, and answers only if they agree."""
    own = crc32(text.encode())
    if comm.rank > 0:
        request = comm.isend(own, 0, FAILED)
        return patiently(comm, partial(comm.iprobe, 0, FAILED)) and (request.wait(), comm.recv(None, 0, FAILED))[1]
    for rank in range(1, comm.size):
        if not patiently(comm, partial(comm.iprobe, rank, FAILED)) or comm.recv(None, rank, FAILED) != own:
            return False
    for rank in range(1, comm.size):
        comm.send(True, rank, FAILED)
    return True


def _for_others(failure: Exception, rank: int) -> Exception:
    """What other ranks raise for a failure of `rank`: one of the types that callers distinguish, or RuntimeError."""
    for kind in (InputError, Unreachable, Uncertifiable, SolverError, OSError, MemoryError):
        if isinstance(failure, kind):
            return kind(str(failure))
    return RuntimeError(f"rank {rank}: {type(failure).__name__}: {failure}")


def from_root(comm: MPI.Comm, function: Callable[..., T], *arguments: Any) -> T:
    """Call `function(*arguments)` on rank 0; return its value, or raise its error, on every rank.  Collective.

    If the error cannot be pickled, the other ranks raise `_for_others` of it.
    """
    value: Any = None
    failure: Exception | None = None
    if comm.rank == 0:
        try:
            value = function(*arguments)
        except Exception as error:  # reaches every rank below
            failure = error
    sent = comm.bcast((value, _sendable(failure) if comm.rank == 0 else None))
    failure = sent[1] if failure is None else failure
    if failure is not None:
        raise mark_shared(comm, failure)
    return sent[0]


def _sendable(failure: Exception | None) -> Exception | None:
    """The error if it survives pickling, else `_for_others` of it."""
    try:
        pickle.loads(pickle.dumps(failure))
        return failure
    except Exception:  # a class may fail at this in any way
        assert failure is not None
        return _for_others(failure, 0)


def _forget(_: MPI.Comm, __: int, kept: dict[object, MPI.Comm | None]) -> None:
    for team in kept.values():
        if team is not None:
            team.Free()


@cache
def _key() -> int:
    return MPI.Comm.Create_keyval(delete_fn=_forget)


def _once(comm: MPI.Comm, name: object, make: Callable[[], MPI.Comm | None]) -> Any:
    """`make()`, kept as an attribute of `comm` under that name, and freed with it."""
    kept: Any = comm.Get_attr(_key())
    if kept is None:
        kept = {}
        comm.Set_attr(_key(), kept)
    if name not in kept:
        kept[name] = make()
    return kept[name]


def team_of(comm: MPI.Comm, holders: int) -> MPI.Comm | None:
    """The ranks that hold rows by `Layout.spread`, in that order; None on the others.  Collective on first use."""
    if holders == comm.size:
        return comm
    if holders == 1:
        return MPI.COMM_SELF if comm.rank == 0 else None

    def make() -> MPI.Comm | None:
        mine = -(-comm.rank * holders // comm.size)  # the first holder from this rank on
        team = comm.Split(0 if mine * comm.size // holders == comm.rank else MPI.UNDEFINED)
        return None if team == MPI.COMM_NULL else team

    return _once(comm, holders, make)


def node_of(comm: MPI.Comm) -> MPI.Comm:
    """The ranks of `comm` that share memory with this one.  Collective on first use."""
    if comm.size == 1:
        return comm
    return _once(comm, "node", lambda: comm.Split_type(MPI.COMM_TYPE_SHARED))


def node_starts(comm: MPI.Comm, node: MPI.Comm) -> np.ndarray | None:
    """First rank of each node and, last, the number of ranks; None if those of a node do not follow each other."""
    first = np.array(comm.allgather(node.bcast(comm.rank)))
    return None if np.any(np.diff(first) < 0) else np.append(np.unique(first), comm.size)


def peers_of(comm: MPI.Comm, node: MPI.Comm) -> MPI.Comm:
    """One rank of each node, in the order of nodes, which must all hold equally many: those with this one's rank in
    their `node`.  Collective on first use.
    """
    if node.size == 1:
        return comm
    return _once(comm, "peers", lambda: comm.Split(node.rank))


def by_node(comm: MPI.Intracomm) -> MPI.Intracomm:
    """The ranks of `comm` numbered node by node; rank 0 stays so.  `comm` itself if they are already.  Collective."""
    first = comm.allgather(node_of(comm).bcast(comm.rank))
    order = sorted(range(comm.size), key=lambda rank: (first[rank], rank))
    if order == list(range(comm.size)):
        return comm
    return comm.Split(0, order.index(comm.rank))  # type: ignore[return-value]
