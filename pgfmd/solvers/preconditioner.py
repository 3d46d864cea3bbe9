"""An approximate inverse of the compliance on a contact set, in two levels.

Near: the stiffness kernel cut to a few pixels, in real space.  The stiffness E'q/2 falls off as −E'/(4π r³), so a
disc of radius 3 pixels holds most of it; summed over contact points alone it costs a few per cent of a transform.
Cut off, its rows have positive sums, so it is positive definite; but it takes long waves for far too stiff.  So most
of that sum is taken off the diagonal.

Far: the mean of the residual over blocks of 4 × 4 pixels is taken out before and after the near part, and treated by
the stiffness of a grid of blocks instead, whose transform is negligible.  Both parts are symmetric and positive, and
so is their sum.
"""

from __future__ import annotations

import numpy as np
import scipy.fft
from mpi4py import MPI

from .. import kernels
from ..grid import SlabGrid
from .contact_set import ContactSet

ROWS = 32  # evaluated together: with `radius` more on each side they stay in cache
BLOCK = 4  # pixels: what the near part can bridge
MOST_BLOCKS = 1024  # per side: every rank holds them all
NEUTRAL = 0.9  # share of the row sum of the near part taken off its diagonal; below 1 it stays positive definite
SOFTENING = 4.0  # pixels: compliance of the contact points within a block, over that of a wave of wave number 1/pixel


def stiffness_stencil(grid: SlabGrid, stiffness, radius: int) -> np.ndarray:
    """Real-space values of `stiffness(|q|)` on the pixel lattice, (2 radius + 1)², zero beyond the radius.

    From a small grid with the same spacing: beyond a few pixels the kernel does not know the cell.
    """
    n = 64
    ax, ay = grid.spacing
    q = np.hypot(2 * np.pi * np.fft.fftfreq(n, ax)[:, None], 2 * np.pi * np.fft.rfftfreq(n, ay)[None, :])
    kernel = np.fft.irfft2(stiffness(q), s=(n, n))
    offsets = np.arange(-radius, radius + 1)
    inside = offsets[:, None] ** 2 + offsets[None, :] ** 2 <= radius**2
    return np.where(inside, kernel[np.ix_(offsets, offsets)], 0.0)


