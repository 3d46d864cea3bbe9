"""What the package uses of mpi4py's module MPI, for a process that is alone.  Messages go from rank 0 to rank 0."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any, NoReturn

import numpy as np

IN_PLACE = SUM = MAX = MIN = LOR = None


def Get_library_version() -> str:
    return "none"


class Request:
    """A communication that is complete."""

    def Test(self) -> bool:
        return True

    @staticmethod
    def Waitall(requests: Sequence[Request]) -> None:
        """Nothing to wait for."""


class Comm:
    """A communicator of one rank.  Only what needs no second rank is there."""

    rank, size = 0, 1

    def allreduce(self, value: Any, op: Any = None) -> Any:
        """The value itself: any reduction over one rank, and what rank 0 sends to all."""
        return value

    bcast = allreduce

    def allgather(self, value: Any) -> list:
        """A list of the value of each rank."""
        return [value]

    gather = allgather

    def Allreduce(self, send: Any, receive: Any, op: Any = None) -> None:
        """Copies `send`, unless the reduction is in place."""
        if isinstance(send, (np.ndarray, list, tuple)):
            _copy(send, receive)

    def Alltoall(self, send: Any, receive: Any) -> None:
        """Copies `send` to `receive`, as all exchanges of arrays do."""
        _copy(send, receive)

    Allgather = Allgatherv = Alltoallv = Gatherv = Scatterv = Alltoall

    def Sendrecv(self, send: Any, dest: int, recvbuf: Any = None, source: int = 0) -> None:
        _copy(send, recvbuf)

    def Bcast(self, array: Any, root: int = 0) -> None:
        """Nothing to send."""

    Barrier = Free = lambda self: None

    def Ibarrier(self) -> Request:
        """A barrier that all ranks have reached."""
        return Request()

    def Dup(self) -> Comm:
        return self

    def Abort(self, code: int = 0) -> NoReturn:
        os._exit(code)


COMM_SELF = COMM_WORLD = Comm()


def _copy(send: Any, receive: Any) -> None:
    """Copies one message to the first items of another; a message is an array, or a list that begins with one."""
    source, target = (np.asarray(each[0] if isinstance(each, (list, tuple)) else each) for each in (send, receive))
    target.reshape(-1)[: source.size] = source.reshape(-1)
