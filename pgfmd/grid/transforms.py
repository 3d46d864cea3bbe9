"""Distributed real-to-complex transforms, made block by block so that each block stays in cache.

A forward and backward transform takes three passes over memory:

    rows forward     a callback fills a block of real rows; they are transformed along y and put into the strips
    columns          a block of columns is taken out of a strip and transformed along x; a callback changes the
                     spectrum; the block is transformed back and put into the strip again
    rows backward    a block of rows is taken out of the strips, transformed back along y, and given to a callback

The strips (see `transpose`) are the only complex array of the grid's size on one node; ranks on several nodes hold one
more, the rows packed to be sent.  A pair of library transforms passes over memory six times or more.  The threads of a
rank share the blocks between them.  Transforms are unnormalised in both directions.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
from numpy.typing import DTypeLike

from pgfmd.grid import kernels
from pgfmd.grid.aligned import ALIGNMENT, aligned, with_padding
from pgfmd.grid.callbacks import ColumnAction, RowAction
from pgfmd.grid.fftw import plan
from pgfmd.grid.transpose import WORD, Strips
from pgfmd.parallel.threads import Threads

ROW_BLOCK = 1 << 17  # bytes of a block of rows, so that it and its transform stay in the second-level cache
COLUMN_BLOCK = 1 << 19  # bytes of a block of columns: half of that cache, which two threads of a core share
# Least bytes that a block of rows moves to or from one tile, and a block of columns to or from one row of a strip, even
# if the block then exceeds the above: shorter pieces of memory cost more than the cache saves.  Per point of 65536² on
# 4096 ranks: rows 9.1 ns with 128 bytes, 3.4 with 512, 1.4 with 2048; columns 2.8 with 48, 2.0 with 144.
TILE_PIECE, ROW_PIECE = 1 << 11, 1 << 7


class _Worker:
    """Blocks of one thread.

    rows: a block of real rows, of the torus; points: the same of the grid, a copy if there are fewer; half: their
    transforms along y, the half with ky ≥ 0; block: a block of columns.
    """

    def __init__(self, transform: Transform) -> None:
        (_, ny), (mx, my) = transform.shape, transform.torus
        real, cplx = transform.real, transform.complex
        self.rows = aligned((transform.row_block, my), real, pad=False)
        self.points = self.rows if my == ny else aligned((transform.row_block, ny), real, pad=False)
        self.half = aligned((transform.row_block, my // 2 + 1), cplx)
        self.block = aligned((transform.column_block, mx), cplx)
        self.padded_half, self.padded_block = with_padding(self.half), with_padding(self.block)


class Transform:
    """The three passes in one precision, over the strips of a grid of shape (nx, ny), on a torus of (Nx, Ny).

    Rows and columns are padded with zeros in the blocks.  Strips have nx rows of Ny // 2 + 1 columns: no rows of zeros.
    """

    def __init__(
        self, strips: Strips, shape: tuple[int, int], torus: tuple[int, int], dtype: DTypeLike, threads: Threads
    ) -> None:
        self.strips, self.shape, self.torus = strips, shape, torus
        self.real = np.dtype(dtype)
        self.complex = np.result_type(self.real, np.complex64)
        nx, ny = torus
        self.parts, self.strip = strips.parts(self.complex), strips.strip(self.complex)
        # Larger with threads: between blocks they wait for the interpreter's lock.
        budget, itemsize = ROW_BLOCK * min(threads.count, 2), self.complex.itemsize
        narrowest = int(self.parts.table[:, 3].min()) * WORD.itemsize
        rows = max(budget // (ny * self.real.itemsize), -(-TILE_PIECE // narrowest))
        columns = max(COLUMN_BLOCK // (nx * itemsize), ROW_PIECE // itemsize)
        self.row_block = _per_block(rows, strips.rows, threads.count)
        self.column_block = _per_block(columns, strips.width, threads.count, ALIGNMENT // itemsize)
        self.threads = threads
        self.workers = [_Worker(self) for _ in range(threads.count)]
        self._known: dict[tuple[str, str, bool], list[Callable[[], None]]] = {}
        self.cost = self.real.itemsize / 8  # of a transform pair, in double-precision equivalents

    def _plans(self, source: str, target: str, forward: bool) -> list[Callable[[], None]]:
        """The plan of each thread from one of its blocks to another, made on first use: heights need two of the four
        kinds.  Planning overwrites the blocks, which hold nothing between calls.
        """
        if (key := (source, target, forward)) not in self._known:
            blocks = [(getattr(worker, source), getattr(worker, target)) for worker in self.workers]
            self._known[key] = [plan(*pair, forward) for pair in blocks]
            for array in itertools.chain(*blocks):
                array[...] = 0  # planning leaves arbitrary numbers, which could be NaN
        return self._known[key]

    def rows_forward(self, fill: RowAction) -> None:
        """Real rows, made by `fill(first, stop, block)`, to row-transformed rows in the strips.  Collective."""
        plans = self._plans("rows", "half", True)

        def one(thread: int, first: int, stop: int) -> None:
            worker = self.workers[thread]
            fill(first, stop, worker.points[: stop - first])
            if worker.points is not worker.rows:
                worker.rows[:, : self.shape[1]] = worker.points
                worker.rows[:, self.shape[1] :] = 0
            plans[thread]()
            self.strips.put(self.parts, first, worker.padded_half[: stop - first])

        self.strips.begin()
        self.threads.share(one, self.strips.rows, self.row_block)
        self.strips.to_columns(self.complex)

    def columns(
        self, action: ColumnAction, forward: bool = True, backward: bool = True, count: int | None = None
    ) -> None:
        """Call `action(block, first, stop)` on the spectrum in the strips, or its first `count` columns, by blocks.

        forward=False: the action writes a new spectrum.  The call is then collective: it waits until no rank reads the
        strips any more.  backward=False: the action only reads the spectrum.
        """
        if not forward:
            self.strips.begin()
        to = self._plans("block", "block", True) if forward else []
        back = self._plans("block", "block", False) if backward else []

        def one(thread: int, first: int, stop: int) -> None:
            worker, place = self.workers[thread], self.strips.first_column + first
            block = worker.block[: stop - first]
            if forward:
                kernels.tiles_and_columns(self.strip, self.shape[0], place, stop - first, worker.padded_block, False)
                block[:, self.shape[0] :] = 0
                to[thread]()
            action(block, first, stop)
            if backward:
                back[thread]()
                kernels.tiles_and_columns(self.strip, self.shape[0], place, stop - first, worker.padded_block, True)

        self.threads.share(one, self.strips.width if count is None else count, self.column_block)

    def rows_backward(self, drain: RowAction) -> None:
        """Strips to real rows, each block handed to `drain(first, stop, block)`.  Collective."""
        plans = self._plans("half", "rows", False)

        def one(thread: int, first: int, stop: int) -> None:
            worker = self.workers[thread]
            self.strips.get(self.parts, first, worker.padded_half[: stop - first])
            plans[thread]()
            if worker.points is not worker.rows:
                worker.points[...] = worker.rows[:, : self.shape[1]]
            drain(first, stop, worker.points[: stop - first])

        self.strips.to_rows(self.complex)
        self.threads.share(one, self.strips.rows, self.row_block)

    def free(self) -> None:
        """Frees nothing: the large arrays are those of the strips, which `SlabGrid` frees."""


def _per_block(target: int, count: int, threads: int, multiple: int = 1) -> int:
    """How many of `count` rows (or columns) make one block: about `target` of them.

    A partly filled block takes the time of a full one: so all blocks are equally large, and each thread gets equally
    many.  With threads the number is rounded up to a `multiple`, so that no two blocks write to one cache line.
    """
    target = max(1, target)
    blocks = max(1, count // target if count < 4 * target else -(-count // target))
    size = max(1, -(-count // (-(-blocks // threads) * threads)))  # 1 also where a rank has nothing
    return size if threads == 1 else min(-(-size // multiple) * multiple, max(count, 1))
