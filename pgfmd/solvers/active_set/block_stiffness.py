"""The stiffness between blocks of pixels in contact, for residuals that are smooth on their scale.

The blocks in contact, weighted by the part of each that is in contact, form a set like that of the points.  Restricted
to it, the stiffness answers a smooth residual with loads that are too large: they should vanish with the wave number.
So the mean over larger blocks is removed before and after, and the stiffness between these larger blocks is applied to
it; and so on, to ever larger blocks.
"""

from __future__ import annotations

import numpy as np

from pgfmd.grid import kernels
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.parallel.mpi import MPI
from pgfmd.solvers.active_set.stencil import Symbol

FEWEST = 64  # larger blocks are used if there are at least so many per side
FACTOR = 4  # side of a larger block, in blocks
LARGEST = 512  # larger blocks per side at most: every rank holds them all, and each application sums them twice
SOFTENING = 0.125  # compliance of the contact within a block, over the compliance to a wave of wave number 1/side


def grid_of_blocks(comm: MPI.Comm, grid: SlabGrid, side: int) -> SlabGrid:
    """The grid of blocks of side² points of another; the last ones may reach beyond its cell.  Collective."""
    nx, ny = (-(-n // side) for n in grid.shape)
    return SlabGrid(comm, (nx, ny), (nx * side * grid.spacing[0], ny * side * grid.spacing[1]), grid.asked_threads)


class BlockStiffness:
    """The map from residuals of blocks to their loads: symmetric, positive, accurate for waves of any length."""

    counts: np.ndarray
    inverse_counts: np.ndarray
    weights: np.ndarray

    def __init__(self, blocks: SlabGrid, side: int, stiffness: Symbol, pixel: float) -> None:
        """blocks: the grid whose points are the blocks; side: of a block, in pixels; pixel: side of a pixel;
        stiffness(|q|): of the solid.  Collective.
        """
        self.blocks, self.area = blocks, side**2
        soft = SOFTENING * side / stiffness(np.array(1 / pixel))
        stiff = stiffness(np.sqrt(blocks.q_squared()))
        self.stiffness = (self.area / blocks.size * stiff / (1 + soft * stiff)).astype(np.float32)
        self.factor = max(FACTOR, -(-max(blocks.shape) // LARGEST))
        self.coarser: BlockStiffness | None = None
        if -(-min(blocks.shape) // self.factor) >= FEWEST:
            coarser = grid_of_blocks(MPI.COMM_SELF, blocks, self.factor)
            self.coarser = BlockStiffness(coarser, side * self.factor, stiffness, pixel)

    @property
    def size(self) -> int:
        """Number of points that one application transforms, over all grids of blocks."""
        return self.blocks.size + (self.coarser.size if self.coarser else 0)

    def free(self) -> None:
        """Frees the transforms.  Collective."""
        self.blocks.free()

    def begin(self, counts: np.ndarray) -> None:
        """Prepares for a new set; counts: number of its points in each of this rank's blocks.  Collective."""
        self.counts, self.inverse_counts = counts, 1 / np.maximum(counts, 1)
        # A block with few points in contact yields more: its weight is the fourth root of the part in contact.
        self.weights = np.sqrt(np.sqrt(counts / np.float32(self.area)))
        if self.coarser is not None:
            self.coarser.begin(self._sums(self.coarser, counts))

    def respond(self, residuals: np.ndarray, loads: np.ndarray) -> None:
        """loads of the blocks = K_blocks · residuals, which are sums over the points of each block.  Collective."""
        start, threads, coarser = self.blocks.rows.start, self.blocks.threads, self.coarser
        if coarser is not None:
            size, smooth = self.factor, self._sums(coarser, residuals)
            answer = np.empty(coarser.blocks.shape, np.float32)
            coarser.respond(smooth, answer)
            smooth *= coarser.inverse_counts
        else:
            size, smooth = max(self.blocks.shape), np.zeros((1, 1), np.float32)

        def fill(first: int, stop: int, rows: np.ndarray) -> None:
            part = residuals[first:stop], self.inverse_counts[first:stop], self.weights[first:stop]
            kernels.rest_in_blocks(part, smooth, start + first, size, rows)

        def act(block: np.ndarray, first: int, stop: int) -> None:
            kernels.scale_modes(block.view(np.float32).reshape(*block.shape, 2), self.stiffness[first:stop])

        def drain(first: int, stop: int, rows: np.ndarray) -> None:
            np.multiply(rows, self.weights[first:stop], out=loads[first:stop])

        self.blocks.convolve(fill, act, drain, np.float32)
        if coarser is not None:
            answer -= self._sums(coarser, loads)
            answer *= coarser.inverse_counts
            threads.deal(
                lambda a, b: kernels.add_from_blocks(answer, self.counts[a:b], start + a, size, loads[a:b]), len(loads)
            )

    def _sums(self, coarser: BlockStiffness, values: np.ndarray) -> np.ndarray:
        """Sums over all larger blocks of the values of all ranks, of which this rank gives its own.  Collective."""
        rows, size = self.blocks.rows, self.factor
        sums = np.zeros(coarser.blocks.shape, np.float32)
        low, high = rows.start // size, -(-rows.stop // size)

        def part(first: int, stop: int) -> None:
            a, b = max((low + first) * size, rows.start), min((low + stop) * size, rows.stop)
            kernels.sum_over_blocks(values[a - rows.start : b - rows.start], a, size, sums)

        self.blocks.threads.deal(part, high - low, 16)
        if self.blocks.comm.size > 1:
            self.blocks.comm.Allreduce(MPI.IN_PLACE, sums)
        return sums
