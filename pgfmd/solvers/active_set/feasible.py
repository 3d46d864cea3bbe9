"""Brings pressures between their bounds while each block of pixels keeps its load.

If the set of unknowns is too large, conjugate gradients leave tensions (p < 0) near its edges.  Setting them to 0 adds
load.  If the excess were subtracted evenly from all points, load would move over long distances to where most was cut,
and an active set corrects long waves last.  So it is subtracted within the same block: the error that is left is
short-ranged.
"""

from __future__ import annotations

import math

import numpy as np
from mpi4py import MPI

from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.solvers.active_set import kernels as set_kernels
from pgfmd.solvers.active_set.contact_set import ContactSet
from pgfmd.solvers.active_set.kernels import Fields, Share

SHIFT = 5  # blocks of 2⁵ × 2⁵ pixels: wider than the rim of a patch, shorter than waves that are costly to correct
ROUNDING = 1e-13  # relative error allowed in the sum of the pressures
CANCELLED = 1e-6  # part of the pressures that tensions must leave uncancelled: less is rounding, and no load is kept


def make_feasible(points: ContactSet, fields: Fields, load: float, top: float, stiffness: float) -> None:
    """Brings the pressure on the set between 0 and `top`, and its sum over all points to `load`.  Collective.

    The sum over each block of pixels is kept if possible, up to a common change that brings the total to `load`.  If
    the points in contact cannot bear the load even at `top`, `push` adds others.  stiffness: of a single pixel.
    """
    pressure = fields[0]
    grid, threads = points.grid, points.grid.threads
    start, stop = grid.rows.start, grid.rows.stop
    blocks = tuple((n - 1 >> SHIFT) + 1 for n in grid.shape)
    sums = np.zeros((blocks[0], 2, blocks[1]))

    def rows(block: int) -> tuple[int, int]:
        """First and last + 1 of the slab's rows in a row of blocks."""
        return max(block << SHIFT, start) - start, min(block + 1 << SHIFT, stop) - start

    def measure(_: int, first: int, last: int) -> None:
        for block in range(touched[0] + first, touched[0] + last):
            set_kernels.sums_in_blocks(pressure, points.lists, rows(block), SHIFT, top, sums[block])

    def cut(_: int, first: int, last: int) -> None:
        for block in range(touched[0] + first, touched[0] + last):
            set_kernels.cut_and_scale(pressure, points.lists, rows(block), SHIFT, top, factors[block])

    touched = start >> SHIFT, (stop - 1 >> SHIFT) + 1
    threads.share(measure, touched[1] - touched[0], 1)
    grid.comm.Allreduce(MPI.IN_PLACE, sums)
    kept, bounded = np.maximum(sums[:, 0], 0), sums[:, 1]
    if kept.sum() <= CANCELLED * bounded.sum():
        kept = bounded
    factors = kept / np.where(bounded > 0, bounded, 1)
    if math.isinf(top):
        factors *= load / kept.sum()
    threads.share(cut, touched[1] - touched[0], 1)
    if math.isfinite(top) and not carry(grid, pressure, load, top):
        push(grid, fields, load, top, stiffness)


def push(grid: SlabGrid, fields: Fields, load: float, top: float, stiffness: float) -> None:
    """Replaces p by p + stiffness · (level − gap), cut to 0 and `top`, with the level that makes the sum `load`: a
    projected gradient step.  Collective.
    """
    pressure, gap = fields
    margin = top / stiffness
    low, high = grid.reduction.min(gap) - margin, grid.reduction.max(gap) + margin

    def total(level: float) -> float:
        parts = grid.threads.collect(
            lambda a, b: set_kernels.pushed_sum(fields, level, stiffness, top, a, b), len(gap)
        )
        return grid.reduction.sum(parts)

    level = (low + high) / 2
    while low < level < high and abs((sum_now := total(level)) - load) > ROUNDING * load:
        low, high = (level, high) if sum_now < load else (low, level)
        level = (low + high) / 2
    grid.threads.deal(lambda a, b: set_kernels.push_rows(fields, level, stiffness, top, a, b), len(gap))
    carry(grid, pressure, load, top)


def carry(grid: SlabGrid, pressure: np.ndarray, load: float, top: float) -> bool:
    """Changes the pressures (nx_local, ny) between 0 and `top` so that their sum is `load`.  Returns False, and
    changes nothing, if they cannot bear it.  Collective.
    """
    parts = grid.threads.collect(lambda a, b: set_kernels.bounded_sums(pressure, top, a, b), len(pressure))
    sums = grid.reduction.sums(*map(math.fsum, zip(*parts, strict=True)))
    share = share_of_load(sums, load, load / grid.size)
    if share[2] == 0:
        grid.threads.deal(lambda a, b: set_kernels.spread_load(pressure, top, share, a, b), len(pressure))
    return share[2] == 0


def share_of_load(sums: np.ndarray, load: float, mean: float) -> Share:
    """How to change the pressures between the bounds so that the sum over all points is `load`, as (factor, part,
    uniform): p becomes factor · p + part · (top − factor · p), or `uniform` everywhere if that is not 0, which it
    is if no factor and no part can do it.

    sums: Σ p between the bounds, Σ p at the upper one, and Σ (top − p) over both; mean: load over all points.
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
