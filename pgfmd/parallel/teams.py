"""Communicators of some of the ranks, made once for each communicator and kept with it."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

from pgfmd.parallel.mpi import MPI


def _forget(_: MPI.Comm, __: int, kept: dict[object, MPI.Comm | None]) -> None:
    for team in kept.values():
        if team is not None:
            team.Free()


@cache
def _key() -> int:
    return MPI.Comm.Create_keyval(delete_fn=_forget)


def _once(comm: MPI.Comm, name: object, make: Callable[[], MPI.Comm | None]) -> MPI.Comm | None:
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
    node = _once(comm, "node", lambda: comm.Split_type(MPI.COMM_TYPE_SHARED))
    assert node is not None
    return node


def peers_of(comm: MPI.Comm, node: MPI.Comm) -> MPI.Comm | None:
    """The ranks that have the same place in their nodes, one of each node; None if the nodes have different numbers of
    ranks, or the ranks of a node do not follow each other.  Collective on first use.
    """

    def make() -> MPI.Comm | None:
        first = node.bcast(comm.rank)
        regular = comm.rank == first + node.rank and first % node.size == 0
        sizes = comm.allgather(node.size)
        regular = regular and min(sizes) == max(sizes)
        return None if comm.allreduce(not regular, MPI.LOR) else comm.Split(node.rank)

    return _once(comm, "peers", make)
