"""Pressures made feasible, each region keeping the load that it bears.

Conjugate gradients on a set that is too large leave tensions near its edges.  To cut them off adds load; if the excess
were taken off everywhere alike, load would move across the whole surface to where most was cut, and these long waves
are what an active set corrects last.  So it is taken off the same block of pixels: what is left of the reaction is
short-ranged.
"""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from pgfmd.solvers.active_set import kernels as set_kernels
from pgfmd.solvers.active_set.contact_set import ContactSet, SetVector

SHIFT = 5  # blocks of 2⁵ pixels: more than the width of a rim, less than the waves that matter


def cut_tension(points: ContactSet, pressure: np.ndarray, load: float) -> SetVector | None:
    """Pressure (nx_local, ny) without its tensions on the set, the sum over each block of pixels kept where it was
    positive, and the whole sum made `load`.  Returns the change, or None if there was no tension.  Collective.
    """
    grid, threads = points.grid, points.grid.threads
    start, stop = grid.rows.start, grid.rows.stop
    blocks = tuple((n - 1 >> SHIFT) + 1 for n in grid.shape)
    sums, change = np.zeros((blocks[0], 2, blocks[1])), SetVector(points)

    def rows(block: int) -> tuple[int, int]:
        """Of the slab, those that lie in a row of blocks."""
        return max(block << SHIFT, start) - start, min(block + 1 << SHIFT, stop) - start

    def measure(_: int, first: int, last: int):
        for block in range(touched[0] + first, touched[0] + last):
            set_kernels.signed_sums(pressure, *points.lists, *rows(block), SHIFT, sums[block])

    def cut(_: int, first: int, last: int):
        for block in range(touched[0] + first, touched[0] + last):
            set_kernels.cut_and_scale(pressure, *points.lists, *rows(block), SHIFT, factors[block], change.own)

    touched = start >> SHIFT, (stop - 1 >> SHIFT) + 1
    threads.share(measure, touched[1] - touched[0], 1)
    grid.comm.Allreduce(MPI.IN_PLACE, sums)
    kept, positive = np.maximum(sums[:, 0], 0), sums[:, 1]
    factors = kept / np.where(positive > 0, positive, 1) * (load / kept.sum())
    threads.share(cut, touched[1] - touched[0], 1)
    return change if (positive > sums[:, 0]).any() else None
