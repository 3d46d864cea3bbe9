"""An approximate inverse of the compliance on a contact set: the stiffness, on two or more scales.

Near part: the stiffness kernel truncated to two pixels, in real space.  The stiffness E'q/2 decays as −E'/(4π r³), so
that a disc of radius 2 pixels holds most of it; summed over contact points alone it costs a few per cent of a
transform.  The truncated kernel has positive row sums, which makes it positive definite, but far too stiff to long
waves.  So most of the row sum is subtracted from the diagonal.

Far part: the mean of the residual over each block of 4 × 4 pixels is removed before and after the near part, and the
stiffness between blocks is applied to it instead (`block_stiffness`).  Both parts are symmetric and positive, and so is
their sum.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pgfmd.grid.halo import RowWindow
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.solvers.active_set import block_stiffness
from pgfmd.solvers.active_set import kernels as set_kernels
from pgfmd.solvers.active_set.contact_set import HALO, ContactSet, SetVector
from pgfmd.solvers.active_set.stencil import RADIUS, Stencil, Symbol, lattice_kernel

BLOCK = 4  # pixels: what the near part can bridge
NEUTRAL = 0.9  # part of the near part's row sum subtracted from its diagonal: below 1 it stays positive definite


class MultilevelStiffness:
    """z = (1 − Q) S K_cut Sᵀ (1 − Q) r + B K_blocks Bᵀ r: S restricts to a contact set, Q = B Bᵀ takes means over
    blocks.
    """

    def __init__(self, grid: SlabGrid, half_space: Symbol, stiffness: Symbol) -> None:
        """half_space(|q|): stiffness of a half-space, for the near part; stiffness(|q|): of the solid, for the far."""
        kernel = lattice_kernel(grid, half_space)
        kernel[RADIUS, RADIUS] -= NEUTRAL * kernel.sum()
        self.near = Stencil(grid, kernel)
        far_reaching = min(grid.shape) >= block_stiffness.FEWEST * BLOCK and grid.shape[0] >= BLOCK * grid.comm.size
        self.far = FarPart(grid, stiffness) if far_reaching else None

    def apply(self, points: ContactSet, residual: SetVector, out: SetVector) -> None:
        """out = M · residual on the set.  Collective."""
        if self.far is None:
            self.near.apply(points, residual.exchange(), out.own)
            return
        rest = self.far.split(points, residual)
        self.near.apply(points, rest.exchange(), out.own)
        self.far.join(points, out)

    def free(self) -> None:
        """Frees the transforms of the blocks.  Collective."""
        if self.far is not None:
            self.far.stiffness.free()


class FarPart:
    """The far part: sums over the points of each block, the stiffness between blocks, and back to the points."""

    def __init__(self, grid: SlabGrid, stiffness: Symbol) -> None:
        self.grid = grid
        self.blocks = block_stiffness.grid_of_blocks(grid.comm, grid, BLOCK)
        self.stiffness = block_stiffness.BlockStiffness(self.blocks, BLOCK, stiffness, min(grid.spacing))
        self.window = RowWindow(self.blocks, grid.rows.start // BLOCK, -(-grid.rows.stop // BLOCK))
        self.row_block = np.arange(grid.rows.start, grid.rows.stop) // BLOCK - self.window.low
        self.column_block = np.arange(grid.shape[1]) // BLOCK
        self.points: ContactSet | None = None
        self.rest: SetVector
        self.sums, self.loads = np.empty((2, *self.blocks.local_shape), np.float32)

    def split(self, points: ContactSet, residual: SetVector) -> SetVector:
        """The residual less its means over blocks, whose loads are kept for `join`.  Collective."""
        if points is not self.points:
            ones = SetVector(points)
            ones.own[:] = 1
            counts = np.empty_like(self.sums)
            self._sum(points, ones, counts, lambda rows: None)
            self.points, self.rest = points, SetVector(points)
            self.stiffness.begin(counts)

        def means(rows: slice) -> None:
            np.multiply(self.sums[rows], self.stiffness.inverse_counts[rows], out=self.window.own[rows])
            np.negative(self.window.own[rows], out=self.window.own[rows])

        self._sum(points, residual, self.sums, means)
        self.stiffness.respond(self.sums, self.loads)
        self.grid.transforms += 0.5 * self.stiffness.size / self.grid.size
        self._add(points, residual.own, self.rest.own)
        return self.rest

    def join(self, points: ContactSet, values: SetVector) -> None:
        """Replaces the sum of `values` over each block by its kept load, spread evenly over its points.  Collective."""

        def change(rows: slice) -> None:
            np.subtract(self.loads[rows], self.sums[rows], out=self.window.own[rows])
            self.window.own[rows] *= self.stiffness.inverse_counts[rows]

        self._sum(points, values, self.sums, change)
        self._add(points, values.own, values.own)

    def _sum(self, points: ContactSet, values: SetVector, out: np.ndarray, then: Callable[[slice], None]) -> None:
        """out = sums of `values` over this rank's blocks; calls `then` for each few rows of blocks.  Collective."""
        extended = values.exchange()
        start, rows = self.grid.rows.start, self.blocks.rows

        def part(first: int, stop: int) -> None:
            low = (rows.start + first) * BLOCK - start + HALO
            high = min((rows.start + stop) * BLOCK, self.grid.shape[0]) - start + HALO
            sums = out[first:stop]
            sums[...] = 0
            set_kernels.block_sums(extended, points.extended, (low, high), BLOCK, self.column_block, sums)
            then(slice(first, stop))

        self.grid.threads.deal(part, len(out), 256 // BLOCK)

    def _add(self, points: ContactSet, values: np.ndarray, out: np.ndarray) -> None:
        """out = values + the window's entry for the block of each; edge blocks may be a neighbour's.  Collective."""
        self.window.exchange()
        rows, lists, blocks = self.window.rows, points.lists, (self.row_block, self.column_block)

        def part(first: int, stop: int) -> None:
            set_kernels.add_blocks(values, rows, lists, (first, stop), blocks, out)

        self.grid.threads.deal(part, self.grid.local_shape[0])
