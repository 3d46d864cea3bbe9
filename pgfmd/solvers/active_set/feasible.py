"""Brings pressures between their bounds while each block of pixels keeps its load.

If the set of unknowns is too large, conjugate gradients leave tensions (p < 0) near its edges.  Setting them to 0 adds
load.  If the excess were subtracted evenly from all points, load would move over long distances to where most was cut,
and an active set corrects long waves last.  So it is subtracted within the same block: the error that is left is
short-ranged.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.parallel.layout import Layout, RowWindow
from pgfmd.solvers.active_set import kernels as set_kernels
from pgfmd.solvers.active_set.kernels import Change, Fields
from pgfmd.solvers.active_set.unknowns import Unknowns

SHIFT = 5  # blocks of 2⁵ × 2⁵ pixels: wider than the rim of a patch, shorter than waves that are costly to correct
ROUNDING = 1e-13  # relative error allowed in the sum of the pressures
CANCELLED = 1e-6  # if pressures and tensions cancel but for this part, the rest is rounding: blocks keep no load then


class Feasible:
    """Makes pressures on one grid feasible.  Collective to make."""

    def __init__(self, grid: SlabGrid, top: float, stiffness: float) -> None:
        """top: the largest pressure; stiffness: of a pixel, about."""
        self.grid, self.top, self.stiffness = grid, top, stiffness
        start, stop = grid.rows.start, grid.rows.stop
        # The rank that has the first row of a block holds it.
        layout = Layout(grid.comm, grid.starts + (1 << SHIFT) - 1 >> SHIFT)
        self.width = (grid.shape[1] - 1 >> SHIFT) + 1
        self.window = RowWindow(layout, (start >> SHIFT, (stop - 1 >> SHIFT) + 1), 2 * self.width, np.float64)

    def make(self, points: Unknowns, fields: Fields, load: float) -> None:
        """Brings the pressure on the set between its bounds, and its sum over all points to `load`.  Collective.

        The sum over each block of pixels is kept if possible, up to a common change that brings the total to `load`
        (`carry`).
        """
        pressure, top, threads = fields[0], self.top, self.grid.threads
        start, stop = self.grid.rows.start, self.grid.rows.stop
        blocks = self.window.rows.reshape(-1, 2, self.width)

        def rows(block: int) -> tuple[int, int]:
            """First and last + 1 of the slab's rows in a row of blocks."""
            block += self.window.low
            return max(block << SHIFT, start) - start, min(block + 1 << SHIFT, stop) - start

        def measure(_: int, first: int, last: int) -> None:
            for block in range(first, last):
                blocks[block] = 0
                set_kernels.sums_in_blocks(pressure, points.lists, rows(block), SHIFT, top, blocks[block])

        def cut(_: int, first: int, last: int) -> None:
            for block in range(first, last):
                set_kernels.cut_and_scale(pressure, points.lists, rows(block), SHIFT, top, blocks[block, 0])

        threads.share(measure, len(blocks), 1)
        self.window.add()
        own = self.window.own.reshape(-1, 2, self.width)
        kept, bounded = np.maximum(own[:, 0], 0), own[:, 1]
        sums = self.grid.reduction.sums(kept.sum(), bounded.sum())
        if sums[0] <= CANCELLED * sums[1]:
            kept, sums[0] = bounded, sums[1]
        own[:, 0] = kept / np.where(bounded > 0, bounded, 1)
        if math.isinf(top):
            own[:, 0] *= load / sums[0]
        self.window.fetch()
        threads.share(cut, len(blocks), 1)
        if math.isfinite(top):
            carry(self.grid, fields, load, top, self.stiffness)


def carry(grid: SlabGrid, fields: Fields, load: float, top: float, stiffness: float) -> None:
    """Multiplies the pressures below `top`, and limits them to that, so that all sum to `load`.  Collective.

    If the points in contact cannot bear it, others join: p becomes p + stiffness · (level − gap), cut to 0 and `top`,
    with the level that makes the sum `load`, a projected gradient step.
    """
    pressure, gap = fields
    reduction, threads, close = grid.reduction, grid.threads, ROUNDING * load

    def excess(change: Change) -> tuple[float, float]:
        parts = threads.collect(lambda a, b: set_kernels.changed_sums(fields, change, top, a, b), len(gap))
        total, slope = reduction.sums(*map(math.fsum, zip(*parts, strict=True)))
        return float(total) - load, float(slope)

    change: Change = _root(lambda factor: excess((factor, 0.0, 0.0)), (0.0, 1.0, math.inf), close), 0.0, 0.0
    if change[0] == math.inf:
        low = reduction.min(gap) - reduction.max(pressure) / stiffness
        high = reduction.max(gap) + load / grid.size / stiffness
        bracket = low, (low + high) / 2, high
        change = 0.0, stiffness, _root(lambda level: excess((0.0, stiffness, level)), bracket, close)
    threads.deal(lambda a, b: set_kernels.change_rows(fields, change, top, a, b), len(gap))


def _root(
    excess: Callable[[float], tuple[float, float]], bracket: tuple[float, float, float], close: float
) -> float:
    """Where `excess`, an increasing function that comes with its derivative, is 0 to `close`: by Newton's method in a
    bracket (low, first guess, high).  inf if it is not there.
    """
    low, at, high = bracket
    if excess(low)[0] > close:
        return math.inf
    while low < at < high:
        value, slope = excess(at)
        if abs(value) <= close:
            break
        low, high = (at, high) if value < 0 else (low, at)
        trial = at - value / slope if slope > 0 else high
        at = trial if low < trial < high else (low + high) / 2
    return at
