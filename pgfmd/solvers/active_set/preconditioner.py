"""An approximate inverse of the compliance on a contact set: the stiffness, on two or more scales.

Near part: the stiffness kernel, which decays as −E'/(4π r³), truncated at √10 pixels, in real space.  Summed over
contact points alone it costs a few per cent of a transform.  The truncated kernel has positive row sums, which makes it
positive definite, but far too stiff to long waves.  So most of the row sum is subtracted from the diagonal.

Far part: the mean of the residual over each block of 4 × 4 pixels is removed before and after the near part, and the
stiffness between blocks is applied to it instead (`block_stiffness`).  Both parts are symmetric and positive.
"""

from __future__ import annotations

import numpy as np

from pgfmd.grid.kernels import jit, u
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.parallel.layout import Exchange
from pgfmd.solvers.active_set.block_stiffness import FACTOR, FEWEST, Blocks, Sums
from pgfmd.solvers.active_set.stencil import RADIUS, Stencil, Symbol, lattice_kernel, power_of
from pgfmd.solvers.active_set.unknowns import Part, Points, SetVector, Unknowns

SHIFT = FACTOR.bit_length() - 1  # FACTOR = 2^SHIFT
NEUTRAL = 0.9  # part of the near part's row sum subtracted from its diagonal: below 1 it stays positive definite


class MultilevelStiffness:
    """z = (1 − Q) S K_cut Sᵀ (1 − Q) r + B K_blocks Bᵀ r: S restricts to a set, Q = B Bᵀ takes means over blocks."""

    _rest: SetVector | None = None  # of the set for which the blocks are prepared

    def __init__(self, grid: SlabGrid, half_space: Symbol, stiffness: Symbol) -> None:
        """half_space(|q|): stiffness of a half-space, for the near part; stiffness(|q|): of the solid, for the far."""
        modulus, power = power_of(half_space)
        self.grid, kernel = grid, modulus * lattice_kernel(grid.spacing, power)
        kernel[RADIUS, RADIUS] -= NEUTRAL * kernel.sum()
        self.near = Stencil(kernel)
        large = grid.modes >= (FEWEST * FACTOR) ** 2 and min(grid.torus) >= FACTOR**2
        self.blocks = Blocks(grid, FACTOR, stiffness, min(grid.spacing)) if large else None

    def apply(self, residual: SetVector, out: np.ndarray, near_only: bool = False) -> None:
        """out = M · residual; if `near_only`, without the second term: blocks keep their loads.  Collective."""
        points, blocks, rest = residual.points, self.blocks, self._rest
        if blocks is None:
            self.near.apply(residual, out)
            return
        if rest is None or rest.points is not points:
            rest = self._rest = SetVector(points)
            blocks.prepare(self._sums(points, np.ones(points.count, np.float32)))
        exchange = Exchange(self.grid.comm)
        blocks.split(self._sums(points, residual.own), exchange)
        self._subtract(blocks, points, residual.own, rest.own)
        rest.send(exchange)
        exchange.carry_out()
        if not near_only:
            blocks.respond()
            self.grid.transforms += 0.5 * blocks.transformed / self.grid.size
        self.near.sum(rest, out)
        blocks.join(self._sums(points, out))
        self._subtract(blocks, points, out, out)

    def make_room(self) -> None:
        """Frees what is made anew for each set, and the transforms of the blocks if they are large.  Collective."""
        self._rest = None
        if self.blocks is not None and self.blocks.place.grid is not None:
            self.blocks.place.grid.make_room()

    def free(self) -> None:
        """Frees the transforms of the blocks.  Collective."""
        if self.blocks is not None:
            self.blocks.free()

    def _sums(self, points: Unknowns, values: np.ndarray) -> Sums:
        """Sums over blocks of values on the set."""
        return lambda first, stop, sums: block_sums(values, points.lists, (first, stop), sums)

    def _subtract(self, blocks: Blocks, points: Unknowns, values: np.ndarray, out: np.ndarray) -> None:
        """out = values − what `Blocks` left in the window for the block of each."""
        rows, start = blocks.window.rows, blocks.window.start
        self.grid.threads.deal(
            lambda a, b: subtract_blocks(values, rows, points.lists, (start, a, b), out), self.grid.local_shape[0]
        )


@jit
def block_sums(values: np.ndarray, points: Points, part: Part, sums: np.ndarray) -> None:
    """sums[(i − first) >> SHIFT, columns[k] >> SHIFT] += values[k] for points k of rows first … stop−1 that exist."""
    columns, offsets = points
    first, stop = part
    for i in range(max(first, 0), min(stop, offsets.size - 1)):
        line = sums[(i - first) >> SHIFT]
        for k in range(offsets[i], offsets[i + 1]):
            line[u(columns[k] >> SHIFT)] += values[k]


@jit
def subtract_blocks(
    values: np.ndarray, table: np.ndarray, points: Points, part: tuple[int, int, int], out: np.ndarray
) -> None:
    """out[k] = values[k] − table[(start + i) >> SHIFT, columns[k] >> SHIFT] for the points k of rows i; part: start,
    and the first row and the end of these rows.
    """
    columns, offsets = points
    start, first, stop = part
    for i in range(first, stop):
        line = table[(start + i) >> SHIFT]
        for k in range(offsets[i], offsets[i + 1]):
            out[k] = values[k] - line[u(columns[k] >> SHIFT)]
