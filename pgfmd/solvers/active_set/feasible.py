"""Makes pressures feasible.

`Feasible` brings pressures between their bounds: if the set of unknowns is too large, conjugate gradients leave
tensions (p < 0) near its edges, and setting them to 0 adds load.  If possible, that load is balanced within the same
block of pixels: balanced over all points, it would leave long waves, which cost most to correct.

`settle` brings the pressures of clipped gaps to the load by one factor for all points.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from pgfmd.errors import SolverError
from pgfmd.grid.kernels import jit, u
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.active_set.preconditioner import BlockWindow
from pgfmd.solvers.active_set.unknowns import Fields, Part, Points, Unknowns

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


def settle(grid: SlabGrid, rows: Rows, load: float) -> tuple[float, float, float, int]:
    """Makes a pressure of clipped gaps bear the load: 0 where there is a gap or a tension, elsewhere times one factor.
    Returns that, ⟨p, h⟩, Σ p² and the number of points with p > 0.  Raises SolverError, the pressure then uniform, if
    all points without a gap are in tension.  Collective.
    """
    pressure, gap, threads = rows[0], rows[1], grid.threads
    total = grid.reduction.sum(threads.collect(lambda a, b: bearing(pressure[a:b], gap[a:b]), len(gap), grid.band))
    if total == 0:
        pressure[...] = load / grid.size
        raise SolverError("hard wall: all points without a gap are in tension; allow a larger tolerance")
    parts = threads.collect(lambda a, b: settle_rows(rows, load / total, a, b), len(gap), grid.band)
    work, squares, count = grid.reduction.sums(*map(math.fsum, zip(*parts, strict=True)))
    return load / total, float(work), float(squares), int(count)


@jit
def bearing(pressure: np.ndarray, gap: np.ndarray) -> float:
    """Σ p where p > 0 and the gap is 0."""
    total = 0.0
    for i in range(gap.shape[0]):
        for j in range(gap.shape[1]):
            p = np.float64(pressure[i, u(j)])
            total += p if (p > 0) & (gap[i, u(j)] <= 0) else 0.0
    return total


@jit
def settle_rows(rows: Rows, factor: float, first: int, stop: int) -> tuple[float, float, int]:
    """Multiplies pressures by the factor where p > 0 and the gap is 0, and sets the others to 0, in rows first …
    stop−1.  Returns Σ p h, Σ p² and the number of points with p > 0.
    """
    pressure, gap, heights = rows
    work = squares = 0.0
    count = 0
    for i in range(first, stop):
        for j in range(gap.shape[1]):
            before = pressure[i, u(j)]
            p = factor * before if (before > 0) & (gap[i, u(j)] <= 0) else 0.0
            work += p * heights[i, u(j)]
            squares += p * p
            count += p > 0
            pressure[i, u(j)] = p
    return work, squares, count
