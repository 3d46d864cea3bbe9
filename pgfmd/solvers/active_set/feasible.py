"""Makes pressures feasible while each block of pixels keeps its load.

The load that this adds or removes is balanced within the same block: balanced over all points, it would leave long
waves, which cost most to correct.

`Feasible` brings pressures between their bounds: if the set of unknowns is too large, conjugate gradients leave
tensions (p < 0) near its edges, and setting them to 0 adds load.  `Settling` does so for the pressures of clipped gaps,
which are set to 0 at open points and where they are tensions.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from pgfmd.errors import SolverError
from pgfmd.grid.grid_cost import LEAST_MESH_ROWS
from pgfmd.grid.kernels import jit, u
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.transfer import SubGrid
from pgfmd.grid.transforms import source
from pgfmd.parallel.layout import Exchange, hops
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.active_set.preconditioner import BlockWindow
from pgfmd.solvers.active_set.unknowns import Fields, Part, Points, Unknowns
from pgfmd.solvers.second_order import energy_of_residual

MOST = 1.2  # largest factor on the pressures of a block that settles, and inverse of the smallest
SIDE = 8  # pixels of a block of the mesh on which the energy of the change is computed
SHIFT = 5  # blocks of 2⁵ × 2⁵ pixels: wider than the rim of a patch, shorter than waves that are costly to correct
ROUNDING = 1e-13  # relative error allowed in the sum of the pressures
CANCELLED = 1e-6  # if pressures and tensions cancel up to this part, the rest is rounding: block loads are not kept

Change = tuple[float, float, float]
"""Of a pressure: (factor, stiffness, level), see `change_rows`."""
Rows = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Pressure, gap and heights."""


class Feasible:
    """Makes pressures on one grid feasible.  Collective to make."""

    def __init__(self, grid: SlabGrid) -> None:
        self.width = (grid.shape[1] - 1 >> SHIFT) + 1
        self.window = BlockWindow(grid, 1 << SHIFT, 2 * self.width, np.float64)

    def make(self, problem: ContactProblem, points: Unknowns, fields: Fields) -> None:
        """Brings the pressure on the set between its bounds, and its sum to the load unless something else is imposed;
        if possible the sum over each block of pixels is kept, up to a common change (`scale_to_load`).  Collective.
        """
        grid, load, highest = problem.grid, problem.load, problem.law.highest
        pressure, window, lists = fields[0], self.window, points.lists
        window.sum(lambda first, stop, sums: measure_blocks(pressure, lists, (first, stop), highest, sums))
        loads, bounded = window.own[:, : self.width], window.own[:, self.width :]
        np.maximum(loads, 0, out=loads)
        total, most = grid.reduction.sums(loads.sum(), bounded.sum()).tolist()
        if not math.isfinite(total + most):
            raise SolverError("hard wall: the pressures overflow; allow a larger tolerance")
        if total <= CANCELLED * most:
            loads[...], total = bounded, most
        loads /= np.where(bounded > 0, bounded, 1)
        if problem.imposed is None and math.isinf(highest):
            loads *= load / total
        window.fetch()
        grid.threads.deal(
            lambda a, b: cut_in_blocks(pressure, lists, (window.start, a, b), highest, window.rows), len(pressure)
        )
        if math.isfinite(highest):
            scale_to_load(problem, fields)


@jit
def measure_blocks(pressure: np.ndarray, points: Points, part: Part, highest: float, sums: np.ndarray) -> None:
    """sums[(i − first) >> SHIFT, b] += p and sums[(i − first) >> SHIFT, width + b] += min(max(p, 0), highest) for the
    pressures p of the points of those of rows first … stop−1 that exist, b = column >> SHIFT.
    """
    columns, offsets = points
    first, stop = part
    width = sums.shape[1] // 2
    for i in range(max(first, 0), min(stop, offsets.size - 1)):
        row, line = pressure[i], sums[(i - first) >> SHIFT]
        for k in range(offsets[i], offsets[i + 1]):
            p, block = row[u(columns[k])], columns[k] >> SHIFT
            line[u(block)] += p
            line[u(width + block)] += min(max(p, 0.0), highest)


@jit
def cut_in_blocks(
    pressure: np.ndarray, points: Points, part: tuple[int, int, int], highest: float, factors: np.ndarray
) -> None:
    """Cuts the pressures p of the points of rows i at 0, multiplies them by factors[(start + i) >> SHIFT, column >>
    SHIFT], and cuts them at `highest`; part: start, and the first row and the end of these rows.
    """
    columns, offsets = points
    start, first, stop = part
    for i in range(first, stop):
        row, line = pressure[i], factors[(start + i) >> SHIFT]
        for k in range(offsets[i], offsets[i + 1]):
            j = u(columns[k])
            row[j] = min(line[u(columns[k] >> SHIFT)] * max(row[j], 0.0), highest)


