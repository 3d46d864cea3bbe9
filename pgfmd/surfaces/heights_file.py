"""Heights of a file on a distributed grid: each rank reads its rows of an array file, rank 0 any other file."""

from __future__ import annotations

import hashlib

import numpy as np

from pgfmd.errors import InputError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.parallel.collectives import from_root, raise_together, slab
from pgfmd.parallel.mpi import MPI
from pgfmd.surfaces.array_files import is_array, opened
from pgfmd.surfaces.measurement import Measurement
from pgfmd.surfaces.mirror import folded

Source = tuple[str, str | None]  # file, dataset
DIGESTED = 2**21  # heights that are read at once to be digested


def read_heights(
    grid: SlabGrid, source: Source, turned: bool, copies: int, length_unit: str | None
) -> tuple[np.ndarray, str]:
    """Heights (nx_local, ny) in float64 of a (file, dataset), NaN where nothing was measured, and what the file says of
    itself.  Collective.

    turned: x and y exchanged.  copies: 2 for mirror images in a cell of twice the size.  If the file gives its
    unit, heights and size are converted to length_unit.  Its number of points must be the grid's, and so must its size
    if the file gives one.
    Raises InputError on all ranks; see `array_files.opened` and `Measurement`.
    """
    folds = [folded(count, copies) for count in grid.shape]
    if from_root(grid.comm, is_array, *source):
        with raise_together(grid.comm), opened(*source) as found:
            found = _fitting(found, grid, turned, copies, length_unit)
            wanted = folds[0][grid.rows]
            first = wanted.min()
            block = found.rows(first, wanted.max() + 1)
            return block if copies == 1 else block[np.ix_(wanted - first, folds[1])], found.described()
    message, words = None, ""
    with raise_together(grid.comm):
        if grid.comm.rank == 0:
            with opened(*source) as found:
                found = _fitting(found, grid, turned, copies, length_unit)
                heights, words = found.rows(0, found.shape[0])[np.ix_(*folds)], found.described()
            message = [heights, np.diff(grid.starts) * grid.shape[1], grid.starts[:-1] * grid.shape[1], MPI.DOUBLE]
    mine = np.empty(grid.local_shape)
    grid.comm.Scatterv(message, mine)
    return mine, grid.comm.bcast(words)


def _fitting(found: Measurement, grid: SlabGrid, turned: bool, copies: int, length_unit: str | None) -> Measurement:
    """The measurement as the grid needs it; raises InputError if it does not fit.  See `read_heights`."""
    found = (found.turned() if turned else found).converted(length_unit)
    found.check(grid.shape, grid.lengths, copies)
    return found


def digest(comm: MPI.Comm, source: Source) -> str:
    """SHA-256 of the contents of a heights file.  Collective.

    An array file: of the digests of its rows, its shape and its unit; each rank reads a part, and other data in the
    file do not count.  Any other file: of its bytes.
    """
    if not from_root(comm, is_array, *source):
        return from_root(comm, _of_file, source[0])
    rows, words = [], ""
    with raise_together(comm), opened(*source) as found:
        mine, step = slab(found.shape[0], comm.size, comm.rank), max(1, DIGESTED // found.shape[1])
        for first in range(mine.start, mine.stop, step):
            block = found.rows(first, min(first + step, mine.stop))
            rows += [hashlib.sha256(row.data).digest() for row in block]
        words = f"{found.shape} {found.unit}"
    everyone = comm.allgather(b"".join(rows))
    return hashlib.sha256(b"".join([*everyone, words.encode()])).hexdigest()


def _of_file(path: str) -> str:
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
