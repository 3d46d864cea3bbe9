"""The stiffness between blocks of pixels in contact, for residuals that are smooth on their scale.

Blocks in contact, weighted by how much of each is, again are a set: cut to it, the stiffness answers a smooth residual
by loads that do not become small with its wave number, as they should.  So the mean over larger blocks is taken out
before and after, and treated by the stiffness between these; and so on, each level by the same rule.
"""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from pgfmd.grid import kernels
from pgfmd.grid.slab_grid import SlabGrid

FEWEST = 64  # blocks per side below which the level beneath reaches far enough
FACTOR = 4  # blocks per side of one of the next level
LARGEST = 512  # blocks per side that each rank holds whole: they cross the ranks twice per application
SOFTENING = 0.125  # side of a block: compliance of its contact, over that of a wave of wave number 1/side
COLUMNS = 16  # of the spectrum at a time, so that what NumPy makes on the way stays in cache


class BlockStiffness:
    """Loads of blocks in answer to their residuals: symmetric, positive, and right for waves of any length."""

    def __init__(self, blocks: SlabGrid, side: int, stiffness, pixel: float):
        """blocks: a grid of them, each `side` pixels of side `pixel` across; stiffness(|q|) of the solid.
        Collective.
        """
        self.blocks, self.area = blocks, side**2
        soft = SOFTENING * side / stiffness(np.array(1 / pixel))
        self.stiffness = np.empty(blocks.spectral_shape, np.float32)

        def soften(_: int, first: int, stop: int):
            stiff = stiffness(np.sqrt(blocks.q_squared(first, stop)))
            self.stiffness[first:stop] = self.area / blocks.size * stiff / (1 + soft * stiff)

        blocks.threads.share(soften, len(self.stiffness), COLUMNS)
        self.factor = max(FACTOR, -(-max(blocks.shape) // LARGEST))
        shape = tuple(-(-n // self.factor) for n in blocks.shape)
        self.coarser = None
        if min(shape) >= FEWEST:
            lengths = tuple(n * self.factor * step for n, step in zip(shape, blocks.spacing, strict=True))
            coarser = SlabGrid(MPI.COMM_SELF, shape, lengths, blocks.asked_threads)
            self.coarser = BlockStiffness(coarser, side * self.factor, stiffness, pixel)
        self.counts = self.shares = self.weights = None

    @property
    def size(self) -> int:
        """Points of all grids that one application transforms."""
        return self.blocks.size + (self.coarser.size if self.coarser else 0)

    def free(self) -> None:
        """Give the memory of the transforms back.  Collective."""
        self.blocks.free()

    def begin(self, counts: np.ndarray) -> None:
        """A new set, of so many points in each of this rank's blocks.  Collective."""
        self.counts, self.shares, self.weights = counts, np.empty_like(counts), np.empty_like(counts)

        def weigh(_: int, first: int, stop: int):
            part = counts[first:stop]
            np.divide(1, np.maximum(part, 1), out=self.shares[first:stop])
            # By the fourth root of its share of contact a block takes part in long waves: a few points yield more.
            np.sqrt(np.sqrt(part / self.area), out=self.weights[first:stop])

        self.blocks.threads.share(weigh, len(counts), COLUMNS)
        if self.coarser:
            self.coarser.begin(self._sums(counts))

    def respond(self, residuals: np.ndarray, loads: np.ndarray) -> None:
        """loads = what the sums of the residual over the points of each block ask for.  Collective."""
        start, threads = self.blocks.rows.start, self.blocks.threads
        if self.coarser:
            size, coarser = self.factor, self.coarser
            smooth, answer = self._sums(residuals), np.empty(coarser.blocks.shape, np.float32)
            coarser.respond(smooth, answer)
            smooth *= coarser.shares
        else:
            size, smooth = max(self.blocks.shape), np.zeros((1, 1), np.float32)

        def fill(first: int, stop: int, rows: np.ndarray):
            part = residuals[first:stop], self.shares[first:stop], self.weights[first:stop]
            kernels.rest_in_blocks(part, smooth, start + first, size, rows)

        def act(block: np.ndarray, first: int, stop: int):
            kernels.scale_modes(block.view(np.float32).reshape(*block.shape, 2), self.stiffness[first:stop])

        def drain(first: int, stop: int, rows: np.ndarray):
            np.multiply(rows, self.weights[first:stop], out=loads[first:stop])

        self.blocks.convolve(fill, act, drain, np.float32)
        if self.coarser:
            answer -= self._sums(loads)
            answer *= coarser.shares
            threads.deal(
                lambda a, b: kernels.add_from_blocks(answer, self.counts[a:b], start + a, size, loads[a:b]), len(loads)
            )

    def _sums(self, values: np.ndarray) -> np.ndarray:
        """Sums of this rank's values over the blocks of the next level, all of them.  Collective."""
        rows, size = self.blocks.rows, self.factor
        sums = np.zeros(self.coarser.blocks.shape, np.float32)
        low, high = rows.start // size, -(-rows.stop // size)

        def part(first: int, stop: int):
            a, b = max((low + first) * size, rows.start), min((low + stop) * size, rows.stop)
            kernels.sum_over_blocks(values[a - rows.start : b - rows.start], a, size, sums)

        self.blocks.threads.deal(part, high - low, 16)
        if self.blocks.comm.size > 1:
            self.blocks.comm.Allreduce(MPI.IN_PLACE, sums)
        return sums