def scale_to_load(problem: ContactProblem, fields: Fields) -> None:
    """Multiplies pressures, all ≥ 0, by one factor and limits them to σ_Y, so that their sum is the load.  Collective.

    If the points in contact cannot bear the load, others join by a projected gradient step: p becomes p + k (level −
    gap), limited to 0 … σ_Y, with k = E'/spacing, about the stiffness of a pixel, and the level that makes the sum the
    load.  Then pressures are multiplied.
    """
    (pressure, gap), grid, load, highest = fields, problem.grid, problem.load, problem.law.highest
    reduction, threads, close = grid.reduction, grid.threads, ROUNDING * load
    stiffness = problem.solid.surface_modulus / max(grid.spacing)
    if math.isinf(highest):
        total = reduction.sum(threads.collect(lambda a, b: float(pressure[a:b].sum(dtype=np.float64)), len(pressure)))
        if total > 0 and math.isfinite(load / total):
            threads.scale(pressure, load / total)
            return

    def excess(change: Change, keep: bool = False) -> tuple[float, float]:
        parts = threads.collect(lambda a, b: change_rows(fields, change, highest, keep, (a, b)), len(gap))
        full, rest, slope = (float(each) for each in reduction.sums(*map(math.fsum, zip(*parts, strict=True))))
        return (full * highest if full else 0.0) - load + rest, slope

    def factor() -> float:
        return _root(lambda factor: excess((factor, 0.0, 0.0)), (0.0, 1.0, math.inf), close)

    if (found := factor()) == math.inf:
        low = reduction.min(gap) - reduction.max(pressure) / stiffness
        high = reduction.max(gap) + load / grid.size / stiffness
        bracket = low, (low + high) / 2, high
        excess((0.0, stiffness, _root(lambda level: excess((0.0, stiffness, level)), bracket, close)), keep=True)
        found = factor()
    if math.isfinite(found):  # else the points that bear `highest` are all that bear something
        excess((found, 0.0, 0.0), keep=True)


def _root(excess: Callable[[float], tuple[float, float]], bracket: tuple[float, float, float], close: float) -> float:
    """The root of `excess`, an increasing function (value, derivative), by Newton's method in a bracket (low, first
    guess, high): one more step after |value| ≤ `close`.  inf if there is no root.
    """
    low, at, high = bracket
    if excess(low)[0] > close:
        return math.inf
    while low < at < high:
        value, slope = excess(at)
        trial = at - value / slope if slope > 0 else high
        if abs(value) <= close:
            return trial if low < trial < high else at
        low, high = (at, high) if value < 0 else (low, at)
        at = trial if low < trial < high else (low + high) / 2
    return at


@jit
def change_rows(fields: Fields, change: Change, highest: float, keep: bool, part: Part) -> tuple[int, float, float]:
    """Changes pressures of some rows: factor · p where p < highest, or with a stiffness p + stiffness · (level − g),
    cut to 0 and `highest`; without `keep` they stay as they are.  Returns how many are `highest`, the sum of the
    others, and its derivative by the level or the factor.  Saturated points are counted, so that their rounding does
    not load the few free ones.
    """
    pressure, gap = fields
    factor, stiffness, level = change
    full, total, slope = 0, 0.0, 0.0
    for i in range(part[0], part[1]):
        of_row = 0.0
        for j in range(pressure.shape[1]):
            old = pressure[i, j]
            new = old + stiffness * (level - gap[i, j]) if stiffness > 0 else old * factor if old < highest else old
            new = min(max(new, 0.0), highest)
            if new >= highest:
                full += 1
            elif new > 0:
                of_row += new
                slope += stiffness if stiffness > 0 else old
            if keep:
                pressure[i, j] = new
        total += of_row
    return full, total, slope


