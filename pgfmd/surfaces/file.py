"""Heights from a file.  Each rank reads its rows of an array file; rank 0 reads any other format."""

from __future__ import annotations

import hashlib
import logging
import math
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pgfmd.errors import InputError
from pgfmd.grid.cell import Cell
from pgfmd.options.rules import choice, number, text
from pgfmd.options.section import key, path_key, wrong
from pgfmd.options.text import printable
from pgfmd.parallel.collectives import from_root, raise_together, slab
from pgfmd.parallel.mpi import MPI, datatype
from pgfmd.surfaces.measurement import UNITS, Measurement, holes_in_words, named, usual_name
from pgfmd.surfaces.readers import is_array, opened
from pgfmd.surfaces.rigid_surface import Extent, Surface

if TYPE_CHECKING:
    from pgfmd.grid.slab_grid import SlabGrid

log = logging.getLogger("pgfmd")
Source = tuple[str, str | None]  # file, dataset
AT_ONCE = 2**21  # heights that are read at once, to be digested or checked
DOUBTFUL = 0.01  # of the points: if more were filled, a warning says so
ACCURACY = 1e-12  # norm of the residual, relative to that at the start, at which the solution in holes counts as found
ORDERS = {"mean": 0, "plane": 1, "quadratic": 2}  # of the polynomial that is subtracted
CLIFF = 5.0  # jump between opposite edges over the rms step between neighbours above which the user is warned
WAYS_OUT = (
    'the cell is periodic, so the contact sees a step there; write boundary = "open" under [grid] for a patch of a '
    'larger surface, or under [surface] detrend, or periodic = "mirror" or "taper"'
)
SLOPES = (1e-6, 10.0)  # range of the rms slope between neighbours; beyond it, units are probably confused
MARGIN = 0.1  # part of a side that a taper changes at each edge


