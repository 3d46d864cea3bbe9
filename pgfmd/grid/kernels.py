"""Compiled loops.  The docstring of each gives the NumPy line that it replaces; a test compares the two.  Blocks of
modes have a last axis (real, imaginary).

All kernels release the GIL, so that the threads of one rank can share the blocks of a slab between them.
"""

from __future__ import annotations

import math

import numpy as np

from pgfmd.parallel.compiled import compiled

FAST = {"contract", "arcp", "nsz", "reassoc"}
jit = compiled(fastmath=FAST)
inlined = compiled(fastmath=FAST, inline="always")  # for what a loop calls in one place

TAPS = 8  # fine points along each axis that make one coarse point: at most those within two coarse spacings

u = np.uintp  # for indices: Numba tests signed ones for < 0, and does not vectorise loops with that test


@jit
def rows_and_tiles(half: np.ndarray, at: int, flat: np.ndarray, table: np.ndarray, height: int, back: bool) -> None:
    """flat[offset + (c // w · height + at + i) w + c % w] = half[i, first + c] for c < stop − first and each row
    (first, stop, offset, w) of the table: rows to tiles of w columns, one table row per target.  back: the inverse.
    """
    for target in range(table.shape[0]):
        stop, offset, width = table[target, 1], table[target, 2], table[target, 3]
        for start in range(table[target, 0], stop, width):
            for i in range(half.shape[0]):
                place = offset + (at + i) * width
                for j in range(min(width, stop - start)):
                    if back:
                        half[i, u(start + j)] = flat[u(place + j)]
                    else:
                        flat[u(place + j)] = half[i, u(start + j)]
            offset += height * width


