"""The heights of a run, measured once for all loads; spectra and autocorrelations of fields, averaged over direction.

A field passes through the grid's transform in blocks; each block of modes is squared and summed into bins while it is
in the cache, and goes back to real space as the autocorrelation, which is summed into bins row by row.  One forward
transform gives a spectrum, one more backward the autocorrelation too.
"""

import logging
import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np

from pgfmd.errors import InputError, SolverError
from pgfmd.grid.cell import Cell
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.transforms import ColumnAction, RowAction, source
from pgfmd.observables.contact_area import RESOLVED
from pgfmd.observables.observable import OBSERVABLES, Observable, Spectrum
from pgfmd.observables.schema import Groups
from pgfmd.parallel.collectives import shared
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.dispatch import solve_contact
from pgfmd.solvers.options import Solver
from pgfmd.solvers.solution import ContactSolution, Solve


@dataclass(frozen=True)
class Correlations:
    """Second-order statistics of one field f; the same on all ranks.  f̃(q) = (1/N) Σ_r f(r) exp(−iq·r)."""

    power: np.ndarray  # Σ |f̃|² over the modes below the first edge (q = 0 too), in each bin, beyond: (m + 2,)
    acf: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
    """Σ C(Δr) over the points of each bin of lags (k + 2,); C(Δx, 0) (nx//2 + 1,); C(0, Δy) (ny//2 + 1,)."""


