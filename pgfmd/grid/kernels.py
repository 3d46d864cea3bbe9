"""Compiled loops.  The docstring of each gives the NumPy line that it replaces; a test compares the two.

All kernels release the GIL, so that the threads of one rank can share the blocks of a slab between them.
"""

from __future__ import annotations

import math

import numpy as np

from pgfmd.parallel.compiled import compiled

FAST = {"contract", "arcp", "nsz", "reassoc"}
jit = compiled(fastmath=FAST)
inlined = compiled(fastmath=FAST, inline="always")  # for what a loop calls in one place

Rows = tuple[np.ndarray, np.ndarray, np.ndarray]
"""(own, others, places): row k of an array whose rows lie in two is own[places[k]], or others[−1 − places[k]] if that
is negative."""

u = np.uintp  # for indices: Numba tests signed ones for < 0, and does not vectorise loops with that test


@jit
def rows_and_tiles(half: np.ndarray, at: int, flat: np.ndarray, table: np.ndarray, height: int, back: bool) -> None:
    """flat[offset + (c // w · height + at + i) w + c % w] = half[i, first + c] for c < stop − first and each row
    (first, stop, offset, w) of the table: rows to tiles of w columns, one table row per target.  back: the inverse.
    """
    for target in range(table.shape[0]):
        first, stop, offset, width = table[target]
        for start in range(first, stop, width):
            count = min(width, stop - start)
            for i in range(half.shape[0]):
                row, place = half[i], offset + (at + i) * width
                if back:
                    for j in range(count):
                        row[u(start + j)] = flat[u(place + j)]
                else:
                    for j in range(count):
                        flat[u(place + j)] = row[u(start + j)]
            offset += height * width


@jit
def tiles_and_columns(tiles: np.ndarray, nx: int, first: int, count: int, block: np.ndarray, back: bool) -> None:
    """block[c, i] = tiles[(first + c) // w, i, (first + c) % w] for c < count and i < nx, where w = tiles.shape[2].
    back: the inverse.  16 rows at a time, so that both arrays stay in cache.
    """
    size, done = tiles.shape[2], 0
    while done < count:
        tile, at = tiles[(first + done) // size], (first + done) % size
        width = min(size - at, count - done)
        columns = block[done : done + width]
        for low in range(0, nx, 16):
            high = min(low + 16, nx)
            if back:
                for i in range(low, high):
                    for j in range(width):
                        tile[i, at + j] = columns[j, i]
            else:
                for j in range(width):
                    for i in range(low, high):
                        columns[j, i] = tile[i, at + j]
        done += width


@jit
def divide_by_q(block: np.ndarray, qx_squared: np.ndarray, qy_squared: np.ndarray, factor: float) -> None:
    """block[j, i] *= factor / sqrt(qx²[i] + qy²[j]), and 0 at q = 0; the last axis of `block` holds (real,
    imaginary).
    """
    scale = np.empty_like(qx_squared)
    for j in range(qy_squared.size):
        for i in range(scale.size):  # a loop of its own, so that it is vectorised
            scale[i] = factor / math.sqrt(qx_squared[i] + qy_squared[j])
        if qx_squared[0] + qy_squared[j] == 0:
            scale[0] = 0
        row = block[j]
        for i in range(scale.size):
            row[i, 0] *= scale[i]
            row[i, 1] *= scale[i]


@jit
def multiply_by_q(block: np.ndarray, qx_squared: np.ndarray, qy_squared: np.ndarray, factor: float) -> None:
    """block[j, i] *= factor · sqrt(qx²[i] + qy²[j]); the last axis of `block` holds (real, imaginary)."""
    scale = np.empty_like(qx_squared)
    for j in range(qy_squared.size):
        for i in range(scale.size):
            scale[i] = factor * math.sqrt(qx_squared[i] + qy_squared[j])
        row = block[j]
        for i in range(scale.size):
            row[i, 0] *= scale[i]
            row[i, 1] *= scale[i]


@jit
def scale_modes(block: np.ndarray, scale: np.ndarray) -> None:
    """block *= scale; the last axis of `block` holds (real, imaginary)."""
    for j in range(scale.shape[0]):
        for i in range(scale.shape[1]):
            block[j, i, 0] *= scale[j, i]
            block[j, i, 1] *= scale[j, i]


@inlined
def _row(rows: Rows, k: int) -> np.ndarray:
    own, others, places = rows
    return own[places[k]] if places[k] >= 0 else others[-1 - places[k]]


@inlined
def _blend_rows(coarse: Rows, first: int, weights: np.ndarray, line: np.ndarray) -> None:
    """line[1 + j] = Σ_s weights[s] coarse[first + s, j], wrapped: one entry before and three after."""
    p, q, r, s = _row(coarse, first), _row(coarse, first + 1), _row(coarse, first + 2), _row(coarse, first + 3)
    width = p.size
    a, b, c, d = weights
    for j in range(width):
        line[u(j + 1)] = b * q[u(j)] + c * r[u(j)] + a * p[u(j)] + d * s[u(j)]
    line[0] = line[width]
    for t in range(3):
        line[width + 1 + t] = line[1 + t]


@jit
def interpolate_rows(
    coarse: Rows,
    first_index: np.ndarray,
    weights: np.ndarray,
    columns_first: np.ndarray,
    column_weights: np.ndarray,
    out: np.ndarray,
) -> None:
    """out[i, j] = Σ_st weights[i, s] column_weights[j, t] coarse[first_index[i] + s, columns_first[j] + t]: separable
    interpolation by four points; columns from −1 on, wrapping.
    """
    line = np.empty(coarse[0].shape[1] + 4, coarse[0].dtype)
    for i in range(out.shape[0]):
        _blend_rows(coarse, first_index[i], weights[i], line)
        target = out[i]
        for j in range(target.size):
            at = columns_first[j] + 1
            inner = column_weights[j, 1] * line[u(at + 1)] + column_weights[j, 2] * line[u(at + 2)]
            target[j] = inner + column_weights[j, 0] * line[u(at)] + column_weights[j, 3] * line[u(at + 3)]


@jit
def combine_columns(field: np.ndarray, first: np.ndarray, weights: np.ndarray, out: np.ndarray) -> None:
    """out[i, j] = Σ_t weights[j, t] field[i, first[j] + t]; columns wrap, by at most weights.shape[1]."""
    ny, margin = field.shape[1], weights.shape[1]
    line = np.empty(ny + 2 * margin, field.dtype)
    for i in range(field.shape[0]):
        row, target = field[i], out[i]
        for j in range(ny):
            line[u(margin + j)] = row[u(j)]
        for j in range(margin):
            line[j] = line[ny + j]
            line[margin + ny + j] = line[margin + j]
        for j in range(target.size):
            at, total = margin + first[j], 0.0
            for t in range(margin):
                total += weights[j, t] * line[u(at + t)]
            target[j] = total


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
    shares, weights): means less the means over blocks of size × size, weighted (`solvers.active_set.block_stiffness`).
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