@jit
def tiles_and_columns(tiles: np.ndarray, nx: int, first: int, count: int, block: np.ndarray, back: bool) -> None:
    """block[c, i] = tiles[(first + c) // w, i, (first + c) % w] for c < count and i < nx, where w = tiles.shape[2].
    back: the inverse.  32 rows at a time, so that both arrays stay in cache.
    """
    size = tiles.shape[2]
    for low in range(0, nx, 32):
        for c in range(count):
            tile, at = u((first + c) // size), u((first + c) % size)
            for i in range(low, min(low + 32, nx)):
                if back:
                    tiles[tile, u(i), at] = block[u(c), u(i)]
                else:
                    block[u(c), u(i)] = tiles[tile, u(i), at]


@jit
def scale_by_q(block: np.ndarray, qx_squared: np.ndarray, qy_squared: np.ndarray, factor: float, divide: bool) -> None:
    """block[j, i] *= factor · √(qx²[i] + qy²[j]), or if `divide` factor / √(qx²[i] + qy²[j]) and 0 at q = 0."""
    scale = np.empty_like(qx_squared)
    for j in range(qy_squared.size):
        for i in range(scale.size):  # a loop of its own, so that it is vectorised
            q = math.sqrt(qx_squared[i] + qy_squared[j])
            scale[i] = factor / q if divide else factor * q
        if divide and qx_squared[0] + qy_squared[j] == 0:
            scale[0] = 0
        for i in range(scale.size):
            block[j, i, 0] *= scale[i]
            block[j, i, 1] *= scale[i]


@jit
def scale_even(block: np.ndarray, table: np.ndarray, factor: float, divide: bool) -> None:
    """block *= factor · table, or factor / table if `divide`; table: of kx = 0 … n // 2, even in kx, in float64."""
    n = block.shape[1]
    scale = np.empty(n, block.dtype)
    for j in range(table.shape[0]):
        for i in range(table.shape[1]):
            scale[i] = factor / table[j, i] if divide else factor * table[j, i]
        for i in range(1, n - table.shape[1] + 1):
            scale[n - i] = scale[i]
        for i in range(n):
            block[j, i, 0] *= scale[i]
            block[j, i, 1] *= scale[i]


@jit
def interpolate_rows(
    coarse: np.ndarray,
    rows: tuple[np.ndarray, np.ndarray],
    columns: tuple[np.ndarray, np.ndarray],
    wraps: bool,
    out: np.ndarray,
) -> None:
    """out[i, j] = Σ_st weights[i, s] column_weights[j, t] coarse[first_row[i] + s, first_column[j] + t]: separable
    interpolation by four points, rows: first_row, weights; columns from −1 on, wrapping, or from −2 on, mirrored.
    """
    (first_row, weights), (first_column, column_weights) = rows, columns
    ny = coarse.shape[1]
    line = np.empty(ny + 5, coarse.dtype)
    for i in range(out.shape[0]):
        at, a, b, c, d = first_row[i], weights[i, 0], weights[i, 1], weights[i, 2], weights[i, 3]
        for j in range(ny):
            line[j + 2] = b * coarse[at + 1, j] + c * coarse[at + 2, j] + (a * coarse[at, j] + d * coarse[at + 3, j])
        for t in range(weights.shape[1] - 1):  # not range(3): to unroll it takes long
            line[ny + 2 + t] = line[2 + t] if wraps else line[2 + max(ny - 1 - t, 0)]
        line[0], line[1] = (line[ny], line[ny + 1]) if wraps else (line[2 + min(ny - 1, 1)], line[2])
        if out.shape[1] == 2 * ny and not wraps:  # columns lie a quarter of a spacing before and after each point
            a, b, c, d = column_weights[1, 0], column_weights[1, 1], column_weights[1, 2], column_weights[1, 3]
            for j in range(ny):
                left, middle, right = line[u(j + 1)], line[u(j + 2)], line[u(j + 3)]
                out[i, u(2 * j)] = (d * line[u(j)] + c * left) + (b * middle + a * right)
                out[i, u(2 * j + 1)] = (a * left + b * middle) + (c * right + d * line[u(j + 4)])
        elif out.shape[1] == 2 * ny:  # column 2j is point j, column 2j + 1 a middle: six times as fast
            a, b, c, d = column_weights[1, 0], column_weights[1, 1], column_weights[1, 2], column_weights[1, 3]
            for j in range(ny):
                out[i, u(2 * j)] = line[u(j + 2)]
                middle = b * line[u(j + 2)] + c * line[u(j + 3)]
                out[i, u(2 * j + 1)] = (a * line[u(j + 1)] + d * line[u(j + 4)]) + middle
        else:
            for j in range(out.shape[1]):
                start, weight = u(first_column[j] + 2), column_weights[j]
                left = weight[0] * line[start] + weight[1] * line[start + u(1)]
                out[i, j] = left + (weight[2] * line[start + u(2)] + weight[3] * line[start + u(3)])


@jit
def combine_columns(field: np.ndarray, columns: np.ndarray, weights: np.ndarray, out: np.ndarray, wraps: bool) -> None:
    """out[i, j] = Σ_t weights[j, t] field[i, columns[j, t]] over t < `TAPS`; (ny_coarse, `TAPS`) weights"""
    ny = field.shape[1]
    line, begin = np.empty(ny + 2 * TAPS, out.dtype), (columns[0, 0] + TAPS) % ny if wraps else TAPS - 3
    if ny == 2 * out.shape[1] and ny >= TAPS:  # the same weights at every second column: four times as fast
        a, b, c, d = weights[0, 0], weights[0, 1], weights[0, 2], weights[0, 3]
        e, f, g, h = weights[0, 4], weights[0, 5], weights[0, 6], weights[0, 7]
        for i in range(out.shape[0]):
            for j in range(ny):
                line[u(j + TAPS)] = field[i, u(j)]
            for j in range(weights.shape[1]):
                line[j] = line[ny + j] if wraps else line[2 * TAPS - 1 - j]
                line[ny + TAPS + j] = line[TAPS + j] if wraps else line[ny + TAPS - 1 - j]
            for j in range(out.shape[1]):
                k = 2 * j + begin
                left = (a * line[u(k)] + b * line[u(k + 1)]) + (c * line[u(k + 2)] + d * line[u(k + 3)])
                right = (e * line[u(k + 4)] + f * line[u(k + 5)]) + (g * line[u(k + 6)] + h * line[u(k + 7)])
                out[i, u(j)] = left + right
        return
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            total = 0.0
            for t in range(TAPS):
                total += weights[j, t] * field[i, u(columns[j, t])]
            out[i, j] = total


@jit
def combine_rows(rows: np.ndarray, first: np.ndarray, weights: np.ndarray, out: np.ndarray) -> None:
    """out[i] = Σ_t weights[i, t] rows[first[i] + t] over t < `TAPS`; (rows of out, `TAPS`) weights"""
    for i in range(out.shape[0]):
        line = out[i]
        line[:] = 0
        for t in range(weights.shape[1]):
            weight, row = weights[i, t], rows[first[i] + t]
            for j in range(line.size):
                line[u(j)] += weight * row[u(j)]


@jit
def sum_over_blocks(field: np.ndarray, start: int, size: int, sums: np.ndarray) -> None:
    """sums[(start + i) // size, j // size] += field[i, j]; rows are summed first, in a vectorised loop."""
    line = np.zeros(sums.shape[1] * size, sums.dtype)
    for i in range(field.shape[0]):
        row = field[i]
        for j in range(row.size):
            line[j] += row[j]
        if (start + i + 1) % size == 0 or i + 1 == field.shape[0]:
            target = sums[(start + i) // size]
            for block in range(target.size):
                for j in range(block * size, (block + 1) * size):
                    target[block] += line[u(j)]
            line[:] = 0


@inlined
def _repeat(means: np.ndarray, size: int, line: np.ndarray) -> None:
    """line[j] = means[j // size]"""
    for block in range(means.size):
        for j in range(block * size, min((block + 1) * size, line.size)):
            line[u(j)] = means[block]


@jit
def rest_in_blocks(
    fields: tuple[np.ndarray, np.ndarray, np.ndarray], means: np.ndarray, start: int, size: int, out: np.ndarray
) -> None:
    """out[i, j] = weights[i, j] (sums[i, j] shares[i, j] − means[(start + i) // size, j // size]), for fields (sums,
    shares, weights): means less the means over blocks of size × size, weighted (`solvers.active_set.preconditioner`).
    """
    sums, shares, weights = fields
    line, current = np.empty(out.shape[1], out.dtype), -1
    for i in range(out.shape[0]):
        if (start + i) // size != current:
            current = (start + i) // size
            _repeat(means[current], size, line)
        target, a, b, c = out[i], sums[i], shares[i], weights[i]
        for j in range(line.size):
            target[j] = c[j] * (a[j] * b[j] - line[j])


@jit
def subtract_blocks(means: np.ndarray, counts: np.ndarray, start: int, size: int, out: np.ndarray) -> None:
    """out[i, j] −= counts[i, j] means[(start + i) // size, j // size]; the same blocks."""
    line, current = np.empty(out.shape[1], out.dtype), -1
    for i in range(out.shape[0]):
        if (start + i) // size != current:
            current = (start + i) // size
            _repeat(means[current], size, line)
        target, share = out[i], counts[i]
        for j in range(line.size):
            target[j] -= share[j] * line[j]
