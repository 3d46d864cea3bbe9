"""`SlabGrid`: a grid in slabs of rows, its wave numbers and transforms.

Symbols: nx × ny points on lx × ly; fields are float64 of shape (nx_local, ny), axis 0 (x) split over the ranks.
Transforms run on the torus of the `Domain`, of Nx × Ny modes: those of the points in a periodic cell, more where fields
end at the border.  Spectra are complex of shape (nky_local, Nx): axis 0 is ky ≥ 0 split over the ranks, axis 1 is kx in
FFT order, so spectra are *transposed*.  A mode with 0 < ky < Ny/2 stands for itself and its conjugate: Hermitian weight
2, else 1.

DFT convention: `forward` is the plain sum over points, `backward` carries 1/(Nx Ny).  The methods that take callbacks
(`make_field`, `convolve`) do not apply that factor; one of their callbacks has to.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from pgfmd.errors import InputError
from pgfmd.grid.aligned import new_field
from pgfmd.grid.domain import PERIODIC, Domain
from pgfmd.grid.grid_cost import ROOM
from pgfmd.grid.library_transform import LibraryTransform
from pgfmd.grid.transforms import ColumnAction, RowAction, Transform, WholeTransform, sink, source
from pgfmd.grid.transpose import Strips, make_strips
from pgfmd.options.text import counted
from pgfmd.parallel.collectives import Reduction, shared, slab, slab_starts
from pgfmd.parallel.layout import Exchange, Layout, RowPlan
from pgfmd.parallel.mpi import MPI
from pgfmd.parallel.threads import Threads, threads_per_rank

BAND = 1 << 16  # points of a band of rows: the bands of a few fields fit into the cache together
# One rank keeps transforms for the next grid alike: of so many modes at most, those of the last grids freed.  Each
# belongs to one grid at a time, so that threads may solve at once.
MOST_MODES, SPARES = 1 << 16, 16
AnyTransform = Transform | WholeTransform | LibraryTransform
_spares: list[tuple[Hashable, Strips | None, dict[np.dtype, AnyTransform]]] = []
_lock = threading.Lock()


def transform_work(shape: tuple[int, int], torus: tuple[int, int]) -> float:
    """Work of a pair of transforms of nx × ny points on a torus of Nx × Ny modes, over that of a periodic pair: nx rows
    of Ny and Ny columns of Nx numbers, for nx rows of ny and ny columns of nx.
    """
    return torus[1] / shape[1] * (1 + torus[0] / shape[0]) / 2


@lru_cache(maxsize=16)
def _waves(torus: tuple[int, int], period: tuple[float, float], first: int, stop: int) -> tuple[np.ndarray, ...]:
    """qx, qy, hermitian_weight and even_weight of a `SlabGrid` with columns first … stop−1; to read."""
    (mx, my), ky, kx = torus, np.arange(first, stop), np.arange(torus[0] // 2 + 1)
    qx = (2 * np.pi / period[0] * np.fft.fftfreq(mx, 1 / mx))[None, :]
    weights = (np.where((k == 0) | (2 * k == m), 1.0, 2.0) for k, m in ((ky, my), (kx, mx)))
    return qx, (2 * np.pi / period[1] * ky)[:, None], next(weights)[:, None], next(weights)


class SlabGrid:
    """A grid whose rows are split over the ranks of `comm`.  Making one sends nothing; its first use makes transforms.

    Attributes
    ----------
    comm, shape (nx, ny), lengths (lx, ly), spacing (ax, ay), pixel_area
    rows: slice of the global rows that this rank holds;  starts: first row of each rank, and nx;  layout: both
    size: number of points;  domain;  torus (Nx, Ny), modes: their number, period: sides of the torus
    local_shape: (nx_local, ny);  spectral_shape: (nky_local, Nx);  band: number of rows in a band (`BAND`)
    qx (1, Nx), qy (nky_local, 1): wave numbers in radians per length;  hermitian_weight (nky_local, 1)
    even_weight (Nx // 2 + 1,): 2 for a kx > 0 that stands for itself and −kx, else 1
    transforms: number of transform pairs so far, in double-precision equivalents (single precision counts ½)
    storage: precision of heights, pressure and gap, set by who makes the grid; only a hard wall takes float32
    """

    storage: type[np.float32] | type[np.float64] = np.float64

    def __init__(
        self,
        comm: MPI.Comm,
        shape: tuple[int, int],
        lengths: tuple[float, float] | None = None,
        threads: int | None = None,
        transform: str = "blocked",
        domain: Domain = PERIODIC,
    ) -> None:
        """lengths: None means the numbers of points (spacing 1).  threads: of this rank, None: `threads_per_rank()`.
        transform: one of `cell.TRANSFORMS`, or "exchanged": blocked, without memory that the ranks of a node share.
        """
        nx, ny = (int(n) for n in shape)
        if min(nx, ny) < 1:
            raise InputError(f"grid: {nx} × {ny} points, at least 1 × 1 are needed")
        if comm.size > nx:
            raise InputError(f"grid: {comm.size} ranks for {counted(nx, 'row')} of points; at most one rank per row")
        self.comm, self.shape = comm, (nx, ny)
        self.reduction = Reduction(comm)
        self.lengths = (float(nx), float(ny)) if lengths is None else (float(lengths[0]), float(lengths[1]))
        self.spacing = (self.lengths[0] / nx, self.lengths[1] / ny)
        self.pixel_area = self.spacing[0] * self.spacing[1]
        self.size, self.domain = nx * ny, domain
        if transform == "mpi4py-fft" and not domain.wraps:
            raise InputError('solver.transform = "mpi4py-fft": does not pad; with boundary = "open" take "blocked"')
        self.torus = domain.torus(self.shape, self.spacing)
        self.modes, self.work = self.torus[0] * self.torus[1], transform_work(self.shape, self.torus)
        padded = self.torus[0] * self.spacing[0], self.torus[1] * self.spacing[1]
        self.period = self.lengths if domain.wraps else padded
        self.layout = Layout(comm, slab_starts(nx, comm.size))
        self.rows, self.starts = self.layout.rows, self.layout.starts
        self.local_shape = (self.rows.stop - self.rows.start, ny)
        self.band = max(1, BAND // ny)
        mx, my = self.torus
        self.columns = slab(my // 2 + 1, comm.size, comm.rank)
        self.spectral_shape = (self.columns.stop - self.columns.start, mx)
        waves = _waves(self.torus, self.period, self.columns.start, self.columns.stop)
        self.qx, self.qy, self.hermitian_weight, self.even_weight = waves
        # A small slab is not worth waking threads for.
        threads = self.asked_threads = threads_per_rank() if threads is None else threads
        self.threads = Threads(threads if self.local_shape[0] * ny >= 512 * 512 else 1)
        self.transforms = 0.0
        self._transform_name = transform
        alone = comm.size == 1 and self.modes <= MOST_MODES and transform != "mpi4py-fft"  # it has to be freed
        self._kind: Hashable = (self.shape, self.torus, transform, self.threads.count) if alone else None
        self._strips: Strips | None = None
        self._planned: dict[np.dtype, AnyTransform] = {}
        self.tables: dict[Hashable, Any] = {}  # symbols of solids, kept for the next load
        self._around: dict[tuple[int, int], RowPlan] = {}

    def q_squared(self, first: int = 0, stop: int | None = None) -> np.ndarray:
        """|q|² of each mode of this rank, or those of its columns first … stop−1: (columns, Nx)."""
        return self.qx**2 + self.qy[first:stop] ** 2

    def transform(self, dtype: DTypeLike = np.float64) -> AnyTransform:
        """The transform in that precision, planned on first use.  Collective on first use."""
        dtype = np.dtype(dtype)
        if self._kind is not None and not self._planned:
            self._take_spare()
        if dtype not in self._planned and self._transform_name == "mpi4py-fft" and self.shape[1] > 2:  # else it fails
            self._planned[dtype] = LibraryTransform(self.comm, self.shape, dtype, self.threads)
        elif dtype not in self._planned and self._kind is not None and self.domain.wraps:
            self._planned[dtype] = WholeTransform(self.shape, dtype)
        elif dtype not in self._planned:
            if self._strips is None:
                place = self.shape[0], self.torus[1]
                self._strips = make_strips(self.comm, place, self._transform_name != "exchanged")
            self._planned[dtype] = Transform(self._strips, self.shape, self.torus, dtype, self.threads)
        return self._planned[dtype]

    def new_field(self, dtype: DTypeLike | None = None) -> np.ndarray:
        """A new field (nx_local, ny), not set, by default of `storage`; float32 may be `widened` if that is double."""
        return new_field(self.local_shape, dtype or self.storage, self.storage is np.float64)

    def forward(self, field: np.ndarray) -> np.ndarray:
        """Spectrum (nky_local, Nx), unnormalised, of a field (nx_local, ny); in the field's precision.  Collective."""
        out = np.empty(self.spectral_shape, np.result_type(field.dtype, np.complex64))

        def keep(block: np.ndarray, first: int, stop: int) -> None:
            out[first:stop] = block

        self.read_spectrum(source(field), keep, field.dtype)
        return out

    def backward(self, spectrum: np.ndarray) -> np.ndarray:
        """Field (nx_local, ny) of a spectrum (nky_local, Nx), with 1/(Nx Ny): backward(forward(u)) = u.  Collective."""
        real = np.zeros((), spectrum.dtype).real.dtype
        out, normalisation = np.empty(self.local_shape, real), real.type(1 / self.modes)

        def copy(block: np.ndarray, first: int, stop: int) -> None:
            np.multiply(spectrum[first:stop], normalisation, out=block)

        self.make_field(copy, sink(out), real)
        return out

    def read_spectrum(
        self, fill: RowAction, action: ColumnAction, dtype: DTypeLike = np.float64, count: int | None = None
    ) -> None:
        """Transform the rows that `fill` writes; hand their spectrum to `action(block, first, stop)`.  Collective.

        count: the action is called for the first `count` ky of this rank only.
        """
        transform = self.transform(dtype)
        self.transforms += self.work * transform.cost / 2
        transform.rows_forward(fill)
        transform.columns(action, backward=False, count=count)

    def make_field(
        self,
        action: ColumnAction,
        drain: RowAction,
        dtype: DTypeLike = np.float64,
        between: Callable[[], None] | None = None,
    ) -> None:
        """Transform the spectrum that `action(block, first, stop)` writes; hand the rows to `drain`.  Collective.

        between: called once this rank has written its spectrum, before `drain`; may be collective.  No 1/N is applied.
        """
        transform = self.transform(dtype)
        self.transforms += self.work * transform.cost / 2
        transform.columns(action, forward=False)
        if between is not None:
            between()
        transform.rows_backward(drain)

    def convolve(
        self,
        fill: RowAction,
        action: ColumnAction,
        drain: RowAction,
        dtype: DTypeLike = np.float64,
        filled: tuple[int, int] | None = None,
    ) -> None:
        """Transform the rows that `fill` writes, let `action` change their spectrum in place, transform back, and hand
        the rows to `drain`.  No 1/N is applied.  filled: (first, stop) of the global rows that are not 0, if not all.
        Collective.
        """
        transform, (first, stop) = self.transform(dtype), filled or (0, self.shape[0])
        transform.rows_forward(fill, (first - self.rows.start, stop - self.rows.start))
        zeros = 1 - (stop - first) / self.shape[0]  # whose transforms are a quarter of a pair's in a periodic cell
        self.transforms += (self.work - zeros * self.torus[1] / self.shape[1] / 4) * transform.cost
        transform.columns(action)
        transform.rows_backward(drain)

    def like(
        self, comm: MPI.Comm, shape: tuple[int, int], lengths: tuple[float, float], domain: Domain | None = None
    ) -> SlabGrid:
        """Another grid on the ranks of `comm`, with threads, transforms and, unless given, the domain of this one."""
        return SlabGrid(comm, shape, lengths, self.asked_threads, self._transform_name, domain or self.domain)

    def fetch(self, field: np.ndarray, first: int, stop: int) -> np.ndarray:
        """Global rows first … stop−1 of a distributed field; each rank may ask for a different range.  Beyond a border
        these are the rows at the opposite one, or where fields do not wrap copies of the last row.  Collective.
        """
        if self.domain.wraps:
            return self.layout.fetch(field, first, stop, self.threads)
        rows = np.clip(np.arange(first, stop), 0, self.shape[0] - 1)
        low, high = (int(rows[0]), int(rows[-1]) + 1) if len(rows) else (0, 0)
        found = self.layout.fetch(field, low, high, self.threads)
        return found if high - low == len(rows) else found[rows - low]

    def around(self, margin: int, between: int = 0) -> RowPlan:
        """The plan to fetch `margin` rows before and after this rank's, where the domain has any.  Collective on
        first use.

        between: number of rows that the target has between the two parts.
        """
        if (margin, between) not in self._around:
            first, stop = self.rows.start, self.rows.stop
            low, high = first - margin, stop + margin
            if not self.domain.wraps:
                low, high = max(low, 0), min(high, self.shape[0])
            places = low - first + margin, margin + between
            self._around[margin, between] = RowPlan(self.layout, ((low, first), (stop, high)), places)
        return self._around[margin, between]

    def neighbours(
        self, fields: Sequence[np.ndarray], margin: int = 1, beyond: Sequence[float] = ()
    ) -> list[np.ndarray]:
        """The `margin` rows before this rank's and those after them, (2 margin, ny), of each field.  Collective.

        beyond: what the fields are taken for where the domain has no such rows; 0 if not given.
        """
        exchange, found = Exchange(self.comm), []
        for field, value in zip(fields, beyond or [0.0] * len(fields), strict=True):
            found.append(np.full((2 * margin, *field.shape[1:]), value, field.dtype))
            exchange.fetch(self.around(margin), field, found[-1])
        exchange.carry_out()
        return found

    @contextmanager
    def freed(self) -> Iterator[SlabGrid]:
        """Frees the memory of the transforms after a block, also after an error that all ranks raise.  Collective.

        After any other error it does not: the ranks that have none would not come.
        """
        try:
            yield self
        except BaseException as error:
            if isinstance(error, GeneratorExit) or shared(self.comm, error):
                self.free()
            raise
        self.free()

    def _take_spare(self) -> None:
        """Takes the transforms that a grid alike has freed, if there are any."""
        with _lock:
            for place in (i for i, spare in enumerate(_spares) if spare[0] == self._kind):
                _, self._strips, self._planned = _spares.pop(place)
                return

    def make_room(self) -> None:
        """Frees the memory of the transforms if ranks have more than `ROOM` points.  Collective."""
        if self.size > ROOM * self.comm.size:
            self.free()

    def free(self) -> None:
        """Free the memory of the transforms, or keep them for a grid alike; the next use gets new ones.  Collective."""
        if self._kind is not None and self._planned:
            with _lock:
                _spares.append((self._kind, self._strips, self._planned))
                del _spares[:-SPARES]
            self._strips, self._planned = None, {}
        for transform in self._planned.values():
            if isinstance(transform, LibraryTransform):
                transform.free()
        self._planned = {}
        if self._strips is not None:
            self._strips.free()
            self._strips = None
