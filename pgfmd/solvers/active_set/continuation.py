"""How the certificate continues ε from the unknowns, where it is the residual g − λ, to the other points.

The best ε makes ½⟨ε, Kε⟩ least within what is allowed: about what a rubber sheet does between the points that hold it.
What is left at the end of a solve is often alike over a whole patch and its surroundings, so ε begins at means of the
residual over blocks of pixels (`BlockMeans`).  Sweeps of means over neighbours follow, far ones first (`STRIDES`), each
cut to what is allowed.
"""

from __future__ import annotations

import numpy as np

from pgfmd.grid.kernels import jit, u
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.parallel.layout import Layout, RowWindow
from pgfmd.solvers.active_set.unknowns import Fields

Limits = tuple[float, float, float]
"""λ, σ_Y and `Relaxation.spare`, for certificates."""

STRIDES = 6, 3, 1  # pixels, of the sweeps
BESIDE = sum(STRIDES)  # rows that the sweeps need on either side
SHIFT, LARGER, LEVELS = 4, 4, 3  # the smallest blocks have 2⁴ pixels a side; each level's blocks 4 times as many
TRUST = 1.25  # weight of a block's mean over the root of the part of it that is unknown
HUGE = np.finfo(np.float32).max


class BlockMeans:
    """Means of the residual over blocks of 16, 64 and 256 pixels a side.  Collective to make.

    The value of a block lies between that of the larger block around it, 0 for the largest, and the mean of its own
    unknowns, with the weight `TRUST` √(part of the block that is unknown), at most 1: points far from each other hold
    the field less than one of them per pixel would.
    """

    def __init__(self, grid: SlabGrid) -> None:
        self.grid, side, width = grid, 1 << SHIFT, grid.shape[1]
        starts, low, high = grid.starts, grid.rows.start - BESIDE, grid.rows.stop + BESIDE
        self.windows: list[RowWindow] = []
        for _ in range(LEVELS):
            layout, width = Layout(grid.comm, -(-starts // side)), -(-width // side)
            window = RowWindow(layout, (low // side, -(-high // side)), 2 * width, np.float64)
            self.windows.append(window)
            starts, low, high, side = layout.starts, window.low, window.low + len(window.rows), LARGER

    def of(self, fields: Fields, limits: Limits) -> tuple[np.ndarray, int]:
        """Values of the smallest blocks that overlap this rank's rows or `BESIDE` rows beside them, (rows, columns) of
        blocks; and how many rows the first begins before this rank's.  fields: pressure and gap (nx_local, ny).
        Collective.
        """
        windows, start = self.windows, self.grid.rows.start - (self.windows[0].low << SHIFT)

        def part(first: int, stop: int) -> None:
            sums = windows[0].rows[first:stop]
            sums[...] = 0
            residual_sums(fields, limits, ((first << SHIFT) - start, (stop << SHIFT) - start), sums)

        self.grid.threads.deal(part, len(windows[0].rows), 16)
        windows[0].add()
        for fine, coarse in zip(windows, windows[1:], strict=False):
            coarse.rows[...] = 0
            count, width = fine.own.shape[0], fine.own.shape[1] // 2
            pairs = fine.own.reshape(count, 2, width)
            sums = np.add.reduceat(pairs, np.arange(0, width, LARGER), axis=2).reshape(count, coarse.rows.shape[1])
            np.add.at(coarse.rows, (fine.low + fine.begin + np.arange(count)) // LARGER - coarse.low, sums)
            coarse.add()
        values = np.zeros((len(windows[-1].rows), windows[-1].rows.shape[1] // 2))
        for level in range(LEVELS - 1, -1, -1):
            window = windows[level]
            window.fetch()
            sums, counts = np.hsplit(window.rows, 2)
            if level < LEVELS - 1:
                at = (window.low + np.arange(len(sums))) // LARGER - windows[level + 1].low
                values = np.repeat(values[at], LARGER, axis=1)[:, : sums.shape[1]]
            weights = np.minimum(TRUST * np.sqrt(counts) / ((1 << SHIFT) * LARGER**level), 1)
            values = values + weights * (sums / np.maximum(counts, 1) - values)
        return values.astype(np.float32), start


@jit
def residual_sums(fields: Fields, limits: Limits, part: tuple[int, int], sums: np.ndarray) -> None:
    """Adds to sums[(i − first) >> SHIFT, b] the residual g − λ of the unknowns of those of rows i = first … stop−1 that
    exist, and their number to sums[(i − first) >> SHIFT, width + b]; b = column >> SHIFT.
    """
    (pressure, gap), (level, highest, spare), (first, stop), width = fields, limits, part, sums.shape[1] // 2
    for i in range(max(first, 0), min(stop, pressure.shape[0])):
        line, row = sums[(i - first) >> SHIFT], pressure[i]
        for block in range(width):
            begin, end, some = block << SHIFT, min((block + 1) << SHIFT, row.size), row[u(0)] * 0
            for j in range(begin, end):  # vectorised; the sum is 0 where no pressure is above 0
                some += row[u(j)]
            for j in range(begin, end if some != 0 else begin):
                p, rest = row[u(j)], np.float64(gap[i, u(j)]) - level
                if (p > 0) & (p < highest) and -spare * (highest - p) <= rest <= spare * p:
                    line[u(block)] += rest
                    line[u(width + block)] += 1


@jit
def residual_limits(
    fields: Fields, limits: Limits, place: tuple[int, int], blocks: tuple[np.ndarray, int], out: np.ndarray
) -> None:
    """The least and the largest ε that the certificate allows for rows of pressure and gap, and a first one, into
    out[0 … 2]: the allowed one that is nearest to the value of its block.  place: row and column of `out` where the
    first point goes.  blocks: the values of blocks, and which row of the first block the first row is.
    """
    (pressure, gap), (level, highest, spare), (at, margin), (values, start) = fields, limits, place, blocks
    for i in range(gap.shape[0]):
        line = values[(start + i) >> SHIFT]
        for j in range(gap.shape[1]):
            p, rest, k = pressure[i, u(j)], np.float32(gap[i, u(j)] - level), u(j + margin)
            above = (p > 0) & (rest <= spare * p)
            below = (p < highest) & (-rest <= spare * (highest - p))
            least, most, value = rest if above else -HUGE, rest if below else HUGE, line[u(j >> SHIFT)]
            value = value if value > least else least
            out[0, at + i, k] = least
            out[1, at + i, k] = most
            out[2, at + i, k] = value if value < most else most


@jit
def average_between(field: np.ndarray, limits: np.ndarray, stride: int, margin: int, out: np.ndarray) -> None:
    """out = the mean of a field over the eight points one stride away, cut to limits (2, rows, columns).  Not set:
    `stride` rows at either end, and `margin` columns, which in `field` repeat the other side's.
    """
    for i in range(stride, field.shape[0] - stride):
        a, b, c = field[i - stride], field[i], field[i + stride]
        least, most, target = limits[0, i], limits[1, i], out[i]
        for j in range(margin, field.shape[1] - margin):
            left, here, right = u(j - stride), u(j), u(j + stride)
            sides = (a[left] + b[left] + c[left]) + (a[right] + b[right] + c[right])
            mean = (sides + (a[here] + c[here])) * np.float32(0.125)
            mean = mean if mean > least[here] else least[here]
            target[here] = mean if mean < most[here] else most[here]
