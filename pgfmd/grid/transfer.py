"""Coarser grids, on fewer ranks so that messages do not dominate; restriction and interpolation, local, or by the modes
of a periodic cell.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import TypeVar

import numpy as np

from pgfmd.grid import kernels
from pgfmd.grid.aligned import new_field
from pgfmd.grid.domain import Domain
from pgfmd.grid.grid_cost import LEAST_ROWS, holders
from pgfmd.grid.kernels import TAPS
from pgfmd.grid.slab_grid import SlabGrid, transform_work
from pgfmd.grid.transforms import sink, source
from pgfmd.parallel.collectives import await_all, mark_shared, shared, slab_starts, team_of
from pgfmd.parallel.layout import Exchange, Layout, Range, RowPlan

T = TypeVar("T")


class SubGrid:
    """A grid on some of the ranks of a larger one.  Collective to make.

    Attributes: shape, size, spacing, domain, torus and work as of a `SlabGrid`; layout, of its rows over the ranks of
    the larger grid; local_shape of a field on this rank, which may have no rows; grid: None on ranks without rows.
    """

    def __init__(
        self, parent: SlabGrid, shape: tuple[int, int], lengths: tuple[float, float], least: int = LEAST_ROWS
    ) -> None:
        """least: rows per rank."""
        nx, ny = shape
        count = holders(shape, parent.comm.size, least)
        self.comm, self.shape, self.size = parent.comm, shape, nx * ny
        self.spacing = lengths[0] / nx, lengths[1] / ny
        self.domain = parent.domain
        self.torus = self.domain.torus(shape, self.spacing)
        self.work = transform_work(shape, self.torus)
        self.layout = Layout.spread(parent.comm, nx, count)
        self.local_shape = self.layout.rows.stop - self.layout.rows.start, ny
        team = team_of(parent.comm, count)
        self.grid = None if team is None else parent.like(team, shape, lengths)

    @classmethod
    def coarse(cls, fine: SlabGrid, factor: int = 2) -> SubGrid:
        """The grid of the same domain with 1/factor of the points each way (rounded up).  Collective."""
        nx, ny = -(-fine.shape[0] // factor), -(-fine.shape[1] // factor)
        if fine.domain.wraps:
            return cls(fine, (nx, ny), fine.lengths)
        return cls(fine, (nx, ny), (factor * nx * fine.spacing[0], factor * ny * fine.spacing[1]))

    def on_all(self, work: Callable[[SlabGrid], T], without_rows: Callable[[T], T] = lambda value: value) -> T:
        """`work(grid)` on ranks that hold the grid; others get `without_rows` of the value of rank 0.  Collective.

        Errors that all ranks of `work` raise reach all ranks; a rank that fails alone raises at once, since the others
        may wait for it in `work`.
        """
        if self.grid is not None and self.grid.comm.size == self.comm.size:
            return work(self.grid)
        value: T | None = None
        failure: Exception | None = None
        if self.grid is not None:
            try:
                value = work(self.grid)
            except Exception as error:
                if not shared(self.grid.comm, error):
                    raise
                failure = error
        await_all(self.comm)
        sent = None if value is None else without_rows(value), failure
        sent = self.comm.bcast(sent if self.comm.rank == 0 else None)
        failure = sent[1] if failure is None else failure
        if failure is not None:
            raise mark_shared(self.comm, failure)
        return value if self.grid is not None else sent[0]  # type: ignore[return-value]  # one of them is a T

    def free(self) -> None:
        """Frees the memory of the transforms.  Collective."""
        if self.grid is not None:
            self.grid.free()


def restrict(fine: SlabGrid, coarse: SubGrid, field: np.ndarray) -> np.ndarray:
    """A field of a periodic cell on a coarse grid, (nx_coarse_local, ny_coarse): its modes below the Nyquist modes
    there.  Collective.
    """
    nx, ny = coarse.shape
    kx_max, ky_count = (nx - 1) // 2, (ny - 1) // 2 + 1  # Nyquist modes are left out
    starts = np.minimum(slab_starts(fine.shape[1] // 2 + 1, fine.comm.size), ky_count)
    mine, scale = np.empty((starts[fine.comm.rank + 1] - starts[fine.comm.rank], nx), np.complex128), 1 / fine.size

    def keep(block: np.ndarray, first: int, stop: int) -> None:
        part = mine[first:stop]
        np.multiply(block[:, : kx_max + 1], scale, out=part[:, : kx_max + 1])
        part[:, kx_max + 1 : nx - kx_max] = 0
        if kx_max:
            np.multiply(block[:, -kx_max:], scale, out=part[:, -kx_max:])

    fine.read_spectrum(source(field), keep, count=len(mine))
    columns = slice(0, 0) if coarse.grid is None else coarse.grid.columns
    low, high = min(columns.start, ky_count), min(columns.stop, ky_count)
    spectrum = Layout(fine.comm, starts).fetch(mine, low, high, fine.threads)
    out = np.empty(coarse.local_shape)

    def copy(block: np.ndarray, first: int, stop: int) -> None:
        part = spectrum[first:stop]
        block[: len(part)] = part
        block[len(part) :] = 0

    if coarse.grid is not None:
        coarse.grid.make_field(copy, sink(out))
    return out


def interpolate(coarse: SlabGrid, fine: SlabGrid, field: np.ndarray) -> np.ndarray:
    """A field (nx_local, ny) of a coarse grid on a finer one of the same cell and ranks (nx_fine_local, ny_fine): it
    keeps its modes and gets no others.  Half of a Nyquist mode goes to either sign of its wave number.  Collective.
    """
    nx, ny = coarse.shape
    starts = slab_starts(ny // 2 + 1, coarse.comm.size)
    low, high = (min(ky, starts[-1]) for ky in (fine.columns.start, fine.columns.stop))
    spectrum = Layout(coarse.comm, starts).fetch(coarse.forward(field), low, high, coarse.threads)
    spectrum /= coarse.size
    if ny % 2 == 0 and low <= ny // 2 < high:
        spectrum[ny // 2 - low] /= 2
    positive, negative = (nx + 1) // 2, (nx - 1) // 2  # modes kx ≥ 0 and kx < 0, less that of Nyquist
    out = np.empty(fine.local_shape)

    def copy(block: np.ndarray, first: int, stop: int) -> None:
        part = spectrum[first:stop]
        block[...] = 0
        inner = block[: len(part)]
        inner[:, :positive] = part[:, :positive]
        inner[:, block.shape[1] - negative :] = part[:, nx - negative :]
        if nx % 2 == 0:
            inner[:, nx // 2] = inner[:, -(nx // 2)] = part[:, nx // 2] / 2

    fine.make_field(copy, sink(out))
    return out


def restrict_locally(fine: SlabGrid, coarse: SubGrid, field: np.ndarray) -> np.ndarray:
    """The field on a coarse grid of half as many points or more each way (nx_coarse_local, ny_coarse), without
    transforms (where fields do not wrap, of half as many): means of fine points, weighted by the transpose of
    `Interpolation`, in single precision.  Collective.
    """
    domain = fine.domain
    (first, weights, _), (_, across, columns) = (
        _means(domain, *counts) for counts in zip(fine.shape, coarse.shape, strict=True)
    )
    start, stop = coarse.layout.rows.start, coarse.layout.rows.stop
    low, high = (int(first[start]), int(first[stop - 1]) + TAPS) if start < stop else (0, 0)
    below, above = low, high  # where fields do not wrap, these rows are mirrored into low … high−1
    if not domain.wraps:
        low, high = max(low, 0), min(high, fine.shape[0])
    rows, begin, end = np.empty((high - low, coarse.shape[1]), np.float32), fine.rows.start, fine.rows.stop
    if low <= begin and end <= high:  # this rank's rows are made where they are needed
        narrow, ranges, places = rows[begin - low : end - low], ((low, begin), (end, high)), (0, end - low)
    else:
        narrow, ranges, places = np.empty((len(field), rows.shape[1]), np.float32), ((low, high), (high, high)), (0, 0)
    fine.threads.deal(
        lambda a, b: kernels.combine_columns(field[a:b], columns, across, narrow[a:b], domain.wraps), len(field)
    )
    RowPlan(fine.layout, ranges, places).fetch(narrow, rows)
    if (below, above) != (low, high):
        rows, low = rows[domain.indices(np.arange(below, above), fine.shape[0]) - low], below
    out = new_field(coarse.local_shape)
    first, weights = first[start:stop] - low, weights[start:stop]
    fine.threads.deal(lambda a, b: kernels.combine_rows(rows, first[a:b], weights[a:b], out[a:b]), len(out))
    return out


class Interpolation:
    """Local cubic interpolation of coarse fields to the rows of a fine grid.  Collective to make.

    `rows` gives a few fine rows of a field at a time, in its precision, so that no fine array is needed.
    """

    def __init__(self, coarse: SubGrid, fine: SlabGrid, fields: list[np.ndarray]) -> None:
        """fields: (nx_coarse_local, ny_coarse), all in the same precision."""
        domain, real = fine.domain, fields[0].dtype
        index, weights = _weights(domain, (fine.rows.start, fine.rows.stop), (fine.shape[0], coarse.shape[0]), real)
        self._y = _weights(domain, (0, fine.shape[1]), (fine.shape[1], coarse.shape[1]), real)
        low, high = int(index[0]) - 1, int(index[-1]) + 5
        self._x, self._wraps, wanted = (index - low, weights), domain.wraps, np.arange(low, high)
        if not domain.wraps:
            wanted = domain.indices(wanted, coarse.shape[0])
            low, high = int(wanted.min()), int(wanted.max()) + 1
        # Rows that this rank holds are read where they are; only those before and after them are fetched.
        first = min(max(coarse.layout.rows.start, low), high)
        stop = min(max(coarse.layout.rows.stop, first), high)
        places = np.arange(low, high) - coarse.layout.rows.start
        away = np.r_[: first - low, stop - low : high - low]
        places[away] = -1 - np.arange(len(away))
        places = places[wanted - low]
        others = [np.empty((len(away), coarse.shape[1]), field.dtype) for field in fields]
        plan, exchange = RowPlan(coarse.layout, [(low, first), (stop, high)]), Exchange(fine.comm)
        for field, rows in zip(fields, others, strict=True):
            exchange.fetch(plan, field, rows)
        exchange.carry_out()
        self._fields = [(field, rows, places) for field, rows in zip(fields, others, strict=True)]
        self._buffer = np.empty((fine.threads.count, len(fields), fine.band, fine.shape[1]), real)

    def rows(self, which: int, first: int, stop: int, thread: int = 0) -> np.ndarray:
        """Rows first … stop−1 (local to the fine grid; at most its `band`) of field number `which`, shape
        (stop − first, ny_fine).  The next call of that thread overwrites them.
        """
        index, weights = (each[first:stop] for each in self._x)
        out, (own, others, places) = self._buffer[thread, which, : stop - first], self._fields[which]
        needed = places[index[0] : index[-1] + 4]
        if needed.min() >= 0 and needed[-1] - needed[0] == len(needed) - 1:
            coarse = own[needed[0] : needed[-1] + 1]
        else:
            coarse = np.array([own[place] if place >= 0 else others[-1 - place] for place in needed])
        kernels.interpolate_rows(coarse, (index - index[0], weights), self._y, self._wraps, out)
        return out


@lru_cache(maxsize=16)
def _means(domain: Domain, fine: int, coarse: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For each coarse point, the first of the fine points within two coarse spacings, their weights (coarse, TAPS),
    whose sum is 1, and where they are in the domain; to read.
    """
    at = np.arange(coarse)
    if domain.wraps:
        first, middle = (at - 2) * fine // coarse + 1, at * (fine / coarse)
    else:
        first, middle = 2 * at - 3, 2 * at + domain.first_point(2.0)
    x = np.abs(first[:, None] + np.arange(TAPS) - middle[:, None]) / domain.coarse_spacing(fine, coarse)
    weights = np.where(x < 1, (1 - x**2) * (2 - x) / 2, (1 - x) * (2 - x) * (3 - x) / 6 * (x < 2))
    places = domain.indices(np.add.outer(first, np.arange(TAPS)), fine).astype(np.int32)
    return first, (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32), places


@lru_cache(maxsize=16)
def _weights(domain: Domain, points: Range, counts: tuple[int, int], real: np.dtype) -> tuple[np.ndarray, np.ndarray]:
    """For these of so many fine points, the first of the four coarse points around each, and their Lagrange weights
    (len(points), 4); to read.  counts: of fine and coarse points.
    """
    ratio = domain.coarse_spacing(*counts)
    at = (np.arange(*points) - domain.first_point(ratio)) / ratio
    base = np.floor(at).astype(np.int64)
    t = (at - base)[:, None]
    a, b, c, d = t + 1, t, t - 1, t - 2
    return base - 1, np.hstack([-b * c * d / 6, a * c * d / 2, -a * b * d / 2, a * b * c / 6]).astype(real)
