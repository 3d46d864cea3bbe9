"""Distributed real-to-complex transforms, made block by block so that each block stays in cache.

A forward and backward transform takes three passes over memory:

    rows forward     a callback fills a block of real rows; they are transformed along y and put into the strips
    columns          a block of columns is taken out of a strip and transformed along x; a callback changes the
                     spectrum; the block is transformed back and put into the strip again
    rows backward    a block of rows is taken out of the strips, transformed back along y, and given to a callback

The strips (see `transpose`) are the only complex array of the grid's size on one node; ranks on several nodes hold one
more, the rows packed to be sent.  A pair of library transforms passes over memory six times or more.  The threads of a
rank share the blocks between them.  Transforms are unnormalised in both directions.  Callbacks may run on several
threads at once, each time with another block; they must not communicate.  FFTW's wisdom is kept on disk, so that each
plan is measured once.
"""

from __future__ import annotations

import contextlib
import importlib.abc
import itertools
import os
import platform
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike

from pgfmd.errors import InputError
from pgfmd.grid import kernels
from pgfmd.grid.aligned import ALIGNMENT, aligned, with_padding
from pgfmd.grid.transpose import WORD, Strips
from pgfmd.parallel.compiled import keep, kept, locked, private_folder
from pgfmd.parallel.threads import Threads

RowAction = Callable[[int, int, np.ndarray], None]
"""action(first, stop, rows): fills or reads `rows` (stop − first, ny), local rows first … stop−1 of a field."""
ColumnAction = Callable[[np.ndarray, int, int], None]
"""action(block, first, stop): changes, makes or reads `block` (stop − first, Nx), local ky first … stop−1."""


def source(field: np.ndarray) -> RowAction:
    """Rows of a field (nx_local, ny), for a transform to read."""

    def fill(first: int, stop: int, rows: np.ndarray) -> None:
        rows[...] = field[first:stop]

    return fill