class Rings:
    """Bins of ρ = √(along[i] + across[j]) for the entries (j, i) of a distributed array.  Collective to make.

    Bin b holds edges[b] < ρ ≤ edges[b+1].
    along (n,), across (this rank's rows,): squares;  weight (this rank's rows,): factor on the entries of each row.
    Sums have shape (edges + 1,): below the first edge, in each bin, beyond the last edge.
    """

    def __init__(self, grid: SlabGrid, along: np.ndarray, across: np.ndarray, weight: np.ndarray, edges: np.ndarray):
        self.grid, self.along, self.across, self.weight = grid, along, across, np.ascontiguousarray(weight)
        self.edges = np.asarray(edges)
        self._squares = np.sign(edges) * np.square(edges)
        counts, roots = dict[int, np.ndarray](), dict[int, np.ndarray]()

        def part(first: int, stop: int) -> None:
            place = np.sqrt(along + across[first:stop, None])
            counts[first], roots[first] = self.sums(np.ones_like(place), first, stop), self.sums(place, first, stop)

        grid.threads.share(lambda _, first, stop: part(first, stop), len(across), ROWS)
        self.count, self.roots = self.total(counts), self.total(roots)

    def sums(self, values: np.ndarray, first: int, stop: int) -> np.ndarray:
        """Weighted sums over the bins of rows first … stop − 1 of this rank, values (stop − first, n)."""
        n, out = len(self.along), np.zeros(len(self.edges) + 1)
        half = self.along[: n // 2 + 1]  # rises; along[n − i] = along[i]
        folded = values[:, : n // 2 + 1].copy()
        folded[:, 1 : (n + 1) // 2] += values[:, : n // 2 : -1]
        for row, square, weight in zip(folded, self.across[first:stop], self.weight[first:stop], strict=True):
            begins = np.searchsorted(half, self._squares - square, side="right")
            begins, ends = np.concatenate([[0], begins]), np.append(begins, len(half))
            filled = begins < ends
            out[filled] += weight * np.add.reduceat(row, begins[filled])
        return out

    def total(self, parts: dict[int, np.ndarray]) -> np.ndarray:
        """Sum of the parts over blocks, in the order of their rows, and over the ranks.  Collective."""
        return self.grid.reduction.sums_of_blocks(parts, len(self.edges) + 1)

    def means(self, sums: np.ndarray, place: str) -> dict[str, np.ndarray]:
        """Means over the bins that hold something: mean ρ as `place`, value, count; and edges of all bins."""
        inner = slice(1, len(self.edges))
        filled = self.count[inner] > 0
        count, roots, sums = (entry[inner][filled] for entry in (self.count, self.roots, sums))
        return {place: roots / count, "value": sums / count, "count": count, "edges": self.edges}


def mode_rings(grid: SlabGrid, edges: np.ndarray) -> Rings:
    """Bins of |q| for the modes of a grid.  Collective."""
    return Rings(grid, grid.qx[0] ** 2, grid.qy[:, 0] ** 2, grid.hermitian_weight[:, 0], edges)


def lag_rings(grid: SlabGrid, edges: np.ndarray) -> Rings:
    """Bins of the periodic distance |Δr| for the points of a grid.  Collective."""
    x, y = (np.minimum(np.arange(n), n - np.arange(n)) * step for n, step in zip(grid.shape, grid.spacing, strict=True))
    return Rings(grid, y**2, x[grid.rows] ** 2, np.ones(grid.local_shape[0]), edges)


def squared(block: np.ndarray) -> np.ndarray:
    """|z|² of a block of modes, real, in its memory; the block itself becomes |z|² + 0i."""
    parts = block.view(np.float64).reshape(*block.shape, 2)
    np.multiply(parts, parts, out=parts)
    parts[..., 0] += parts[..., 1]
    parts[..., 1] = 0
    return parts[..., 0]


def correlate(
    grid: SlabGrid, fill: RowAction, modes: Rings, lags: Rings | None = None, watch: ColumnAction | None = None
) -> Correlations:
    """Spectrum, and with `lags` autocorrelation ⟨f(r) f(r + Δr)⟩, of the field whose rows `fill` makes.  Collective.

    One forward transform (modes beyond the last bin may be left out), and one backward for the autocorrelation.
    watch(power, first, stop) sees each block N²|f̃|² (stop − first, nx), on any thread.
    """
    square_size = float(grid.size) ** 2
    power: dict[int, np.ndarray] = {}

    def square(block: np.ndarray, first: int, stop: int) -> None:
        values = squared(block)
        power[first] = modes.sums(values, first, stop)
        if watch is not None:
            watch(values, first, stop)

    if lags is None:
        count = None if watch else int(np.searchsorted(grid.qy[:, 0], modes.edges[-1], side="right"))
        grid.read_spectrum(fill, square, count=count)  # what lies beyond all bins need not be transformed along x
        return Correlations(modes.total(power) / square_size)
    sums: dict[int, np.ndarray] = {}
    column, row = np.empty(grid.local_shape[0]), np.empty(grid.shape[1])

    def collect(first: int, stop: int, rows: np.ndarray) -> None:
        rows /= square_size
        sums[first] = lags.sums(rows, first, stop)
        column[first:stop] = rows[:, 0]
        if first == 0:
            row[:] = rows[0]

    grid.convolve(fill, square, collect)
    grid.comm.Bcast(row)  # that of rank 0, which holds Δx = 0
    (nx, ny), counts = grid.shape, np.diff(grid.starts)
    along_x = np.empty(nx)
    grid.comm.Allgatherv(column, [along_x, counts])
    acf = lags.total(sums), along_x[: nx // 2 + 1], row[: ny // 2 + 1]
    return Correlations(modes.total(power) / square_size, acf)


def along_axis(grid: SlabGrid, values: np.ndarray, axis: int) -> dict[str, np.ndarray]:
    """An autocorrelation along an axis as r, value, count and edges, one point in each bin of one grid spacing."""
    step = grid.spacing[axis]
    steps = np.arange(len(values) + 1)
    return {"r": steps[:-1] * step, "value": values, "count": np.ones(len(values)), "edges": (steps - 0.5) * step}


def indicator(field: np.ndarray, threshold: float) -> RowAction:
    """Fills blocks of rows with 1 where the field is above the threshold, and 0 elsewhere."""

    def fill(first: int, stop: int, rows: np.ndarray) -> None:
        np.greater(field[first:stop], threshold, out=rows)

    return fill


LARGEST = 1e140  # range of heights whose squares, times those of the number of points, are finite
log = logging.getLogger("pgfmd")
ROWS = 64  # of modes or points that are binned at a time, where no block is given
BEYOND = 0.05
"""Share of the mean square slope in waves beyond RESOLVED above which the grid does not resolve the surface.  Roughness
of λ_s = 1, 2 and 2.5 pixels has .47, .37 and .15 (H = .3) to .10, .08 and .03 (H = .95), of 3 pixels at most .02; a
paraboloid with its kinks at the cell's edges has 2/n."""


FURTHER = 1e-6
"""Certified error of further contacts, those of low-passed surfaces: their area is then within .1 % of the converged
one, mostly within .03 %.  Measured on eight surfaces of 256² and 1024² points; with 1e-5 areas were up to .3 % too
small, with 1e-4 up to .9 %."""


class RoughSurface:
    """The rigid surface of several contacts: what is measured on it once, and what is asked of each.  Collective.

    Making one takes half a transform, or a whole one if autocorrelations are asked for.

    problem: its heights are kept, not copied; its load does not matter.  cutoff: wave number beyond which the surface
    has no modes; None: not known, every mode of the grid may count.  solve: solves further contacts; None: the first
    method of the law.  fields: those that observables are to keep.

    asked: the observables by name, in the order of their measurement.  edges: of the bins of the wave number;  lags:
    bins of the distance, None if no autocorrelation is asked for.  seconds: time spent so far on each observable; work
    that several share is counted for the first of them.  rms_slope: √Σ q²|h̃|².  roughness: √(Σ q⁴|h̃|² / Σ q²|h̃|²) in
    radians per pixel, curvature over slope.  is_smooth: whether the grid resolves the surface.
    """

    def __init__(
        self,
        problem: ContactProblem,
        observables: Iterable[Observable] = (),
        cutoff: float | None = None,
        solve: Solve | None = None,
        fields: Iterable[str] = (),
    ) -> None:
        self.problem, self.grid, self.heights, self.cutoff = problem, problem.grid, problem.heights, cutoff
        size = self.grid.reduction.max(self.heights) - self.grid.reduction.min(self.heights)
        if not size < LARGEST:
            raise InputError(f"surface: heights over a range of {size:g}: must be below {LARGEST:g}, in any unit")
        given = {observable.name: observable for observable in observables}
        self.asked: dict[str, Any] = {name: given[name] for name in (*OBSERVABLES, *given) if name in given}
        for observable in self.asked.values():
            observable.check_in(self.grid.domain)
            observable.check_storage(self.grid.storage is np.float64)
            observable.check_contact(problem.solid, problem.law)
        self.fields, self.seconds = frozenset(fields), dict[str, float]()
        self._given_solve = solve or partial(solve_contact, options=Solver(tolerance=FURTHER))
        self.cell = Cell(n=self.grid.shape, length=self.grid.lengths)
        self.edges = (self.asked.get("spectra") or Spectrum()).edges(self.cell, cutoff)
        acf = self.asked.get("acf")
        self.lags = lag_rings(self.grid, acf.edges(self.cell)) if acf else None
        self.full_contact = np.zeros(0)  # Σ |K h̃|² in each bin, K the stiffness, where spectra are asked for
        (self.rms_slope, ratio, beyond), self._correlations = self._measure()
        self.roughness = ratio * math.sqrt(self.grid.pixel_area)
        self.is_smooth = beyond <= BEYOND

    def solve(self, problem: ContactProblem, **options: Any) -> ContactSolution | None:
        """A further contact; None, with a warning in the log, if it cannot be solved.  Collective."""
        try:
            return self._given_solve(problem, **options)
        except (InputError, SolverError) as failure:
            if not shared(problem.grid.comm, failure):
                raise
            if problem.grid.comm.rank == 0:
                log.warning("an observable lacks a contact that it asks for: %s", failure)
            return None

    @cached_property
    def modes(self) -> Rings:
        """The bins of the wave number.  Collective on first use."""
        return mode_rings(self.grid, self.edges)

    def rings(self, edges: np.ndarray) -> Rings:
        """Bins of the wave number with these edges.  Collective."""
        return self.modes if np.array_equal(edges, self.edges) else mode_rings(self.grid, edges)

    def correlate(self, fill: RowAction, watch: ColumnAction | None = None) -> Correlations:
        """Spectrum, and autocorrelation if one is asked for, of the field whose rows `fill` makes.  Collective."""
        return correlate(self.grid, fill, self.modes, self.lags, watch)

    def _measure(self) -> tuple[tuple[float, float, float], Correlations | None]:
        """√Σ q²|h̃|², √(Σ q⁴|h̃|² / Σ q²|h̃|²) and the share of Σ q²|h̃|² beyond RESOLVED; and in the same pass the
        correlations, if they will be needed.  Collective.
        """
        parts, full, grid = dict[int, tuple[float, float, float]](), dict[int, np.ndarray](), self.grid
        stiffened = grid.domain.wraps and "spectra" in self.asked
        unit = min(grid.spacing)  # of lengths here, so that no power of q overflows
        along, across = (unit * grid.qx[0]) ** 2, (unit * grid.qy[:, 0]) ** 2
        weight = grid.hermitian_weight[:, 0].copy()
        inner_x = np.abs(grid.qx[0]) * grid.spacing[0] <= RESOLVED
        inner_y = np.abs(grid.qy[:, 0]) * grid.spacing[1] <= RESOLVED
        powers = np.stack([np.ones_like(along), along, along**2, inner_x, inner_x * along], axis=1)

        def watch(power: np.ndarray, first: int, stop: int) -> None:
            sums, square, w = power @ powers, across[first:stop], weight[first:stop]  # Σ v, Σ qx² v, Σ qx⁴ v
            second, inner = (sums[:, i + 1] + square * sums[:, i] for i in (0, 3))
            fourth = sums[:, 2] + square * (2 * sums[:, 1] + square * sums[:, 0])
            parts[first] = w @ second, w @ fourth, w @ (inner_y[first:stop] * inner)
            if stiffened:
                stiffness = self.problem.solid.stiffness(np.sqrt(grid.q_squared(first, stop)))
                full[first] = self.modes.sums(power * stiffness * stiffness, first, stop)

        correlations = None
        if grid.domain.wraps and self.asked.keys() & {"spectra", "acf"}:
            correlations = self.correlate(source(self.heights), watch)
        else:
            fill = source(self.heights) if grid.domain.wraps else self._windowed()
            grid.read_spectrum(fill, lambda block, *place: watch(squared(block), *place))
        if stiffened:
            self.full_contact = self.modes.total(full) / float(grid.size) ** 2
        totals = grid.reduction.sums_of_blocks(parts, 3)
        second, fourth = np.sqrt(totals[:2] / grid.modes / grid.size)
        if second == 0:
            return (0.0, 0.0, 0.0), correlations
        slope = float(second) / unit if grid.domain.wraps else self._slope_of_steps()
        return (slope, float(fourth / second) / unit, float(1 - totals[2] / totals[0])), correlations

    def _windowed(self) -> RowAction:
        """The heights without their mean plane, times Hann's window, which vanishes at the border.  Collective."""
        grid, heights = self.grid, self.heights
        nx, ny = grid.shape
        x, y = ((2 * np.arange(n) + 1) / n - 1 for n in (nx, ny))  # from −1 to 1
        x = x[grid.rows]
        wx, wy = np.cos(np.pi / 2 * x) ** 2, np.cos(np.pi / 2 * y) ** 2
        squares = [n * (1 - 1 / n**2) / 3 or 1.0 for n in grid.shape]  # Σ x², Σ y²
        rows, columns = heights.sum(axis=1), heights.sum(axis=0)
        mean, along, across = grid.reduction.sums(rows.sum(), rows @ x, columns @ y)
        plane = mean / grid.size, along / (ny * squares[0]), across / (nx * squares[1])

        def fill(first: int, stop: int, out: np.ndarray) -> None:
            out[...] = heights[first:stop] - (plane[0] + plane[1] * x[first:stop, None] + plane[2] * y)
            out *= wx[first:stop, None] * wy

        return fill

    def _slope_of_steps(self) -> float:
        """Rms slope between neighbours.  Collective."""
        grid, heights = self.grid, self.heights
        (nx, ny), (ax, ay) = grid.shape, grid.spacing
        below = grid.fetch(heights, grid.rows.stop, grid.rows.stop + 1)
        x, y = np.diff(heights, axis=0, append=below) / ax, np.diff(heights, axis=1) / ay
        sums = grid.reduction.sums(float(np.vdot(x, x)), float(np.vdot(y, y)))
        return math.sqrt(float(sums[0]) / max((nx - 1) * ny, 1) + float(sums[1]) / max(nx * (ny - 1), 1))

    @cached_property
    def correlations(self) -> Correlations:
        """Spectrum of the heights, and autocorrelation if one is asked for."""
        return self._correlations or self.correlate(source(self.heights))

    def acf_groups(self, name: str, found: Correlations) -> Groups:
        """The three groups of an autocorrelation; none if none is asked for."""
        if self.lags is None or found.acf is None:
            return {}
        binned, along_x, along_y = found.acf
        return {
            f"{name}_acf": self.lags.means(binned, "r"),
            f"{name}_acf_x": along_axis(self.grid, along_x, 0),
            f"{name}_acf_y": along_axis(self.grid, along_y, 1),
        }
