"""The callbacks that a transform takes: rows go in and out, and the spectrum is acted on, a block at a time.

No array of the size of the grid is needed for what exists only between two passes.  A callback may run on several
threads at once, each time with another block; it must not communicate.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

Rows = Callable[[int, int, np.ndarray], None]
"""(first local row, stop, rows (stop − first, ny)): fills the rows, or reads them."""
Columns = Callable[[np.ndarray, int, int], None]
"""(block (stop − first, nx), first local ky, stop): changes modes of the spectrum in place, makes or reads them."""


def source(field: np.ndarray) -> Rows:
    """Rows of a field (nx_local, ny), for a transform to read."""

    def fill(first: int, stop: int, rows: np.ndarray) -> None:
        rows[...] = field[first:stop]

    return fill


def sink(field: np.ndarray) -> Rows:
    """Puts the rows of a transform into a field (nx_local, ny)."""

    def drain(first: int, stop: int, rows: np.ndarray) -> None:
        field[first:stop] = rows

    return drain
