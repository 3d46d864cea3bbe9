"""An approximate inverse of the compliance on a contact set: the stiffness kernel cut to a few pixels, in real space.

The stiffness E'q/2 falls off as −E'/(4π r³) in real space, so a disc of radius 3 pixels holds most of it; summed over
contact points alone it costs a few per cent of a transform.  Cut off, its rows have positive sums, so it is positive
definite.
"""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from .. import kernels
from ..grid import SlabGrid
from .contact_set import ContactSet

ROWS = 32  # evaluated together: with `radius` more on each side they stay in cache


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


class LocalStiffness:
    """z = S K_cut Sᵀ r, where S restricts to a contact set."""

    def __init__(self, grid: SlabGrid, stiffness, radius: int = 3, dtype=np.float32):
        self.grid, self.radius = grid, min(radius, (grid.shape[1] - 1) // 2, grid.shape[0])
        self.stencil = stiffness_stencil(grid, stiffness, self.radius).astype(dtype)

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
                block = work[: high - low + 2 * radius]
                kernels.apply_stencil(block, self.stencil, points.columns, points.offsets, low, out)

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
