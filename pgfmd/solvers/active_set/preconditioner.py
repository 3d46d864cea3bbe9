"""An approximate inverse of the compliance on a contact set: the stiffness, on two or more scales.

Near part: the stiffness kernel truncated to two pixels, in real space.  The stiffness E'q/2 decays as −E'/(4π r³), so
that a disc of radius 2 pixels holds most of it; summed over contact points alone it costs a few per cent of a
transform.  The truncated kernel has positive row sums, which makes it positive definite, but far too stiff to long
waves.  So most of the row sum is subtracted from the diagonal.

Far part: the mean of the residual over each block of 4 × 4 pixels, which is what the near part can bridge, is removed
before and after the near part, and the stiffness between blocks is applied to it instead (`block_stiffness`).  Both
parts are symmetric and positive, and so is their sum.
"""

from __future__ import annotations

import numpy as np

from pgfmd.grid.kernels import jit, u
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.parallel.layout import Exchange
from pgfmd.solvers.active_set.block_stiffness import FACTOR, FEWEST, Blocks, Sums
from pgfmd.solvers.active_set.stencil import RADIUS, Stencil, Symbol, lattice_kernel
from pgfmd.solvers.active_set.unknowns import Part, Points, SetVector, Unknowns

NEUTRAL = 0.9  # part of the near part's row sum subtracted from its diagonal: below 1 it stays positive definite


class MultilevelStiffness:
    """z = (1 − Q) S K_cut Sᵀ (1 − Q) r + B K_blocks Bᵀ r: S restricts to a contact set, Q = B Bᵀ takes means over
    blocks.  If `near_only`, without the second term: blocks then keep their loads.
    """

    near_only = False

    def __init__(self, grid: SlabGrid, half_space: Symbol, stiffness: Symbol) -> None:
        """half_space(|q|): stiffness of a half-space, for the near part; stiffness(|q|): of the solid, for the far."""
        kernel = lattice_kernel(grid, half_space)
        kernel[RADIUS, RADIUS] -= NEUTRAL * kernel.sum()
        self.near = Stencil(grid, kernel)
        self.far = FarPart(grid, stiffness) if min(grid.shape) >= FEWEST * FACTOR else None

    def apply(self, points: Unknowns, residual: SetVector, out: SetVector) -> None:
        """out = M · residual on the set.  Collective."""
        if self.far is None:
            self.near.apply(points, residual.exchange(), out.own)
            return
        rest = self.far.split(points, residual, self.near_only)
        self.near.apply(points, rest.all, out.own)
        self.far.join(points, out)

    def free(self) -> None:
        """Frees the transforms of the blocks.  Collective."""
        if self.far is not None:
            self.far.blocks.free()


class FarPart:
    """The far part: sums over the points of each block, the stiffness between blocks, and back to the points."""

    def __init__(self, grid: SlabGrid, stiffness: Symbol) -> None:
        self.grid = grid
        self.blocks = Blocks(grid, FACTOR, stiffness, min(grid.spacing))
        row_block = np.arange(grid.rows.start, grid.rows.stop) // FACTOR - self.blocks.low
        self.block_of = row_block, np.arange(grid.shape[1]) // FACTOR
        self.known: tuple[Unknowns, bool] | None = None  # the set for which the blocks are prepared
        self.rest: SetVector

    def split(self, points: Unknowns, residual: SetVector, near_only: bool) -> SetVector:
        """The residual less its means over blocks, with its halo.  The loads that answer these means are kept for
        `join`, or none if `near_only`.  Collective.
        """
        counts = None
        if self.known is None or points is not self.known[0] or near_only != self.known[1]:
            self.known, self.rest = (points, near_only), SetVector(points)
            counts = self._sums(points, np.ones(points.count, np.float32))
        exchange = Exchange(self.grid.comm)
        self.blocks.split(self._sums(points, residual.own), exchange, counts, not near_only)
        self._subtract(points, residual.own, self.rest.own)
        self.rest.send(exchange)
        exchange.carry_out()
        if not near_only:
            self.blocks.respond()
            self.grid.transforms += 0.5 * self.blocks.transformed / self.grid.size
        return self.rest

    def join(self, points: Unknowns, values: SetVector) -> None:
        """Replaces the sum of `values` over each block by its kept load, spread evenly over its points.  Collective."""
        self.blocks.join(self._sums(points, values.own))
        self._subtract(points, values.own, values.own)

    def _sums(self, points: Unknowns, values: np.ndarray) -> Sums:
        """Sums over blocks of values on the set."""

        def add(first: int, stop: int, sums: np.ndarray) -> None:
            block_sums(values, points.lists, (first, stop), FACTOR, self.block_of[1], sums)

        return add

    def _subtract(self, points: Unknowns, values: np.ndarray, out: np.ndarray) -> None:
        """out = values − what `Blocks` left in the window for the block of each."""
        rows, lists = self.blocks.window.rows, points.lists

        def part(first: int, stop: int) -> None:
            subtract_blocks(values, rows, lists, (first, stop), self.block_of, out)

        self.grid.threads.deal(part, self.grid.local_shape[0])


@jit
def block_sums(
    values: np.ndarray, points: Points, part: Part, size: int, column_block: np.ndarray, sums: np.ndarray
) -> None:
    """sums[(i − first) // size, column_block[columns[k]]] += values[k] for the points k of those of rows first … stop−1
    that exist.
    """
    columns, offsets = points
    first, stop = part
    for i in range(max(first, 0), min(stop, offsets.size - 1)):
        line = sums[(i - first) // size]
        for k in range(offsets[i], offsets[i + 1]):
            line[u(column_block[u(columns[k])])] += values[k]


@jit
def subtract_blocks(
    values: np.ndarray,
    table: np.ndarray,
    points: Points,
    part: Part,
    blocks: tuple[np.ndarray, np.ndarray],
    out: np.ndarray,
) -> None:
    """out[k] = values[k] − table[row_block[i], column_block[columns[k]]]; blocks: these two."""
    columns, offsets = points
    first, stop = part
    row_block, column_block = blocks
    for i in range(first, stop):
        line = table[row_block[i]]
        for k in range(offsets[i], offsets[i + 1]):
            out[k] = values[k] - line[u(column_block[u(columns[k])])]