class TwoLevelStiffness:
    """z = (1 − Q) S K_cut Sᵀ (1 − Q) r + B K_blocks Bᵀ r: S restricts to a contact set, Q = B Bᵀ takes means over
    blocks.
    """

    def __init__(self, grid: SlabGrid, half_space, stiffness, dtype=np.float32):
        """half_space(|q|), stiffness(|q|): without and with the slab's base, which the near part would not bear."""
        self.near = LocalStiffness(grid, half_space, dtype=dtype)
        self.grid = grid
        self.size = max(BLOCK, -(-max(grid.shape) // MOST_BLOCKS))
        self.shape = tuple(-(-n // self.size) for n in grid.shape)
        self.useful = min(self.shape) >= 8  # else the near part reaches far enough
        lengths = [n * self.size * step for n, step in zip(self.shape, grid.spacing, strict=True)]
        qx, qy = (
            2 * np.pi * frequencies(n, length / n)
            for frequencies, n, length in zip((np.fft.fftfreq, np.fft.rfftfreq), self.shape, lengths, strict=True)
        )
        far = stiffness(np.hypot(qx[:, None], qy[None, :]))
        soft = SOFTENING / stiffness(np.array(1 / min(grid.spacing)))
        self.far = (far / (1 + soft * far)).astype(np.float32)
        self.points, self.counts = None, None

    def apply(self, points: ContactSet, residual: np.ndarray, out: np.ndarray) -> None:
        """out = M · residual on the set; both (count,).  Collective."""
        if not self.useful:
            self.near.apply(points, residual, out)
            return
        if points is not self.points:
            ones = np.ones(points.count, residual.dtype)
            self.points, self.counts = points, np.maximum(self._sums(points, ones), 1)
        mean = self._sums(points, residual) / self.counts
        self.near.apply(points, self._add(points, residual, -mean), out)
        spectrum = scipy.fft.rfft2(mean.astype(np.float32))
        spectrum *= self.far
        far = scipy.fft.irfft2(spectrum, s=self.shape)
        self._add(points, out, (far * self.size**2 - self._sums(points, out)) / self.counts, out)

    def _sums(self, points: ContactSet, values: np.ndarray) -> np.ndarray:
        """Sum of `values` (count,) over each block, on every rank.  Collective."""
        sums = np.zeros(self.shape)
        self._share(lambda a, b: kernels.block_sums(values, *points.lists, a, b, self.grid.rows.start, self.size, sums))
        if self.grid.comm.size > 1:
            self.grid.comm.Allreduce(MPI.IN_PLACE, sums)
        return sums

    def _add(self, points: ContactSet, values: np.ndarray, table: np.ndarray, out: np.ndarray | None = None):
        """values + table of their blocks."""
        out = np.empty_like(values) if out is None else out
        table, start = table.astype(values.dtype), self.grid.rows.start
        self._share(lambda a, b: kernels.add_blocks(values, table, *points.lists, a, b, start, self.size, out))
        return out

    def _share(self, work) -> None:
        """`work(first, stop)` on parts of the rows, cut between blocks so that no two threads meet in one."""
        start, rows = self.grid.rows.start, self.grid.local_shape[0]
        first_block, blocks = start // self.size, -(-(start + rows) // self.size) - start // self.size

        def part(low: int, high: int) -> None:
            first, stop = ((first_block + k) * self.size - start for k in (low, high))
            work(max(first, 0), min(stop, rows))

        self.grid.threads.split(part, blocks)


class LocalStiffness:
    """z = S K_cut Sᵀ r, where S restricts to a contact set."""

    def __init__(self, grid: SlabGrid, stiffness, radius: int = 3, dtype=np.float32):
        self.grid, self.radius = grid, min(radius, (grid.shape[1] - 1) // 2, grid.shape[0])
        stencil = stiffness_stencil(grid, stiffness, self.radius)
        stencil[self.radius, self.radius] -= NEUTRAL * stencil.sum()
        self.taps = np.nonzero(stencil)
        self.weights = stencil[self.taps].astype(dtype)

    def apply(self, points: ContactSet, residual: np.ndarray, out: np.ndarray) -> None:
        """out = the stencil applied to `residual` on the set; both (count,).  Collective: neighbours exchange
        `radius` rows.
        """
        grid, radius = self.grid, self.radius
        rows, ny = grid.local_shape
        above, below = self._halo(points, residual)

        def part(first: int, stop: int):
            work = np.zeros((ROWS + 2 * radius, ny + 2 * radius), residual.dtype)
            inner = work[:, radius : radius + ny]
            for low in range(first, stop, ROWS):
                high = min(low + ROWS, stop)
                start, end = max(low - radius, 0), min(high + radius, rows)
                at = start - low + radius
                kernels.fill_rows(residual, points.columns, points.offsets, start, inner[at : at + end - start])
                if at:
                    inner[:at] = above[radius - at :]
                missing = high + radius - end
                if missing:
                    inner[at + end - start : at + end - start + missing] = below[:missing]
                work[:, :radius] = work[:, ny : ny + radius]
                work[:, radius + ny :] = work[:, radius : 2 * radius]
                kernels.apply_stencil(
                    work, *self.taps, self.weights, points.columns, points.offsets, low, high - low, out
                )

        grid.threads.split(part, rows)

    def _halo(self, points: ContactSet, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The `radius` rows before the first and after the last one of this rank, around the ring.  Collective."""
        comm, radius = self.grid.comm, self.radius
        rows, ny = self.grid.local_shape
        if min(np.diff(self.grid.starts)) < radius:  # a slab thinner than the halo: rows come from further away
            dense = np.empty(self.grid.local_shape, values.dtype)
            kernels.fill_rows(values, points.columns, points.offsets, 0, dense)
            first = self.grid.rows.start
            return (
                self.grid.fetch(dense, first - radius, first),
                self.grid.fetch(dense, first + rows, first + rows + radius),
            )
        top, bottom = np.empty((2, radius, ny), values.dtype)
        kernels.fill_rows(values, points.columns, points.offsets, 0, top)
        kernels.fill_rows(values, points.columns, points.offsets, rows - radius, bottom)
        above, below = np.empty((2, radius, ny), values.dtype)
        kind = MPI._typedict[values.dtype.char]
        before, after = (comm.rank - 1) % comm.size, (comm.rank + 1) % comm.size
        comm.Sendrecv([bottom, kind], after, recvbuf=[above, kind], source=before)
        comm.Sendrecv([top, kind], before, recvbuf=[below, kind], source=after)
        return above, below
