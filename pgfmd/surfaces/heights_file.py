"""Heights of a file on a distributed grid: each rank reads its rows of an array file, rank 0 any other."""

from __future__ import annotations

import hashlib
import logging
import math

import numpy as np

from pgfmd.errors import InputError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.parallel.collectives import from_root, raise_together, slab
from pgfmd.parallel.mpi import MPI
from pgfmd.surfaces.measurement import Measurement, holes_in_words
from pgfmd.surfaces.readers import is_array, opened

log = logging.getLogger("pgfmd")
Source = tuple[str, str | None]  # file, dataset
DIGESTED = 2**21  # heights that are read at once to be digested
DOUBTFUL = 0.01  # of the points: if more were filled, a warning says so
ACCURACY = 1e-12  # norm of the residual, relative to that at the start, at which holes are filled


def folded(count: int, copies: int) -> np.ndarray:
    """Index in the file of each of `count` grid points along a side.

    copies: 1 gives 0 … count−1; 2, with a mirror image, 0 … m−1, m−1 … 0 for m = count/2.
    """
    index = np.arange(count)
    return np.minimum(index, 2 * (count // copies) - 1 - index)


def read_heights(
    grid: SlabGrid, source: Source, turned: bool, copies: int, length_unit: str | None
) -> tuple[np.ndarray, str]:
    """Heights (nx_local, ny) in float64 of a (file, dataset), NaN where nothing was measured, and what the file says of
    itself.  Collective.

    turned: x and y exchanged.  copies: 2 for mirror images in a cell of twice the size.  If the file gives its
    unit, heights and size are converted to length_unit.  Its number of points must be the grid's, and so must its size
    if the file gives one.
    Raises InputError on all ranks; see `readers.opened` and `Measurement.fitted`.
    """

    def fitting(found: Measurement) -> Measurement:
        return (found.turned() if turned else found).fitted(grid.shape, grid.lengths, copies, length_unit)

    folds = [folded(count, copies) for count in grid.shape]
    if from_root(grid.comm, is_array, *source):
        with raise_together(grid.comm), opened(*source) as found:
            found, wanted = fitting(found), folds[0][grid.rows]
            first = wanted.min()
            block = found.rows(first, wanted.max() + 1)
            return block if copies == 1 else block[np.ix_(wanted - first, folds[1])], found.described()
    message, words = None, ""
    with raise_together(grid.comm):
        if grid.comm.rank == 0:
            with opened(*source) as found:
                found = fitting(found)
                heights, words = found.rows(0, found.shape[0])[np.ix_(*folds)], found.described()
            message = [heights, np.diff(grid.starts) * grid.shape[1], grid.starts[:-1] * grid.shape[1], MPI.DOUBLE]
    mine = np.empty(grid.local_shape)
    grid.comm.Scatterv(message, mine)
    return mine, grid.comm.bcast(words)


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


def fill_holes(grid: SlabGrid, heights: np.ndarray, rule: str = "few", copies: int = 1) -> None:
    """Fill the heights (nx_local, ny) that are NaN, in place, and log how many they are; a warning if many.  copies: 2
    for mirror images.  Collective.

    Raises InputError if they are more than the rule allows (`missing` under [surface]).
    """
    holes, size = int(grid.reduction.sum(np.isnan(heights))) // copies**2, grid.size // copies**2
    words = holes_in_words(holes, size, rule)
    if holes:
        fill_missing(grid, heights)
        if grid.comm.rank == 0:
            log.log(logging.WARNING if holes > DOUBTFUL * size else logging.INFO, "surface: %s", words)


def fill_missing(grid: SlabGrid, heights: np.ndarray) -> None:
    """Replace the heights (nx_local, ny) that are NaN by a solution of Laplace's equation, in place.  Collective.

    Each becomes the mean of its four neighbours, weighted with 1/aₓ² and 1/a_y²; neighbours beyond the edges of
    the array are left out, since opposite edges of a measurement do not match.  So a hole inside a plane is filled
    with that plane, and no filled point is higher than all measured ones around it.  Conjugate gradients over the
    missing points alone.  Raises InputError if no point was measured.
    """
    missing, (nx, ny) = np.isnan(heights), grid.shape
    exponent = math.frexp(grid.reduction.max(np.max(np.abs(heights), where=~missing, initial=0.0)))[1]
    np.ldexp(heights, -exponent, out=heights)  # so that squares neither overflow nor underflow
    known, count = grid.reduction.sums(np.sum(heights, where=~missing), missing.sum())
    if count == grid.size:
        raise InputError("no point was measured")
    heights[missing] = known / (grid.size - count)

    padded = np.empty((len(heights) + 2, ny))  # with a row more above and below
    field = padded[1:-1]
    rows, columns = np.nonzero(missing)
    points, row = (rows + 1) * ny + columns, rows + grid.rows.start
    neighbours = [  # (weight, one side, the other); beyond an edge a point is its own neighbour
        (grid.spacing[1] / grid.spacing[0], points - ny * (row > 0), points + ny * (row < nx - 1)),
        (grid.spacing[0] / grid.spacing[1], points - (columns > 0), points + (columns < ny - 1)),
    ]

    def laplacian() -> np.ndarray:
        """Σ w (neighbour − point) of `field` at each missing point.  Collective."""
        padded[0] = grid.fetch(field, grid.rows.start - 1, grid.rows.start)
        padded[-1] = grid.fetch(field, grid.rows.stop, grid.rows.stop + 1)
        values = padded.ravel()
        twice = 2 * values[points]
        return sum(weight * (values[low] + values[high] - twice) for weight, low, high in neighbours)

    field[...] = heights
    residual = laplacian()
    direction, change = residual.copy(), np.zeros(len(residual))
    squares = first = grid.reduction.dot(residual, residual)
    field[...] = 0.0
    while squares > ACCURACY**2 * first:
        field[missing] = direction
        image = -laplacian()
        length = squares / grid.reduction.dot(direction, image)
        change += length * direction
        residual -= length * image
        before, squares = squares, grid.reduction.dot(residual, residual)
        direction = residual + squares / before * direction
    heights[missing] += change
    np.ldexp(heights, exponent, out=heights)