def in_chunks(make: Callable[[int, int], np.ndarray], count: int, threads: int) -> RowAction:
    """Rows that are made `count` at a time, by make(first, stop), which may give fewer at the end: for rows that depend
    on many around them, so that few at a time cost more.  Several threads, which take rows in turn, make just these.
    """
    last: list[tuple[int, np.ndarray]] = [(-1, np.empty((0, 0)))]

    def fill(first: int, stop: int, rows: np.ndarray) -> None:
        for begin in range(first // count * count, stop, count):
            if last[0][0] != begin:
                last[0] = begin, make(begin, begin + count)
            low, high = max(first, begin), min(stop, begin + count)
            rows[low - first : high - first] = last[0][1][low - begin : high - begin]

    def fill_alone(first: int, stop: int, rows: np.ndarray) -> None:
        rows[...] = make(first, stop)

    return fill if threads == 1 else fill_alone


def sink(field: np.ndarray) -> RowAction:
    """Puts the rows of a transform into a field (nx_local, ny)."""

    def drain(first: int, stop: int, rows: np.ndarray) -> None:
        field[first:stop] = rows

    return drain


def scaling(factors: np.ndarray) -> ColumnAction:
    """Multiplies the modes of a spectrum, complex64, by factors (nky_local, Nx), float32."""

    def act(block: np.ndarray, first: int, stop: int) -> None:
        with np.errstate(over="ignore", invalid="ignore"):  # numbers of a diverging iteration
            block *= factors[first:stop]

    return act


class _Without(importlib.abc.MetaPathFinder):
    """In this thread, until its block ends, a module counts as not installed, unless it has been imported before."""

    def __init__(self, name: str) -> None:
        self.name, self.thread = name, threading.get_ident()

    def __enter__(self) -> None:
        sys.meta_path.insert(0, self)

    def __exit__(self, *error: object) -> None:
        sys.meta_path.remove(self)

    def find_spec(self, name: str, *_: object) -> None:
        if name == self.name and threading.get_ident() == self.thread:
            raise ModuleNotFoundError(name)


try:
    with _Without("scipy.fftpack"):  # pyfftw would import it, and 150 modules with it: .1 s of .5 s
        import pyfftw
except ImportError:
    pyfftw = None

PRECISIONS = 3  # FFTW exports its wisdom as three texts: for double, single and long double precision
SEPARATOR = b"\0"
_planner = threading.Lock()  # pyfftw guards planning with a lock of its own, but not its wisdom
_loaded: tuple[int, int] | None = None  # inode and time of the wisdom file that was read last


def plan(source: np.ndarray, target: np.ndarray, forward: bool, axes: tuple[int, ...] = (1,)) -> Callable[[], None]:
    """A function without arguments that transforms `source` into `target` along these axes, unnormalised.

    Real to complex, complex to complex (also in place) or complex to real, as the types say.  Planning overwrites both
    arrays; the function overwrites `source` too.  Threads may plan at once.  Raises InputError without pyfftw.
    """
    if pyfftw is None:
        raise InputError('solver.transform = "blocked": needs the package pyfftw; install it, or choose "mpi4py-fft"')
    direction = "FFTW_FORWARD" if forward else "FFTW_BACKWARD"

    def made(*flags: str) -> Callable[[], None]:
        flags = ("FFTW_MEASURE", "FFTW_DESTROY_INPUT", *flags)
        return pyfftw.FFTW(source, target, axes=axes, direction=direction, flags=flags, threads=1).execute

    def known() -> Callable[[], None] | None:
        with contextlib.suppress(RuntimeError):  # no wisdom
            return made("FFTW_WISDOM_ONLY")
        return None

    with _planner:
        if (found := known()) or (path := wisdom_file()) is None:
            return found or made()
        _load_wisdom(path)
        if found := known():
            return found
        with locked(path) or contextlib.nullcontext():  # one process plans, others wait and load
            _load_wisdom(path)
            if not (found := known()):
                found = made()
                keep(path, SEPARATOR.join(pyfftw.export_wisdom()))
        return found


def wisdom_file() -> Path | None:
    """The wisdom file of this processor model and pyFFTW version; None if there is no private folder."""
    folder, model = private_folder(), platform.processor() or platform.machine()
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next((line.split(":", 1)[1] for line in lines if line.startswith("model name")), model)
    name = "".join(c if c.isalnum() else "-" for c in f"{pyfftw.__version__}-{model.strip()}")
    return None if folder is None else folder / f"fftw-{name}"


def _load_wisdom(path: Path) -> None:
    """Import the wisdom of other processes; a file that cannot be read is ignored."""
    global _loaded
    with contextlib.suppress(OSError):
        found = os.stat(path)
        if (stamp := (found.st_ino, found.st_mtime_ns)) == _loaded:
            return
        wisdom, _loaded = tuple((kept(path) or b"").split(SEPARATOR)), stamp
        if len(wisdom) == PRECISIONS:
            pyfftw.import_wisdom(wisdom)


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

    def rows_forward(self, fill: RowAction, filled: tuple[int, int] | None = None) -> None:
        """Real rows, made by `fill(first, stop, block)`, to row-transformed rows in the strips.  filled: first and stop
        of the rows, if not all, that are not 0.  Collective.
        """
        plans = self._plans("rows", "half", True)

        def one(thread: int, first: int, stop: int) -> None:
            worker = self.workers[thread]
            if filled is not None and not (first < filled[1] and filled[0] < stop):
                worker.half[...] = 0
            else:
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


class WholeTransform:
    """The same passes in one precision for a whole periodic grid (nx, ny) on one rank: one plan for both directions of
    the grid.  On small grids the many calls for blocks take longer than passes over memory.
    """

    def __init__(self, shape: tuple[int, int], dtype: DTypeLike) -> None:
        self.real = np.dtype(dtype)
        self.complex, self.cost = np.result_type(self.real, np.complex64), self.real.itemsize / 8
        self.rows = aligned(shape, self.real, pad=False)
        self.spectrum = aligned((shape[1] // 2 + 1, shape[0]), self.complex)
        self._forward = plan(self.rows, self.spectrum.T, True, (0, 1))
        self._backward = plan(self.spectrum.T, self.rows, False, (0, 1))

    def rows_forward(self, fill: RowAction, filled: tuple[int, int] | None = None) -> None:
        """All rows, made by `fill(0, nx, rows)`."""
        fill(0, len(self.rows), self.rows)

    def columns(
        self, action: ColumnAction, forward: bool = True, backward: bool = True, count: int | None = None
    ) -> None:
        """As of `Transform`, with all columns, or the first `count` of them, in one block."""
        if forward:
            self._forward()
        block = self.spectrum[:count]
        action(block, 0, len(block))
        if backward:
            self._backward()

    def rows_backward(self, drain: RowAction) -> None:
        """All rows to `drain(0, nx, rows)`."""
        drain(0, len(self.rows), self.rows)


def _per_block(target: int, count: int, threads: int, multiple: int = 1) -> int:
    """How many of `count` rows (or columns) make one block: about `target` of them.

    A partly filled block takes the time of a full one: so all blocks are equally large, and each thread gets equally
    many.  With threads the number is rounded up to a `multiple`, so that no two blocks write to one cache line.
    """
    target = max(1, target)
    blocks = max(1, count // target if count < 4 * target else -(-count // target))
    size = max(1, -(-count // (-(-blocks // threads) * threads)))  # 1 also where a rank has nothing
    return size if threads == 1 else min(-(-size // multiple) * multiple, max(count, 1))