class Settling:
    """Settles pressures of one problem.  Collective to make."""

    def __init__(self, problem: ContactProblem) -> None:
        grid, (nx, ny) = problem.grid, (-(-n // SIDE) for n in problem.grid.shape)
        self.grid, self.heights = grid, problem.heights
        self.width = (grid.shape[1] - 1 >> SHIFT) + 1
        self.window = BlockWindow(grid, 1 << SHIFT, 2 * self.width, np.float64)
        self.changes = BlockWindow(grid, SIDE, ny)
        lengths = nx * SIDE * grid.spacing[0], ny * SIDE * grid.spacing[1]
        self.mesh = SubGrid(grid, (nx, ny), lengths, LEAST_MESH_ROWS)
        self._gather = hops(self.changes.layout, self.mesh.layout)
        self._solid = problem.solid

    def free(self) -> None:
        """Frees the transforms of the mesh.  Collective."""
        self.mesh.free()

    def settle(self, pressure: np.ndarray, gap: np.ndarray, load: float) -> tuple[float, float, int]:
        """Makes a pressure (nx_local, ny) of clipped gaps bear the load.  Returns ⟨p, h⟩, Σ p² and the number of points
        with p > 0.  Raises SolverError, the pressure then uniform, if all points without a gap are in tension.
        Collective.
        """
        window, rows = self.window, (pressure, gap, self.heights)
        window.sum(lambda first, stop, sums: sum_in_blocks(pressure, gap, (first, stop), sums))
        loads, feasible = window.own[:, : self.width], window.own[:, self.width :]
        factors = np.clip(loads / np.where(feasible > 0, feasible, 1), 1 / MOST, MOST)
        total = self.grid.reduction.sum((factors * feasible).sum())
        if total == 0:
            pressure[...] = load / self.grid.size
            raise SolverError("hard wall: all points without a gap are in tension; allow a larger tolerance")
        loads[...] = factors * (load / total)
        window.fetch()
        parts: list[tuple[float, ...]] = []

        def settle(first: int, stop: int, sums: np.ndarray) -> None:
            parts.append((first, *settle_rows(rows, window.rows, (window.start, first, stop), sums)))

        self.changes.sum(settle)
        work, squares, count = self.grid.reduction.sums(*np.sum(sorted(parts), axis=0)[1:])
        return float(work), float(squares), int(count)

    def fill_change(self, pressure: np.ndarray, first: int, stop: int, out: np.ndarray) -> None:
        """out = the change that settling made to rows first … stop−1 of the pressure, where it is above 0 now."""
        factors = self.window.rows[self.window.start + np.arange(first, stop) >> SHIFT, : self.width]
        change = np.repeat(1 - 1 / factors, 1 << SHIFT, axis=1)[:, : pressure.shape[1]]
        np.multiply(pressure[first:stop], change, out=out, casting="same_kind")

    def energy(self) -> float:
        """⟨c, Gc⟩ of the change c by the last settling, from sums over blocks of `SIDE` pixels.
        These are long waves, which the residual does not show.  Collective.
        """
        sums, exchange = np.empty(self.mesh.local_shape, np.float32), Exchange(self.grid.comm)
        exchange.relay(self._gather, self.changes.own, sums)
        exchange.carry_out()
        energy = 0.0
        if (mesh := self.mesh.grid) is not None:
            compliance = self._solid.apply_compliance(mesh, np.float32, 1 / mesh.size)
            energy = energy_of_residual(mesh, source(sums), compliance)[0]
        self.grid.transforms += 0.25 * self.mesh.size / self.grid.size
        return 2 * self.grid.comm.bcast(energy) / SIDE**2


@jit
def sum_in_blocks(pressure: np.ndarray, gap: np.ndarray, part: Part, sums: np.ndarray) -> None:
    """sums[(i − first) >> SHIFT, b] += p and sums[(i − first) >> SHIFT, width + b] += max(p, 0) where the gap is 0, for
    the pressures p of those of rows first … stop−1 that exist, b = column >> SHIFT.
    """
    first, stop = part
    width = sums.shape[1] // 2
    for i in range(max(first, 0), min(stop, pressure.shape[0])):
        line = sums[(i - first) >> SHIFT]
        for block in range(width):
            load = feasible = 0.0
            for j in range(block << SHIFT, min((block + 1) << SHIFT, pressure.shape[1])):
                p = np.float64(pressure[i, u(j)])
                load += p
                feasible += p if (p > 0) & (gap[i, u(j)] <= 0) else 0.0
            line[u(block)] += load
            line[u(width + block)] += feasible


@jit
def settle_rows(
    rows: Rows, factors: np.ndarray, part: tuple[int, int, int], sums: np.ndarray
) -> tuple[float, float, int]:
    """Multiplies pressures by factors[(start + i) >> SHIFT, column >> SHIFT] where p > 0 and the gap is 0, and sets the
    others to 0, in those of rows first … stop−1 that exist; adds the changes to sums[(i − first) // SIDE, column //
    SIDE].  Returns Σ p h, Σ p² and the number of points with p > 0.  part: start, first, stop.
    """
    pressure, gap, heights = rows
    start, first, stop = part
    work = squares = 0.0
    count = 0
    for i in range(max(first, 0), min(stop, pressure.shape[0])):
        line, of_row = factors[(start + i) >> SHIFT], sums[(i - first) // SIDE]
        for block in range(of_row.size):
            factor, change = line[u(block * SIDE >> SHIFT)], 0.0
            for j in range(block * SIDE, min((block + 1) * SIDE, pressure.shape[1])):
                before = pressure[i, u(j)]
                p = factor * before if (before > 0) & (gap[i, u(j)] <= 0) else 0.0
                change += p - before
                work += p * heights[i, u(j)]
                squares += p * p
                count += p > 0
                pressure[i, u(j)] = p
            of_row[u(block)] += change
    return work, squares, count
