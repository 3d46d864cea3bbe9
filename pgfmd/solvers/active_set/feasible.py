"""Pressures brought between their bounds, each region keeping the load that it bears.

Conjugate gradients on a set that is too large leave tensions near its edges.  To cut them off adds load; if the excess
were taken off everywhere alike, load would move across the whole surface to where most was cut, and these long waves
are what an active set corrects last.  So it is taken off the same block of pixels: what is left of the reaction is
short-ranged.
"""

from __future__ import annotations

import math

import numpy as np
from mpi4py import MPI

from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.solvers.active_set import kernels as set_kernels
from pgfmd.solvers.active_set.contact_set import ContactSet

SHIFT = 5  # blocks of 2⁵ pixels: more than the width of a rim, less than the waves that matter
Fields = tuple[np.ndarray, np.ndarray]
"""Pressure and gap (nx_local, ny)."""
ROUNDING = 1e-13  # of the load, that sums of pressures miss
CANCELLED = 1e-6  # of what is pushed, the part that is left by tensions below which it is rounding


def make_feasible(points: ContactSet, fields: Fields, load: float, top: float, stiffness: float) -> None:
    """Brings the pressure of the fields (pressure, gap) on the set between 0 and `top`; the sum over each block of
    pixels is kept where that is possible, but for what makes the whole sum `load`.  Collective.

    stiffness: of a single pixel.  If all points in contact cannot bear the load, others are pushed by their gap.
    """
    pressure = fields[0]
    grid, threads = points.grid, points.grid.threads
    start, stop = grid.rows.start, grid.rows.stop
    blocks = tuple((n - 1 >> SHIFT) + 1 for n in grid.shape)
    sums = np.zeros((blocks[0], 2, blocks[1]))

    def rows(block: int) -> tuple[int, int]:
        """Of the slab, those that lie in a row of blocks."""
        return max(block << SHIFT, start) - start, min(block + 1 << SHIFT, stop) - start

    def measure(_: int, first: int, last: int) -> None:
        for block in range(touched[0] + first, touched[0] + last):
            set_kernels.sums_in_blocks(pressure, *points.lists, *rows(block), SHIFT, top, sums[block])

    def cut(_: int, first: int, last: int) -> None:
        for block in range(touched[0] + first, touched[0] + last):
            set_kernels.cut_and_scale(pressure, *points.lists, *rows(block), SHIFT, top, factors[block])

    touched = start >> SHIFT, (stop - 1 >> SHIFT) + 1
    threads.share(measure, touched[1] - touched[0], 1)
    grid.comm.Allreduce(MPI.IN_PLACE, sums)
    kept, pushed = np.maximum(sums[:, 0], 0), sums[:, 1]
    if kept.sum() <= CANCELLED * pushed.sum():
        kept = pushed
    factors = kept / np.where(pushed > 0, pushed, 1)
    if math.isinf(top):
        factors *= load / kept.sum()
    threads.share(cut, touched[1] - touched[0], 1)
    if math.isfinite(top) and not carry(grid, pressure, load, top):
        push(grid, fields, load, top, stiffness)


def push(grid: SlabGrid, fields: Fields, load: float, top: float, stiffness: float) -> None:
    """p + stiffness · (level − gap), cut at 0 and `top`, with the level that makes the sum `load`: a step along the
    gradient, projected.  Collective.
    """
    pressure, gap = fields
    reach = top / stiffness
    low, high = grid.reduction.min(gap) - reach, grid.reduction.max(gap) + reach

    def total(level: float) -> float:
        parts = grid.threads.collect(
            lambda a, b: set_kernels.pushed_sum(*fields, level, stiffness, top, a, b), len(gap)
        )
        return grid.reduction.sum(parts)

    level = (low + high) / 2
    while low < level < high and abs((sum_now := total(level)) - load) > ROUNDING * load:
        low, high = (level, high) if sum_now < load else (low, level)
        level = (low + high) / 2
    grid.threads.deal(lambda a, b: set_kernels.push_rows(*fields, level, stiffness, top, a, b), len(gap))
    carry(grid, pressure, load, top)


def carry(grid: SlabGrid, pressure: np.ndarray, load: float, top: float) -> bool:
    """Changes the pressures (nx_local, ny) between 0 and `top` so that their sum is `load`, if they can; returns
    whether.  Collective.
    """
    parts = grid.threads.collect(lambda a, b: set_kernels.bounded_sums(pressure, top, a, b), len(pressure))
    sums = grid.reduction.sums(*map(math.fsum, zip(*parts, strict=True)))
    share = share_of_load(sums, load, load / grid.size)
    if share[2] == 0:
        grid.threads.deal(lambda a, b: set_kernels.spread_load(pressure, top, share, a, b), len(pressure))
    return share[2] == 0


def share_of_load(sums: np.ndarray, load: float, mean: float) -> tuple[float, float, float]:
    """How pressures between the bounds change so that all bear the load: a factor, a part of what they lack of the
    upper bound, and a uniform pressure where neither can do it (else 0).

    sums: Σ p of those between the bounds, Σ p of those at the upper one, and Σ (top − p) of both.
    """
    between, saturated, room = sums
    missing = load - saturated - between
    if abs(missing) <= ROUNDING * load:
        return 1.0, 0.0, 0.0
    if 0 < missing <= room < math.inf:
        return 1.0, missing / room, 0.0
    if between > 0 and saturated < load and not missing > room:
        return (load - saturated) / between, 0.0, 0.0
    return 0.0, 0.0, mean
