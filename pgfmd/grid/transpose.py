"""The distributed transpose between transforms along rows and transforms along columns.

Before it each rank holds whole rows, after it whole columns: its *strip*, the columns ky of this rank for all nx rows.
Ranks of one node write into each other's strips, which lie in shared memory (`SharedStrips`).  With several nodes, one
strip in shared memory serves all ranks of a node, and each rank sends its rows to one rank of every other node: as many
messages per rank as there are nodes (`ExchangedStrips`).  Nodes may hold different numbers of ranks.

A strip is an array of shape (tiles, rows, columns of a tile); the last tile need not be full.  In shared memory a tile
has a few columns, so that passes along rows and along columns both read and write long contiguous pieces of memory.  An
exchanged strip is one tile.
"""

from __future__ import annotations

import logging
import math
import mmap
from abc import ABC, abstractmethod
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from pgfmd.grid import kernels
from pgfmd.grid.aligned import ALIGNMENT, aligned_bytes, row_stride
from pgfmd.parallel.collectives import node_of, node_starts, peers_of, slab_starts
from pgfmd.parallel.mpi import MPI, datatype, shared_memory, world

TILE = 256  # bytes of a row in one tile: more favours the passes along rows, less those along columns
WIDE = 16 * ALIGNMENT  # bytes of a row from which it is padded: padding is then a small part
WORD = np.dtype(np.int64)  # type of copies, whatever the numbers are
TAG = 1  # of messages between nodes that are not alike; all other messages from rank to rank have 0
log = logging.getLogger("pgfmd")
Counts = tuple[np.ndarray, np.ndarray]
"""Blocks of each rank's part of a buffer, and where the parts begin."""
Ends = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Any]
"""Ranks, a buffer, blocks of each rank's part, where the parts begin, and the datatype of a block."""


class Parts(NamedTuple):
    """Where rows go, in words of eight bytes, so that one loop serves both precisions.  For each (first, stop, offset,
    width) of the `table`: words first … stop−1 of a row go to tiles of (height, width) words of `flat`, from offset on.
    """

    flat: np.ndarray
    table: np.ndarray
    height: int


class NoSharedMemory(Exception):
    """Ranks of a node cannot share memory, or not so much; the message says why."""


