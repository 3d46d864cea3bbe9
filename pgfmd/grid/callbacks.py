"""The callbacks that a transform takes: rows go in and out, and the spectrum is acted on, a block at a time.

No array of the size of the grid is needed for what exists only between two passes.  A callback may run on several
threads at once, each time with another block; it must not communicate.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pgfmd.grid import kernels

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
        kernels.scale_modes(block.view(factors.dtype).reshape(*block.shape, 2), factors[first:stop])

    return act
