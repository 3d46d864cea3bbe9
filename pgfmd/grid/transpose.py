"""The distributed transpose between transforms along rows and transforms along columns.

Before it each rank holds whole rows, after it whole columns: its *strip*, the columns ky of this rank for all nx rows.
Ranks of one node write into each other's strips, which lie in shared memory (`SharedStrips`).  Otherwise rows are
packed for each rank and sent with one `Alltoallv` (`ExchangedStrips`).

A strip is an array of shape (tiles, rows, columns of a tile); the last tile need not be full.  In shared memory a tile
has a few columns, so that passes along rows and along columns both read and write long contiguous pieces of memory.  An
exchanged strip is one tile.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import DTypeLike

from pgfmd.grid import kernels
from pgfmd.parallel.collectives import slab_starts
from pgfmd.parallel.mpi import MPI, datatype
from pgfmd.parallel.teams import node_of

TILE = 256  # bytes of a row in one tile: more favours the passes along rows, less those along columns
ALIGNMENT = 64  # bytes: a cache line and the widest vector register

Counts = tuple[np.ndarray, np.ndarray]
"""Bytes of each rank's part of a buffer, and the offsets of the parts."""


def row_stride(count: int, itemsize: int) -> int:
    """Items from one row of `count` items to the next: padded to an odd number of cache lines.

    Rows then start on cache lines, and rows a power of two apart do not fall on the same cache sets.
    """
    lines = -(-max(count, 1) * itemsize // ALIGNMENT) | 1
    return lines * ALIGNMENT // itemsize


def padded(raw: np.ndarray, shape: tuple[int, int], dtype: DTypeLike) -> np.ndarray:
    """The bytes `raw` seen as rows of that shape, each padded to `row_stride`."""
    return _rows_and_padding(raw, shape, dtype)[:, : shape[1]]


def _rows_and_padding(raw: np.ndarray, shape: tuple[int, int], dtype: DTypeLike) -> np.ndarray:
    """The bytes `raw` seen as rows of that shape with their padding.  The array is contiguous, so that compiled loops
    know its strides.
    """
    dtype = np.dtype(dtype)
    stride = row_stride(shape[1], dtype.itemsize)
    return raw[: shape[0] * stride * dtype.itemsize].view(dtype).reshape(shape[0], stride)


def aligned_bytes(count: int) -> np.ndarray:
    """`count` bytes of new memory that begin on a cache line."""
    return _from_cache_line(np.empty(count + ALIGNMENT, np.uint8))[:count]


def _from_cache_line(raw: np.ndarray) -> np.ndarray:
    return raw[-raw.ctypes.data % ALIGNMENT :]


def aligned(shape: tuple[int, int], dtype: DTypeLike, apart: bool = True) -> np.ndarray:
    """A new array of that shape whose rows start on cache lines.

    apart: rows are padded, so that they start on different cache sets.  Without it, rows that fill whole cache lines
    are not padded: compiled loops are faster on a contiguous array.
    """
    dtype = np.dtype(dtype)
    if not apart and shape[1] * dtype.itemsize % ALIGNMENT == 0:
        return aligned_bytes(shape[0] * shape[1] * dtype.itemsize).view(dtype).reshape(shape)
    return padded(aligned_bytes(shape[0] * row_stride(shape[1], dtype.itemsize) * dtype.itemsize), shape, dtype)


def with_padding(array: np.ndarray) -> np.ndarray:
    """A `padded` array together with its padding: contiguous, so that compiled loops know its strides."""
    return np.lib.stride_tricks.as_strided(array, (len(array), array.strides[0] // array.itemsize))


class Strips(ABC):
    """The strips of all ranks: the largest array of a transform, shared by the transforms of both precisions.

    `put` moves blocks of transformed rows in, `to_columns` completes the transpose; `to_rows` and `get` are the way
    back.
    """

    first_row: int  # where the rows of this rank begin in the arrays `views`

    def __init__(self, comm: MPI.Comm, shape: tuple[int, int]) -> None:
        self.comm, self.nx = comm, shape[0]
        self.row_starts = slab_starts(shape[0], comm.size)
        self.column_starts = slab_starts(shape[1] // 2 + 1, comm.size)
        self.widths = np.diff(self.column_starts)
        self.rows = int(self.row_starts[comm.rank + 1] - self.row_starts[comm.rank])
        self.width = int(self.widths[comm.rank])

    def put(self, views: list[np.ndarray], first: int, half: np.ndarray) -> None:
        """Copy the row-transformed rows `half`, the first of which is local row `first`, into the `views`."""
        for view, start, width in zip(views, self.column_starts, self.widths, strict=False):
            kernels.rows_to_tiles(half, start, width, self.first_row + first, view)

    def get(self, views: list[np.ndarray], first: int, half: np.ndarray) -> None:
        """Copy the rows `half`, the first of which is local row `first`, out of the `views`."""
        for view, start, width in zip(views, self.column_starts, self.widths, strict=False):
            kernels.tiles_to_rows(view, self.first_row + first, half, start, width)

    @abstractmethod
    def views(self, dtype: np.dtype) -> list[np.ndarray]:
        """For each rank, the array that takes its part of this rank's rows, as complex `dtype`."""

    @abstractmethod
    def strip(self, dtype: np.dtype) -> np.ndarray:
        """The strip of this rank, as complex `dtype`."""

    @abstractmethod
    def begin(self, dtype: np.dtype) -> None:
        """Wait until the strips may be overwritten.  Collective."""

    @abstractmethod
    def to_columns(self, dtype: np.dtype) -> None:
        """Rows that were `put` become columns of the strips.  Collective."""

    @abstractmethod
    def to_rows(self, dtype: np.dtype) -> None:
        """Columns of the strips become rows to `get`.  Collective."""

    @abstractmethod
    def free(self) -> None:
        """Give the memory back.  Collective."""


class SharedStrips(Strips):
    """Strips in memory that all ranks see: the ranks of one node, or one rank alone.  The transpose is done by stores
    and loads; no message is sent.
    """

    def __init__(self, comm: MPI.Comm, shape: tuple[int, int]) -> None:
        super().__init__(comm, shape)
        self.first_row = int(self.row_starts[comm.rank])
        count = self.nbytes(comm.rank)
        if comm.size == 1:
            self.window: MPI.Win | None = None
            self.raw = [aligned_bytes(count)]
            return
        self.window = window = MPI.Win.Allocate_shared(count + ALIGNMENT, 1, comm=MPI.Intracomm(comm))
        window.Lock_all(MPI.MODE_NOCHECK)
        buffers = [np.asarray(window.Shared_query(rank)[0]).view(np.uint8) for rank in range(comm.size)]
        self.raw = [_from_cache_line(buffer) for buffer in buffers]

    def tiles(self, rank: int, itemsize: int) -> tuple[int, int, int]:
        """Shape of the strip of `rank`.  It has one row more than nx, so that tiles start on different cache sets."""
        columns = TILE // itemsize
        return -(-int(self.widths[rank]) // columns), self.nx + 1, columns

    def nbytes(self, rank: int) -> int:
        """Bytes of the strip of `rank`, in the larger precision."""
        return math.prod(self.tiles(rank, 16)) * 16

    def views(self, dtype: np.dtype) -> list[np.ndarray]:
        """The strip of each rank."""
        shapes = [self.tiles(rank, dtype.itemsize) for rank in range(self.comm.size)]
        return [
            raw[: math.prod(shape) * dtype.itemsize].view(dtype).reshape(shape)
            for raw, shape in zip(self.raw, shapes, strict=True)
        ]

    def strip(self, dtype: np.dtype) -> np.ndarray:
        """The strip of this rank."""
        return self.views(dtype)[self.comm.rank]

    def meet(self, dtype: np.dtype | None = None) -> None:
        """Wait until all ranks have written their part; then each sees what the others wrote.  Collective."""
        if self.window is not None:
            self.window.Sync()
            self.comm.Barrier()
            self.window.Sync()

    begin = to_columns = to_rows = meet

    def free(self) -> None:
        """Give the memory back.  Collective."""
        if self.window is not None:
            self.raw = []
            self.window.Unlock_all()
            self.window.Free()
            self.window = None


class ExchangedStrips(Strips):
    """Strips in memory of each rank's own: rows are packed for each rank and sent with one `Alltoallv`."""

    def __init__(self, comm: MPI.Comm, shape: tuple[int, int]) -> None:
        super().__init__(comm, shape)
        self.first_row = 0
        self.own = aligned_bytes(self.nbytes(comm.rank, self.nx))
        sizes = [self.nbytes(rank, self.rows) for rank in range(comm.size)]
        self.packed = aligned_bytes(sum(sizes))

    def nbytes(self, rank: int, rows: int, itemsize: int = 16) -> int:
        """Bytes of that many rows of the strip of `rank`."""
        return rows * row_stride(int(self.widths[rank]), itemsize) * itemsize

    def _counts(self, itemsize: int) -> tuple[Counts, Counts]:
        """Counts of `packed`, a part for the strip of each rank, and of `own`, a part for the rows of each rank."""
        packed = np.array([self.nbytes(rank, self.rows, itemsize) for rank in range(self.comm.size)])
        strip = np.diff(self.row_starts) * self.nbytes(self.comm.rank, 1, itemsize)
        return (packed, np.cumsum(packed) - packed), (strip, np.cumsum(strip) - strip)

    def views(self, dtype: np.dtype) -> list[np.ndarray]:
        """The packed block for each rank."""
        (counts, starts), _ = self._counts(dtype.itemsize)
        blocks = [self.packed[start : start + count] for start, count in zip(starts, counts, strict=True)]
        return [
            _rows_and_padding(raw, (self.rows, int(width)), dtype)[None]
            for raw, width in zip(blocks, self.widths, strict=True)
        ]

    def strip(self, dtype: np.dtype) -> np.ndarray:
        """The strip of this rank."""
        return _rows_and_padding(self.own, (self.nx, self.width), dtype)[None]

    def begin(self, dtype: np.dtype) -> None:
        """Nothing to wait for."""

    def to_columns(self, dtype: np.dtype) -> None:
        """Packed blocks to strips.  Collective."""
        packed, strip = self._counts(dtype.itemsize)
        self._alltoall(self.packed, packed, self.own, strip, dtype)

    def to_rows(self, dtype: np.dtype) -> None:
        """Strips to packed blocks.  Collective."""
        packed, strip = self._counts(dtype.itemsize)
        self._alltoall(self.own, strip, self.packed, packed, dtype)

    def _alltoall(
        self, source: np.ndarray, sent: Counts, target: np.ndarray, received: Counts, dtype: np.dtype
    ) -> None:
        # Counted in items, not bytes: counts above 2³¹ are refused by most MPI libraries.
        send, receive = ([numbers // dtype.itemsize for numbers in counts] for counts in (sent, received))
        kind = datatype(dtype)
        self.comm.Alltoallv([source.view(dtype), *send, kind], [target.view(dtype), *receive, kind])

    def free(self) -> None:
        """Give the memory back."""
        self.own = self.packed = np.empty(0, np.uint8)


def make_strips(comm: MPI.Comm, shape: tuple[int, int], shared: bool | None = None) -> SharedStrips | ExchangedStrips:
    """Shared strips where all ranks of `comm` are on one node, else exchanged ones; `shared=False` forces the latter.
    Collective.
    """
    one_node = node_of(comm).size == comm.size
    return SharedStrips(comm, shape) if one_node and shared is not False else ExchangedStrips(comm, shape)