class Strips(ABC):
    """The strips of all ranks: the largest array of a transform, shared by the transforms of both precisions.

    `put` moves blocks of transformed rows in, `to_columns` completes the transpose; `to_rows` and `get` undo it.
    """

    first_row = 0  # where the rows of this rank begin in the tiles of `parts`
    first_column = 0  # where the columns of this rank begin in its `strip`
    node: MPI.Comm  # the ranks that use one piece of memory

    def __init__(self, comm: MPI.Comm, shape: tuple[int, int]) -> None:
        self.comm, self.nx = comm, shape[0]
        self.row_starts = slab_starts(shape[0], comm.size)
        self.column_starts = slab_starts(shape[1] // 2 + 1, comm.size)
        self.rows = int(self.row_starts[comm.rank + 1] - self.row_starts[comm.rank])
        self.width = int(self.column_starts[comm.rank + 1] - self.column_starts[comm.rank])
        self.window: MPI.Win | None = None

    def _allocate(self, node: MPI.Comm, count: int, any_shared: bool) -> None:
        """Allocate `count` bytes, shared with the node.  any_shared: whether some node has several ranks; then all take
        part, as checks are collective.  Collective.

        Sets flat: the memory of all its ranks, and begins: where that of each rank begins in it, on a cache line.
        Raises NoSharedMemory on all ranks if those of some node cannot share so much.
        """
        self.node = node
        if not any_shared:
            self.flat, self.begins = aligned_bytes(count), np.zeros(1, np.int64)
            return
        # Asked before: where the memory does not suffice, some libraries fail on one rank, and the others wait for it.
        folder, free = shared_memory()
        if self.comm.allreduce(node.allreduce(count + ALIGNMENT) > free, MPI.LOR):
            raise NoSharedMemory(f"{folder} is too small")
        failure = ""
        try:
            self.window = MPI.Win.Allocate_shared(count + ALIGNMENT, 1, comm=MPI.Intracomm(node))
        except MPI.Exception as error:
            failure = str(error)
        if reason := max(self.comm.allgather(failure)):
            if self.window is not None:
                self.window.Free()
            raise NoSharedMemory(reason)
        window: Any = self.window
        window.Lock_all(MPI.MODE_NOCHECK)
        buffers = [window.Shared_query(rank)[0] for rank in range(node.size)]
        spans = np.array([(buffer.address, buffer.address + buffer.nbytes) for buffer in buffers])
        first = -(-int(spans.min()) // ALIGNMENT) * ALIGNMENT
        self.flat = np.asarray(type(buffers[0]).fromaddress(first, int(spans.max() - first))).view(np.uint8)
        self.begins = -(-spans[:, 0] // ALIGNMENT) * ALIGNMENT - first

    def put(self, parts: Parts, first: int, half: np.ndarray) -> None:
        """Copy the row-transformed rows `half`, the first of which is local row `first`, into their parts."""
        kernels.rows_and_tiles(half.view(WORD), self.first_row + first, *parts, False)

    def get(self, parts: Parts, first: int, half: np.ndarray) -> None:
        """Copy the rows `half`, the first of which is local row `first`, out of their parts."""
        kernels.rows_and_tiles(half.view(WORD), self.first_row + first, *parts, True)

    @abstractmethod
    def parts(self, dtype: np.dtype) -> Parts:
        """Where the parts of this rank's rows, of complex `dtype`, go."""

    @abstractmethod
    def strip(self, dtype: np.dtype) -> np.ndarray:
        """The strip of this rank, as complex `dtype`."""

    def meet(self) -> None:
        """Wait until all ranks of the node have written, and make their writes visible.  Collective."""
        if self.window is not None:
            self.window.Sync()
            self.node.Barrier()
            self.window.Sync()

    begin = meet
    """Wait until the strips may be overwritten.  Collective."""

    @abstractmethod
    def to_columns(self, dtype: np.dtype) -> None:
        """Rows that were `put` become columns of the strips.  Collective."""

    @abstractmethod
    def to_rows(self, dtype: np.dtype) -> None:
        """Columns of the strips become rows to `get`.  Collective."""

    def free(self) -> None:
        """Give the memory back.  Collective."""
        self.flat = np.empty(0, np.uint8)
        if self.window is not None:
            self.window.Unlock_all()
            self.window.Free()
            self.window = None


class SharedStrips(Strips):
    """Strips in memory that all ranks see: those of one node, or one rank alone.  Stores and loads do the transpose."""

    def __init__(self, comm: MPI.Comm, shape: tuple[int, int]) -> None:
        super().__init__(comm, shape)
        self.first_row = int(self.row_starts[comm.rank])
        self._allocate(comm, math.prod(self._tiles(16)) * 16, comm.size > 1)
        self._touched = np.zeros(comm.size, np.int64)  # tiles of each strip

    def _tiles(self, itemsize: int) -> tuple[int, int, int]:
        """Shape of this rank's strip.  It has one row more than nx, so that tiles start on different cache sets."""
        columns = TILE // itemsize
        return -(-self.width // columns), self.nx + 1, columns

    def parts(self, dtype: np.dtype) -> Parts:
        """The strips of all ranks."""
        first, stop = self.column_starts[:-1], self.column_starts[1:]
        columns = np.full_like(first, TILE // dtype.itemsize)
        self._touch(-(-(stop - first) // columns))
        table = np.stack([first, stop, self.begins // dtype.itemsize, columns], axis=1)
        return Parts(_items(self.flat, WORD), table * (dtype.itemsize // WORD.itemsize), self.nx + 1)

    def _touch(self, counts: np.ndarray) -> None:
        """Writes 0 to each page of this rank's rows in the first `counts` tiles of each strip, once, before their use.
        Around a page that is read first, Linux maps up to 16, which count: half as many again at 4096² on 16 ranks.
        """
        if self.comm.size == 1:
            return
        height, rows = (self.nx + 1) * TILE, self.rows * TILE
        each = [
            begin + np.arange(*known) * height for begin, *known in zip(self.begins, self._touched, counts, strict=True)
        ]
        pages = np.append(np.arange(0, rows, mmap.PAGESIZE), rows - 1)
        self.flat[np.add.outer(np.concatenate(each) + self.first_row * TILE, pages)] = 0
        self._touched = np.maximum(self._touched, counts)

    def strip(self, dtype: np.dtype) -> np.ndarray:
        """The strip of this rank."""
        shape = self._tiles(dtype.itemsize)
        return _items(self.flat[self.begins[self.comm.rank] :], dtype)[: math.prod(shape)].reshape(shape)

    def to_columns(self, dtype: np.dtype) -> None:
        """Waits only: `put` has written to the strips.  Collective."""
        self.meet()

    to_rows = to_columns


class ExchangedStrips(Strips):
    """One strip for all ranks of a node, in memory that they share.  Rows are packed for each other node and sent to
    one rank there: in one `Alltoallv` where all nodes have as many ranks, else in messages from rank to rank.
    """

    def __init__(self, comm: MPI.Comm, shape: tuple[int, int], node: MPI.Comm, starts: np.ndarray) -> None:
        """node: ranks that share memory, consecutive in `comm`; starts: first rank of each node, then `comm.size`."""
        super().__init__(comm, shape)
        sizes = np.diff(starts)
        self.node_number = int(np.searchsorted(starts, comm.rank, side="right")) - 1
        here = slice(*starts[self.node_number : self.node_number + 2])
        place = np.arange(comm.size) - np.repeat(starts[:-1], sizes)  # of each rank in its node
        self._targets = starts[:-1] + node.rank % sizes
        senders = place % node.size == node.rank
        senders[here] = False
        senders[comm.rank] = True  # sends nothing: `put` writes rows for its own node straight into the strip
        self._senders = np.flatnonzero(senders)
        self.peers = peers_of(comm, node) if sizes.min() == sizes.max() else None
        self.node_starts = self.column_starts[starts]
        self.first_column = int(self.column_starts[comm.rank] - self.node_starts[self.node_number])
        self._strides = {kind: self._stride(kind) for kind in (8, 16)}  # of each node's strip: items from row to row
        self._blocks = {kind: int(np.gcd.reduce(strides)) for kind, strides in self._strides.items()}
        counts = [[counts * kind for counts in self._sizes(kind)] for kind in (8, 16)]
        strip, packed = (max(each) for each in zip(*counts, strict=True))
        self._packed = strip + node.rank * packed  # bytes before this rank's packed rows
        self._allocate(node, strip + node.size * packed if node.rank == 0 else 0, sizes.max() > 1)

    def _stride(self, itemsize: int) -> np.ndarray:
        widths = np.diff(self.node_starts)
        return np.where(widths * itemsize >= WIDE, row_stride(widths, itemsize), widths)

    def _sizes(self, itemsize: int) -> tuple[int, int]:
        """Items of the strip of this node, and of the packed rows of one rank (those with most rows)."""
        strides, lines = self._strides[itemsize], ALIGNMENT // itemsize
        most = int(np.diff(self.row_starts).max())
        counts = self.nx * int(strides[self.node_number]), most * int(strides.sum() - strides[self.node_number])
        return -(-counts[0] // lines) * lines, -(-counts[1] // lines) * lines

    def _layout(self, itemsize: int) -> tuple[Counts, Counts]:
        """The parts of this rank's packed rows, one for each node, and of the strip, one for the rows of each sender.

        Counted in blocks of items, the largest of which all strides are multiples, from the first packed row and from
        the begin of the strip: MPI libraries take no count and no displacement above 2³¹ − 1.
        """
        strides = self._strides[itemsize] // self._blocks[itemsize]
        rows, first = np.diff(self.row_starts)[self._senders], self.row_starts[self._senders]
        packed, strip = self.rows * strides, rows * strides[self.node_number]
        packed[self.node_number] = strip[self._senders == self.comm.rank] = 0
        return (packed, np.cumsum(packed) - packed), (strip, first * strides[self.node_number])

    def parts(self, dtype: np.dtype) -> Parts:
        """The packed rows for the other nodes, and this rank's rows of the strip."""
        strides, packed = self._strides[dtype.itemsize], self._layout(dtype.itemsize)[0]
        offsets = self._packed // dtype.itemsize + packed[1] * self._blocks[dtype.itemsize]
        offsets[self.node_number] = self.row_starts[self.comm.rank] * strides[self.node_number]
        table = np.stack([self.node_starts[:-1], self.node_starts[1:], offsets, np.maximum(strides, 1)], axis=1)
        return Parts(_items(self.flat, WORD), table * (dtype.itemsize // WORD.itemsize), self.rows)

    def strip(self, dtype: np.dtype) -> np.ndarray:
        """The strip of this node."""
        stride = int(self._strides[dtype.itemsize][self.node_number])
        return _items(self.flat, dtype)[: self.nx * stride].reshape(1, self.nx, stride)

    def to_columns(self, dtype: np.dtype) -> None:
        """Packed rows to strips.  Collective."""
        self._exchange(dtype, False)
        self.meet()

    def to_rows(self, dtype: np.dtype) -> None:
        """Strips to packed rows.  Collective."""
        self.meet()
        self._exchange(dtype, True)

    def _exchange(self, dtype: np.dtype, back: bool) -> None:
        """Send packed rows to strips, or back.  Collective."""
        (packed, strip), block = self._layout(dtype.itemsize), datatype(dtype, self._blocks[dtype.itemsize])
        messages = [self.flat[self._packed :], *packed, block], [self.flat, *strip, block]
        if self.peers is None:
            ends = (self._targets, *messages[0]), (self._senders, *messages[1])
            sent, received = reversed(ends) if back else ends
            self._send(sent, received, dtype.itemsize * self._blocks[dtype.itemsize])
        elif self.peers.size > 1:
            self.peers.Alltoallv(*(reversed(messages) if back else messages))

    def _send(self, sent: Ends, received: Ends, size: int) -> None:
        """Messages of blocks of `size` bytes from rank to rank, all at once.  Collective."""
        requests = []
        for start, (ranks, flat, counts, begins, block) in ((self.comm.Irecv, received), (self.comm.Isend, sent)):
            for rank, count, begin in zip(ranks.tolist(), counts.tolist(), begins.tolist(), strict=True):
                if count:
                    part = flat[begin * size : (begin + count) * size]
                    requests.append(start([part, count, block], rank, TAG))
        MPI.Request.Waitall(requests)


def _items(raw: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """The bytes `raw` as whole items."""
    return raw[: len(raw) // dtype.itemsize * dtype.itemsize].view(dtype)


def make_strips(comm: MPI.Comm, shape: tuple[int, int], shared: bool = True) -> SharedStrips | ExchangedStrips:
    """Shared strips where all ranks of `comm` are on one node, else exchanged ones.  Collective.

    shared: if False, no memory is shared; each rank is a node of its own.
    """
    single = np.arange(comm.size + 1)
    if not shared:
        return ExchangedStrips(comm, shape, MPI.COMM_SELF, single)
    node = node_of(comm)
    logs = comm.rank == 0 and comm.size == world().size  # coarser grids have fewer ranks
    try:
        if node.size == comm.size:
            return SharedStrips(comm, shape)
        if (starts := node_starts(comm, node)) is not None:
            strips, sizes = ExchangedStrips(comm, shape, node, starts), np.diff(starts)
            if logs:
                _log_nodes(len(sizes), int(sizes.min()), int(sizes.max()))
            return strips
        reason = "ranks are not numbered node by node"
    except NoSharedMemory as failure:
        reason, logs = str(failure), comm.rank == 0
    if logs:
        _warn(reason)
    return ExchangedStrips(comm, shape, MPI.COMM_SELF, single)


@cache
def _log_nodes(count: int, least: int, most: int) -> None:
    """A line in the log, once in a process."""
    sizes = f"{least} to {most} ranks" if least < most else f"{most} rank{'s' * (most > 1)}"
    log.info("%d nodes of %s exchange messages; ranks of one node share memory", count, sizes)


@cache
def _warn(reason: str) -> None:
    """A line in the log, once in a process."""
    log.warning("the ranks of a node do not share memory (%s): all exchange messages, which is slower", reason)