def folded(count: int, copies: int) -> np.ndarray:
    """Index in the file of each of `count` grid points along a side.

    copies: 1 gives 0 … count−1; 2, with a mirror image, 0 … m−1, m−1 … 0 for m = count/2.
    """
    index = np.arange(count)
    return np.minimum(index, 2 * (count // copies) - 1 - index)


def read_heights(
    grid: SlabGrid, source: Source, turned: bool, copies: int, length_unit: str | None
) -> tuple[np.ndarray, str]:
    """Heights (nx_local, ny) in float64 of a (file, dataset), NaN where not measured, and its description.  Collective.

    turned: x and y exchanged.  copies: 2 for mirror images in a cell of twice the size.  If the file gives its
    unit, heights and size are converted to length_unit.  Points and, if the file gives it, size must be the grid's.
    Raises InputError on all ranks; see `readers.opened` and `Measurement.fitted`.
    """

    def fitting(measured: Measurement) -> Measurement:
        return (measured.turned() if turned else measured).fitted(grid.shape, grid.lengths, copies, length_unit)

    folds = [folded(count, copies) for count in grid.shape]
    if from_root(grid.comm, is_array, *source):
        with raise_together(grid.comm), opened(*source) as measured:
            measured, wanted = fitting(measured), folds[0][grid.rows]
            first = wanted.min()
            block = measured.rows(first, wanted.max() + 1)
            return block if copies == 1 else block[np.ix_(wanted - first, folds[1])], measured.described()
    message, words, line = None, "", datatype(np.float64, grid.shape[1])  # points may be more than 2³¹
    with raise_together(grid.comm):
        if grid.comm.rank == 0:
            with opened(*source) as measured:
                measured = fitting(measured)
                heights, words = measured.rows(0, measured.shape[0])[np.ix_(*folds)], measured.described()
            message = [heights, np.diff(grid.starts), grid.starts[:-1], line]
    mine = np.empty(grid.local_shape)
    grid.comm.Scatterv(message, [mine, len(mine), line])
    return mine, grid.comm.bcast(words)


def digest(comm: MPI.Comm, source: Source) -> str:
    """SHA-256 of the contents of a heights file.  Collective.

    Of an array file: of the digests of its rows, its shape and its unit; each rank reads a part, and other data in the
    file do not count.  Of any other file: of its bytes.
    """
    if not from_root(comm, is_array, *source):
        return from_root(comm, _of_file, source[0])
    rows, words = [], ""
    with raise_together(comm), opened(*source) as measured:
        mine, step = slab(measured.shape[0], comm.size, comm.rank), max(1, AT_ONCE // measured.shape[1])
        for first in range(mine.start, mine.stop, step):
            block = measured.rows(first, min(first + step, mine.stop))
            rows += [hashlib.sha256(row.data).digest() for row in block]
        words = f"{measured.shape} {measured.unit}"
    everyone = comm.allgather(b"".join(rows))
    return hashlib.sha256(b"".join([*everyone, words.encode()])).hexdigest()


def _of_file(path: str) -> str:
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None


def fill_holes(grid: SlabGrid, heights: np.ndarray, rule: str = "few", copies: int = 1) -> None:
    """Fill the heights (nx_local, ny) that are NaN, in place; log their number, as a warning if above `DOUBTFUL`.
    copies: 2 for mirror images.  Collective.

    Raises InputError if the rule (`missing` under [surface]) does not allow so many.
    """
    holes, size = int(grid.reduction.sum(np.isnan(heights))) // copies**2, grid.size // copies**2
    words = holes_in_words(holes, size, rule)
    if holes:
        fill_missing(grid, heights)
        if grid.comm.rank == 0:
            log.log(logging.WARNING if holes > DOUBTFUL * size else logging.INFO, "surface: %s", words)


def fill_missing(grid: SlabGrid, heights: np.ndarray) -> None:
    """Replace the heights (nx_local, ny) that are NaN by a solution of Laplace's equation, in place.  Collective.

    Each becomes the mean of its four neighbours, weighted with 1/aₓ² and 1/a_y²; neighbours beyond the edges of the
    array are left out, since opposite edges of a measurement do not match.  So a hole in a plane is filled with the
    plane, and no filled point is higher than all measured ones around it.  Solved by conjugate gradients over the
    missing points alone.  Raises InputError if no point was measured.
    """
    missing, (nx, ny) = np.isnan(heights), grid.shape
    exponent = math.frexp(grid.reduction.max(np.max(np.abs(heights), where=~missing, initial=0.0)))[1]
    np.ldexp(heights, -exponent, out=heights)  # so that squares neither overflow nor underflow
    known, count = grid.reduction.sums(np.sum(heights, where=~missing), missing.sum())
    if count == grid.size:
        raise InputError("no point was measured")
    heights[missing] = known / (grid.size - count)

    padded = np.empty((len(heights) + 2, ny))  # with a ghost row above and below
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


@dataclass(frozen=True, kw_only=True)
class FromFile(Surface):
    """The heights in a file.

    A periodic cell is closed in one of three ways.  "as-is": the heights are unchanged, with a cliff wherever opposite
    edges differ.  "mirror": the cell has twice the size and holds the heights and their mirror images; they are
    continuous and none is changed.  "taper": over the outer tenth at each edge they are blended into their mean.
    """

    kind = "file"
    cut_out = True
    path: str = path_key(
        ".npy, HDF5 (file.h5:dataset), text, .csv, .tif, or what SurfaceTopography reads (file:channel), also as .gz "
        "or .zip (file.zip:name); relative to the job's folder",
        "heights.npy",
    )
    dataset: str | None = key(
        text(), None, "of an HDF5 file, or channel, or name in a .zip; the same as the part of the path after the colon"
    )
    first_axis: str = key(
        choice("x", "y"), "x", 'axis of an array\'s first index, or of a text\'s lines; "x": [i, j] is at x = i a'
    )
    missing: str = key(
        choice("few", "refuse", "interpolate"),
        "few",
        "points that were not measured (NaN, masked, left out of a list) are filled by Laplace's equation: "
        '"few", if they are at most a third; "interpolate", always; "refuse", never',
    )
    detrend: str = key(
        choice("none", "mean", "plane", "quadratic"), "none", "subtract the mean, plane or paraboloid that fits best"
    )
    periodic: str = key(choice("as-is", "mirror", "taper"), "as-is", "how the periodic cell closes")
    height_scale: float = key(number(), 1.0, "factor on the heights; negative turns them over", unit="1")

    def check(self) -> None:
        if self.height_scale == 0:
            raise wrong(self, "height_scale", "must not be zero")

    @property
    def source(self) -> tuple[str, str | None]:
        """The heights file and the dataset in it (None: not said), from path, "path:dataset" or dataset."""
        path, colon, dataset = self.path.rpartition(":")
        if self.dataset or not colon or os.path.isfile(self.path):
            return self.path, self.dataset
        return path, dataset or None

    @property
    def _copies(self) -> int:
        """How often each side of the cell holds the file: 2 with mirror images."""
        return 2 if self.periodic == "mirror" else 1

    def check_in(self, cell: Cell) -> None:
        if self.periodic != "as-is" and not cell.domain.wraps:
            raise wrong(self, "periodic", f'boundary = "{cell.boundary}" under [grid] has no cell to close')
        if self.periodic == "mirror" and any(count % 2 for count in cell.n):
            fault = f"mirror images double the file, but the grid of {cell.n[0]} x {cell.n[1]} points cannot be halved"
            raise wrong(self, "periodic", fault)

    def extent(self, length_unit: str | None = None) -> Extent:
        with opened(*self.source) as measured:
            measured = measured.turned() if self.first_axis == "y" else measured
            unit = usual_name(measured.unit)
            measured = measured.converted(length_unit) if unit in UNITS else measured
            nx, ny = (self._copies * count for count in measured.shape)
            sides = measured.lengths and (self._copies * measured.lengths[0], self._copies * measured.lengths[1])
            return Extent((nx, ny), sides, unit if unit in UNITS else None)

    def heights(self, grid: SlabGrid, length_unit: str | None) -> np.ndarray:
        """The heights, read, filled, scaled, detrended and made periodic, as the keys say.  Collective.

        Logs a description of the file, and a warning if the slope is too small or too large for a rough surface.
        """
        self.check_in(Cell(n=grid.shape, length=grid.lengths, boundary=grid.domain.name))
        heights, said = read_heights(grid, self.source, self.first_axis == "y", self._copies, length_unit)
        with raise_together(grid.comm), named(self.source[0]):
            self._check_measured(heights, grid.rows.start)
        with named(self.source[0]):
            fill_holes(grid, heights, self.missing, self._copies)
        with raise_together(grid.comm), named(self.source[0]), np.errstate(over="ignore"):
            heights *= self.height_scale
            self._check_measured(heights, grid.rows.start)
        if grid.comm.rank == 0:
            log.info("surface: %s: %s", printable(self.path, 400), said)
        log_range(grid, heights, length_unit)
        if self.detrend != "none":
            subtract_trend(grid, heights, ORDERS[self.detrend], self._copies)
        if self.periodic == "as-is":
            warn_of_edges(grid, heights)
        if self.periodic == "taper":
            mean = grid.reduction.sum(heights) / grid.size
            weights = [_edge_weights(count) for count in grid.shape]
            heights[:] = mean + (heights - mean) * weights[0][grid.rows, None] * weights[1]
        return heights

    def check_inputs(self, cell: Cell, length_unit: str | None) -> str:
        with opened(*self.source) as measured:
            measured = measured.turned() if self.first_axis == "y" else measured
            measured = measured.fitted(cell.shape, cell.lengths, self._copies, length_unit)
            step = max(1, AT_ONCE // measured.shape[1])
            holes = 0
            for first in range(0, measured.shape[0], step):
                block = measured.rows(first, min(first + step, measured.shape[0]))
                self._check_measured(block, first)
                holes += int(np.isnan(block).sum())
            filled = holes_in_words(holes, math.prod(measured.shape), self.missing)
            return measured.described() + (filled and f"; {filled}")

    def _check_measured(self, heights: np.ndarray, first: int) -> None:
        """Raise InputError at the first height that is not finite, unless it is missing and to be filled.

        heights (rows, ny): some rows of the surface; first: number of the first of them, for the message.
        """
        fine = np.isfinite(heights)
        if self.missing != "refuse":
            fine |= np.isnan(heights)
        if not fine.all():
            row, column = np.argwhere(~fine)[0]
            value = heights[row, column]
            hint = '; missing = "interpolate" under [surface] fills what was not measured' * bool(np.isnan(value))
            raise InputError(f"the height at [{row + first}, {column}] is {value}; all must be finite{hint}")


def log_range(grid: SlabGrid, heights: np.ndarray, length_unit: str | None) -> None:
    """Log range, rms value and slope of the scaled heights; warn if the slope is not within SLOPES.  Collective."""
    lowest, highest = grid.reduction.min(heights), grid.reduction.max(heights)
    unit, steps = _rms_steps(grid, heights)
    mean = grid.reduction.sum(heights / unit) / grid.size
    variance = grid.reduction.sum((heights / unit - mean) ** 2) / grid.size
    slope = math.hypot(steps[0] / grid.spacing[0], steps[1] / grid.spacing[1])
    if grid.comm.rank != 0:
        return
    log.info(
        "surface: heights %.6g to %.6g %s as the job takes them, rms %.4g, slope %.3g between neighbours",
        lowest, highest, length_unit or "", unit * math.sqrt(variance), slope,
    )  # fmt: skip
    if not SLOPES[0] <= slope <= SLOPES[1] and lowest < highest:
        log.warning(
            "surface: no rough surface has a slope of %.3g: are heights and [grid] in the same unit of length? "
            "(height_scale under [surface], length under [grid])", slope,
        )  # fmt: skip


def subtract_trend(grid: SlabGrid, heights: np.ndarray, order: int, copies: int) -> None:
    """Subtract the polynomial of that order that fits the file's heights best, in place.  Collective.

    Least squares in products of polynomials of x and of y that are orthogonal over the points, so that each coefficient
    is a sum of its own.  A mirrored point has the coordinates of its original.
    """
    along_x, along_y = (_orthogonal(folded(count, copies), order) for count in grid.shape)
    terms = [(f, g) for m, f in enumerate(along_x) for n, g in enumerate(along_y) if m + n <= order]
    mine = [f[grid.rows] for f, _ in terms]
    sums = grid.reduction.sums(*(f @ (heights @ g) for f, (_, g) in zip(mine, terms, strict=True)))
    for total, f, (whole, g) in zip(sums, mine, terms, strict=True):
        squares = (whole @ whole) * (g @ g)
        if squares > 0:  # else there are too few points for that term
            heights -= total / squares * f[:, None] * g


def _orthogonal(fold: np.ndarray, order: int) -> list[np.ndarray]:
    """1, t, t² less their means up to `order`, t from −1 to 1: orthogonal, as the points lie evenly about 0."""
    last = max(fold.max(), 1)
    t = (2 * fold - fold.max()) / last
    return [np.ones(len(fold)), t, t**2 - np.mean(t**2)][: order + 1]


def warn_of_edges(grid: SlabGrid, heights: np.ndarray) -> None:
    """Log a warning if opposite edges of a periodic cell do not match.  Collective."""
    cliffs = jumps(grid, heights) if grid.domain.wraps else []
    if cliffs and grid.comm.rank == 0:
        log.warning("surface: opposite edges differ %s: %s", ", and ".join(cliffs), WAYS_OUT)


def jumps(grid: SlabGrid, heights: np.ndarray) -> list[str]:
    """A line for each direction where opposite edges differ by over `CLIFF` steps between neighbours.  Collective."""
    _, (step_x, step_y, jump_x, jump_y) = _rms_steps(grid, heights)
    return [
        f"across {name} by {jump:.3g} (rms), neighbours by {step:.3g}"
        for name, jump, step in (("x", jump_x, step_x), ("y", jump_y, step_y))
        if jump > CLIFF * step
    ]


def _rms_steps(grid: SlabGrid, heights: np.ndarray) -> tuple[float, list[float]]:
    """The largest |height|, 1 if that is 0; rms steps between neighbours along x and y, and between opposite edges
    across x and y.  Collective.
    """
    unit = max(-grid.reduction.min(heights), grid.reduction.max(heights)) or 1.0  # so that squares do not overflow
    scaled, (nx, ny) = heights / unit, grid.shape
    steps_x = np.diff(scaled, axis=0, append=grid.fetch(heights, grid.rows.stop, grid.rows.stop + 1) / unit)
    inner = len(steps_x) - (grid.rows.stop == nx)
    parts = steps_x[:inner], np.diff(scaled, axis=1), steps_x[inner:], scaled[:, 0] - scaled[:, -1]
    counts = (nx - 1) * ny, nx * (ny - 1), ny, nx
    sums = grid.reduction.sums(*(np.sum(part**2) for part in parts))
    return unit, [unit * math.sqrt(each / max(count, 1)) for each, count in zip(sums, counts, strict=True)]


def _edge_weights(count: int) -> np.ndarray:
    """1 in the middle, falling to 0 at both ends like a cosine, over a tenth of the side each."""
    from_edge = np.minimum(np.arange(count), np.arange(count)[::-1]) + 0.5
    return np.sin(np.pi / 2 * np.minimum(from_edge / (MARGIN * count), 1)) ** 2
