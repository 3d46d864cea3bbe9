"""An approximate inverse of the compliance on a contact set: the stiffness, on two or more scales.

Near part: the stiffness kernel, which decays as −E'/(4π r³), truncated at √10 pixels, in real space.  Summed over
contact points alone it costs a few per cent of a transform.  The truncated kernel has positive row sums, which makes it
positive definite, but far too stiff to long waves.  So most of the row sum is subtracted from the diagonal.

Far part: the mean of the residual over each block of 4 × 4 pixels is removed before and after the near part, and the
stiffness between blocks is applied to it instead.  Both parts are symmetric and positive.

The blocks in contact, weighted by the part of each that is in contact, form a set like that of the points.  On the set
alone, the stiffness overestimates the response to long waves: loads should vanish with the wave number.  So the mean
over larger blocks is removed before and after, and the stiffness between these larger blocks is applied to it; and so
on, to ever larger blocks (`Blocks`).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import DTypeLike

from pgfmd.grid import kernels
from pgfmd.grid.grid_cost import LEAST_MESH_ROWS
from pgfmd.grid.kernels import jit, u
from pgfmd.grid.slab_grid import SlabGrid, transform_work
from pgfmd.grid.transfer import SubGrid
from pgfmd.grid.transforms import scaling
from pgfmd.parallel.layout import Exchange, Layout, RowWindow, hops
from pgfmd.solvers.active_set.stencil import RADIUS, Stencil, Symbol, lattice_kernel, power_of
from pgfmd.solvers.active_set.unknowns import Part, Points, SetVector, Unknowns

FEWEST = 64  # larger blocks are used if there are at least so many, squared, on the torus
FACTOR = 4  # side of a block in pixels, and of a larger block in blocks
SHIFT = FACTOR.bit_length() - 1  # FACTOR = 2^SHIFT
SOFTENING = 0.125  # compliance of the contact within a block, over the compliance to a wave of wave number 1/side
NEUTRAL = 0.9  # part of the near part's row sum subtracted from its diagonal: below 1 it stays positive definite

Sums = Callable[[int, int, np.ndarray], None]
"""(first, stop, sums): adds rows first … stop−1 of this rank, as far as they exist, to the sums over blocks."""


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
    """out[k] = values[k] − table[(start + i) >> SHIFT, columns[k] >> SHIFT], k of rows i; part: start, first, stop."""
    columns, offsets = points
    start, first, stop = part
    for i in range(first, stop):
        line = table[(start + i) >> SHIFT]
        for k in range(offsets[i], offsets[i + 1]):
            out[k] = values[k] - line[u(columns[k] >> SHIFT)]


def larger(shape: tuple[int, int]) -> tuple[int, int]:
    """Blocks of a grid of points, or larger blocks of a grid of blocks; the last ones may reach beyond it."""
    return -(-shape[0] // FACTOR), -(-shape[1] // FACTOR)


class BlockWindow(RowWindow):
    """Sums over blocks of points of a grid.  The rank that has the first row of a block holds it; the window has all
    that have rows of this rank.  Collective to make.

    Attributes: layout, of the rows of blocks; start, number of rows of points in the window before this rank's first.
    """

    def __init__(self, grid: SlabGrid, side: int, width: int, dtype: DTypeLike = np.float32) -> None:
        """side: of a block, in points; width: number of sums in a row of blocks."""
        self.layout, self.threads, self.side = Layout(grid.comm, -(-grid.starts // side)), grid.threads, side
        super().__init__(self.layout, (grid.rows.start // side, -(-grid.rows.stop // side)), width, dtype)
        self.start = grid.rows.start - self.low * side

    def sum(self, sums: Sums) -> None:
        """Sets `own` to the sums over the blocks that this rank holds.  Collective."""

        def part(first: int, stop: int) -> None:
            self.rows[first:stop] = 0
            sums(first * self.side - self.start, stop * self.side - self.start, self.rows[first:stop])

        self.threads.deal(part, len(self.rows), 256 // self.side)
        self.add()


class Blocks:
    """Blocks of points of a grid, which may be blocks themselves.  Collective to make.

    A residual is split: its means over blocks are answered by the stiffness between blocks, the rest by the caller.
    Then the sum of the caller's answer over each block is replaced by the load of the block.  Both times `window`
    receives what the caller is to subtract from each point: an entry for each block that has points of this rank.

    Attributes: window; loads (own rows, ny), of the answers; transformed, points of the transforms in one application.
    """

    _answers: Exchange

    def __init__(self, grid: SlabGrid, side: int, stiffness: Symbol, pixel: float) -> None:
        """side: of a block, in pixels; pixel: side of a pixel; stiffness(|q|): of the solid."""
        nx, ny = shape = larger(grid.shape)
        lengths = nx * FACTOR * grid.spacing[0], ny * FACTOR * grid.spacing[1]
        self.place, self.threads, self.area = SubGrid(grid, shape, lengths, LEAST_MESH_ROWS), grid.threads, side**2
        self.window = BlockWindow(grid, FACTOR, ny)
        layout, answering = self.window.layout, self.place.layout
        self.inverse_counts, self.loads = np.zeros_like(self.window.own), np.zeros_like(self.window.own)
        self._gather, self._scatter = hops(layout, answering), hops(answering, layout)
        # together: every rank holds rows of blocks, and the same ones in both layouts
        self.together = np.array_equal(layout.starts, answering.starts) and np.diff(layout.starts).all()
        self.residuals, self.counts = np.empty((2, *self.place.local_shape), np.float32)
        self.coarser: Blocks | None = None
        if (blocks := self.place.grid) is not None:
            soft, stiff = SOFTENING * side / stiffness(np.array(1 / pixel)), stiffness(np.sqrt(blocks.q_squared()))
            self.stiffness = (self.area / blocks.modes * stiff / (1 + soft * stiff)).astype(np.float32)
            if self._enough(larger(shape)):
                self.coarser = Blocks(blocks, side * FACTOR, stiffness, pixel)
        self.transformed = 0.0
        while not self.transformed or self._enough(shape):
            work = transform_work(shape, self._torus(shape))
            self.transformed, shape = self.transformed + work * math.prod(shape), larger(shape)

    def _enough(self, shape: tuple[int, int]) -> bool:
        torus = self._torus(shape)
        # Of oblong pixels a torus may stay large although there is one block.
        return max(shape) > 1 and math.prod(torus) >= FEWEST**2 and min(torus) >= FACTOR

    def _torus(self, shape: tuple[int, int]) -> tuple[int, int]:
        """Modes of a grid of blocks of that shape."""
        return self.place.domain.torus(shape, self.place.spacing)

    def prepare(self, counts: Sums) -> None:
        """Takes a new set, by the number of its points in each block.  Collective."""
        self.window.sum(counts)
        np.divide(1, np.maximum(self.window.own, 1), out=self.inverse_counts)
        exchange = Exchange(self.window.plan.comm)
        exchange.relay(self._gather, self.window.own, self.counts)
        exchange.carry_out()
        if self.coarser is not None:
            self.coarser.prepare(_sums_of(self.counts))

    def split(self, residuals: Sums, exchange: Exchange) -> None:
        """Sets window to means of the residuals, loads to 0; adds what `respond` needs to the exchange.  Collective."""
        self.window.sum(residuals)
        self._answers, self.loads[...] = Exchange(self.window.plan.comm), 0
        exchange.relay(self._gather, self.window.own.copy(), self.residuals)
        if self.together and self.coarser is not None:
            self.coarser.split(_sums_of(self.residuals), exchange)
        self.window.own *= self.inverse_counts
        self.window.fetch()

    def respond(self) -> None:
        """Begins to answer the sums of `split`, whose exchange has been carried out.  Collective."""
        loads = np.empty_like(self.residuals)
        if self.place.grid is not None:
            if not self.together and self.coarser is not None:
                exchange = Exchange(self.place.grid.comm)
                self.coarser.split(_sums_of(self.residuals), exchange)
                exchange.carry_out()
            self._respond(self.place.grid, loads)
        self._answers.relay(self._scatter, loads, self.loads)
        self._answers.start()

    def join(self, answers: Sums) -> None:
        """Sets the window to the excess per point of the answers' sums over the loads.  Collective."""
        self.window.sum(answers)
        self._answers.finish()
        self.window.own -= self.loads
        self.window.own *= self.inverse_counts
        self.window.fetch()

    def free(self) -> None:
        """Frees the transforms.  Collective."""
        self.place.free()
        if self.coarser is not None:
            self.coarser.free()

    def _respond(self, blocks: SlabGrid, loads: np.ndarray) -> None:
        """loads of the blocks = K_blocks · residuals.  Collective on their grid."""
        coarser = self.coarser
        if coarser is not None:
            coarser.respond()

        def weights(first: int, stop: int) -> np.ndarray:
            """The fourth root of the part of each block in contact: a block with few such points yields more."""
            return np.sqrt(np.sqrt(self.counts[first:stop] / np.float32(self.area)))

        def fill(first: int, stop: int, rows: np.ndarray) -> None:
            part = self.residuals[first:stop], 1 / np.maximum(self.counts[first:stop], 1), weights(first, stop)
            if coarser is None:
                np.multiply(*part[:2], out=rows)
                rows *= part[2]
            else:
                kernels.rest_in_blocks(part, coarser.window.rows, coarser.window.start + first, FACTOR, rows)

        def drain(first: int, stop: int, rows: np.ndarray) -> None:
            np.multiply(rows, weights(first, stop), out=loads[first:stop])

        blocks.convolve(fill, scaling(self.stiffness), drain, np.float32)
        if coarser is not None:
            coarser.join(_sums_of(loads))
            smooth, start, counts = coarser.window.rows, coarser.window.start, self.counts
            blocks.threads.deal(
                lambda a, b: kernels.subtract_blocks(smooth, counts[a:b], start + a, FACTOR, loads[a:b]), len(loads)
            )


def _sums_of(values: np.ndarray) -> Sums:
    """Sums over larger blocks of this rank's values."""

    def add(first: int, stop: int, sums: np.ndarray) -> None:
        low = max(first, 0)
        kernels.sum_over_blocks(values[low : max(low, stop)], low - first, FACTOR, sums)

    return add
