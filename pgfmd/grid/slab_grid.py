"""`SlabGrid`: a doubly periodic grid in slabs of rows, its wave numbers and transforms.

Symbols: nx × ny points on a cell lx × ly; fields are float64 of shape (nx_local, ny), axis 0 (x) split over the ranks.
Spectra are complex of shape (nky_local, nx): axis 0 is ky ≥ 0 split over the ranks, axis 1 is kx in FFT order, so
spectra are *transposed*.  A mode with 0 < ky < ny/2 stands for itself and its conjugate: Hermitian weight 2, else 1.

DFT convention: `forward` is the plain sum over points, `backward` carries 1/(nx ny).  The methods that take callbacks
(`make_field`, `convolve`) do not apply that factor; one of their callbacks has to.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np
from numpy.typing import DTypeLike

from pgfmd.errors import InputError
from pgfmd.grid.aligned import new_field
from pgfmd.grid.callbacks import ColumnAction, RowAction, sink, source
from pgfmd.grid.library_transform import LibraryTransform
from pgfmd.grid.transforms import Transform
from pgfmd.grid.transpose import Strips, make_strips
from pgfmd.parallel.collectives import Reduction, shared, slab, slab_starts
from pgfmd.parallel.layout import Exchange, Layout, RowPlan
from pgfmd.parallel.mpi import MPI
from pgfmd.parallel.threads import Threads, threads_per_rank

BAND = 1 << 16  # points of a band of rows: the bands of a few fields fit into the cache together


class SlabGrid:
    """A periodic grid whose rows are distributed over the ranks of `comm`.  Making one does not communicate; memory
    for transforms is allocated on first use.

    Attributes
    ----------
    comm, shape (nx, ny), lengths (lx, ly), spacing (ax, ay), pixel_area
    rows: slice of the global rows that this rank holds;  starts: first row of each rank, and nx;  layout: both
    local_shape: (nx_local, ny);  spectral_shape: (nky_local, nx);  band: number of rows in a band (`BAND`)
    qx (1, nx), qy (nky_local, 1): wave numbers in radians per length;  hermitian_weight (nky_local, 1)
    transforms: number of transform pairs so far, in double-precision equivalents (single precision counts ½)
    """

    def __init__(
        self,
        comm: MPI.Comm,
        shape: tuple[int, int],
        lengths: tuple[float, float] | None = None,
        threads: int | None = None,
        transform: str = "blocked",
        shared: bool = True,
    ) -> None:
        """lengths: None means the numbers of points (spacing 1).  threads: number of threads of this rank, None means
        `threads_per_rank()`.  transform: one of `cell.TRANSFORMS`.  shared: whether blocked transforms may use memory
        that the ranks of a node share.
        """
        nx, ny = (int(n) for n in shape)
        if min(nx, ny) < 1:
            raise InputError(f"grid: {nx} × {ny} points, at least 1 × 1 are needed")
        if comm.size > nx:
            raise InputError(f"grid: {comm.size} ranks for {nx} rows of points; use at most one rank per row")
        self.comm, self.shape = comm, (nx, ny)
        self.reduction = Reduction(comm)
        self.lengths = (float(nx), float(ny)) if lengths is None else (float(lengths[0]), float(lengths[1]))
        self.spacing = (self.lengths[0] / nx, self.lengths[1] / ny)
        self.pixel_area = self.spacing[0] * self.spacing[1]
        self.size = nx * ny
        self.layout = Layout(comm, slab_starts(nx, comm.size))
        self.rows, self.starts = self.layout.rows, self.layout.starts
        self.local_shape = (self.rows.stop - self.rows.start, ny)
        self.band = max(1, BAND // ny)
        self.columns = slab(ny // 2 + 1, comm.size, comm.rank)
        self.spectral_shape = (self.columns.stop - self.columns.start, nx)
        ky = np.arange(self.columns.start, self.columns.stop)
        self.qx = (2 * np.pi / self.lengths[0] * np.fft.fftfreq(nx, 1 / nx))[None, :]
        self.qy = (2 * np.pi / self.lengths[1] * ky)[:, None]
        self.hermitian_weight = np.where((ky == 0) | (2 * ky == ny), 1.0, 2.0)[:, None]
        # A small slab is not worth waking threads for.
        threads = self.asked_threads = threads_per_rank() if threads is None else threads
        self.threads = Threads(threads if self.local_shape[0] * ny >= 512 * 512 else 1)
        self.transforms = 0.0
        self._transform_name, self._shared = transform, shared
        self._strips: Strips | None = None
        self._planned: dict[np.dtype, Transform | LibraryTransform] = {}
        self._around: dict[tuple[int, int], RowPlan] = {}

    def q_squared(self, first: int = 0, stop: int | None = None) -> np.ndarray:
        """|q|² of each mode of this rank, or those of its columns first … stop−1: (columns, nx)."""
        return self.qx**2 + self.qy[first:stop] ** 2

    def transform(self, dtype: DTypeLike = np.float64) -> Transform | LibraryTransform:
        """The transform in that precision, planned on first use.  Collective on first use."""
        dtype = np.dtype(dtype)
        if dtype not in self._planned and self._transform_name == "mpi4py-fft":
            self._planned[dtype] = LibraryTransform(self.comm, self.shape, dtype, self.threads)
        elif dtype not in self._planned:
            if self._strips is None:
                self._strips = make_strips(self.comm, self.shape, self._shared)
            self._planned[dtype] = Transform(self._strips, self.shape, dtype, self.threads)
        return self._planned[dtype]

    def new_field(self, dtype: DTypeLike = np.float64) -> np.ndarray:
        """A new field (nx_local, ny), not yet set; of float32 it may be `widened`."""
        return new_field(self.local_shape, dtype)

    def forward(self, field: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Spectrum (nky_local, nx), unnormalised, of a field (nx_local, ny); in the field's precision.  Collective."""
        transform = self.transform(field.dtype)
        out = np.empty(self.spectral_shape, transform.complex) if out is None else out

        def keep(block: np.ndarray, first: int, stop: int) -> None:
            out[first:stop] = block

        self.read_spectrum(source(field), keep, field.dtype)
        return out

    def backward(self, spectrum: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Field (nx_local, ny) of a spectrum (nky_local, nx), with 1/N, so that backward(forward(u)) = u.
        Collective.
        """
        real = np.zeros((), spectrum.dtype).real.dtype
        out = np.empty(self.local_shape, real) if out is None else out
        normalisation = real.type(1 / self.size)

        def copy(block: np.ndarray, first: int, stop: int) -> None:
            np.multiply(spectrum[first:stop], normalisation, out=block)

        self.make_field(copy, sink(out), real)
        return out

    def read_spectrum(
        self, fill: RowAction, action: ColumnAction, dtype: DTypeLike = np.float64, count: int | None = None
    ) -> None:
        """Transform the rows that `fill` writes; call `action(block, first, stop)` on each block of their spectrum.
        Collective.

        count: the action is called for the first `count` ky of this rank only.
        """
        transform = self.transform(dtype)
        self.transforms += transform.cost / 2
        transform.rows_forward(fill)
        transform.columns(action, backward=False, count=count)

    def make_field(
        self,
        action: ColumnAction,
        drain: RowAction,
        dtype: DTypeLike = np.float64,
        between: Callable[[], None] | None = None,
    ) -> None:
        """Transform the spectrum that `action(block, first, stop)` writes; hand the field to `drain`, block by block.
        Collective.

        between: called once, when this rank has written its part of the spectrum and before `drain` gets the first
        row; may be collective.  No 1/N is applied.
        """
        transform = self.transform(dtype)
        self.transforms += transform.cost / 2
        transform.columns(action, forward=False)
        if between is not None:
            between()
        transform.rows_backward(drain)

    def convolve(self, fill: RowAction, action: ColumnAction, drain: RowAction, dtype: DTypeLike = np.float64) -> None:
        """Transform the rows that `fill` writes, let `action` change their spectrum in place, transform back, and hand
        the rows to `drain`.  No 1/N is applied.  Collective.
        """
        transform = self.transform(dtype)
        self.transforms += transform.cost
        transform.rows_forward(fill)
        transform.columns(action)
        transform.rows_backward(drain)

    def like(self, comm: MPI.Comm, shape: tuple[int, int], lengths: tuple[float, float]) -> SlabGrid:
        """Another grid, on the ranks of `comm`, with as many threads and the same kind of transforms as this one."""
        return SlabGrid(comm, shape, lengths, self.asked_threads, self._transform_name, self._shared)

    def fetch(self, field: np.ndarray, first: int, stop: int) -> np.ndarray:
        """Global rows first … stop−1 (periodic) of a distributed field; each rank may ask for a different range.
        Collective.
        """
        return self.layout.fetch(field, first, stop, self.threads)

    def around(self, margin: int, between: int = 0) -> RowPlan:
        """The plan to fetch `margin` rows before this rank's and as many after, periodic.  Collective on first use.

        between: number of rows that the target has between the two parts.
        """
        if (margin, between) not in self._around:
            first, stop = self.rows.start, self.rows.stop
            ranges = (first - margin, first), (stop, stop + margin)
            self._around[margin, between] = RowPlan(self.layout, ranges, (0, margin + between))
        return self._around[margin, between]

    def neighbours(self, fields: Sequence[np.ndarray], margin: int = 1) -> list[np.ndarray]:
        """The `margin` rows before this rank's and those after them, (2 margin, ny), of each field.  Collective."""
        exchange = Exchange(self.comm)
        found = [np.empty((2 * margin, *field.shape[1:]), field.dtype) for field in fields]
        for field, rows in zip(fields, found, strict=True):
            exchange.fetch(self.around(margin), field, rows)
        exchange.carry_out()
        return found

    @contextmanager
    def freed(self) -> Iterator[None]:
        """Frees the memory of the transforms after a block, also after an error that all ranks raise.  Collective.

        After any other error it does not: the ranks that have none would not come.
        """
        try:
            yield
        except BaseException as error:
            if isinstance(error, GeneratorExit) or shared(self.comm, error):
                self.free()
            raise
        self.free()

    def free(self) -> None:
        """Free the memory of the transforms; the next use allocates it again.  Collective."""
        for transform in self._planned.values():
            transform.free()
        self._planned = {}
        if self._strips is not None:
            self._strips.free()
            self._strips = None
