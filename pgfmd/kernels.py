"""Compiled loops.  Each keeps the NumPy line that it replaces as its specification, and a test holds the two together.

All kernels release the GIL, so that the threads of one rank can share the blocks of a slab between them.
"""

from __future__ import annotations

import math

import numba
import numpy as np

_jit = numba.njit(nogil=True, cache=True, fastmath={"contract", "arcp", "nsz", "reassoc"}, error_model="numpy")

_APART = 64  # columns


@_jit
def gather_columns(strip, first, count, block):
    """block[:count, :nx] = strip[:, first:first + count].T — in tiles of 16 rows, so that both sides stay in cache."""
    nx = strip.shape[0]
    for low in range(0, nx, 16):
        high = min(low + 16, nx)
        for j in range(count):
            for i in range(low, high):
                block[j, i] = strip[i, first + j]


@_jit
def scatter_columns(block, first, count, strip):
    """strip[:, first:first + count] = block[:count, :nx].T"""
    nx = strip.shape[0]
    for low in range(0, nx, 16):
        high = min(low + 16, nx)
        for i in range(low, high):
            for j in range(count):
                strip[i, first + j] = block[j, i]


@_jit
def divide_by_q(block, qx_squared, qy_squared, factor):
    """block[j, i] *= factor / sqrt(qx²[i] + qy²[j]), and 0 at q = 0; the last axis of `block` holds (real,
    imaginary).
    """
    for j in range(qy_squared.size):
        row = block[j]
        for i in range(qx_squared.size):
            q_squared = qx_squared[i] + qy_squared[j]
            scale = factor / math.sqrt(q_squared) if q_squared > 0 else q_squared
            row[i, 0] *= scale
            row[i, 1] *= scale


@_jit
def fill_rows(values, columns, offsets, first, rows):
    """rows[:] = 0; rows[i, columns[k]] = values[k] for the points k of row first + i."""
    for i in range(rows.shape[0]):
        row = rows[i]
        row[:] = 0
        for k in range(offsets[first + i], offsets[first + i + 1]):
            row[columns[k]] = values[k]


@_jit
def drain_rows(rows, columns, offsets, first, values):
    """values[k] = rows[i, columns[k]] for the points k of row first + i."""
    for i in range(rows.shape[0]):
        row = rows[i]
        for k in range(offsets[first + i], offsets[first + i + 1]):
            values[k] = row[columns[k]]


@_jit
def apply_stencil(rows, taps_x, taps_y, weights, columns, offsets, first, count, values):
    """values[k] = Σ_t weights[t] rows[i + taps_x[t], columns[k] + taps_y[t]] for the points k of row first + i.

    Rows i < count.  Points less than `_APART` columns apart are evaluated together with what lies between them: a loop
    over contiguous memory is faster than one over points even where most of it is thrown away.
    """
    line = np.empty(rows.shape[1], values.dtype)
    for i in range(count):
        k, end = offsets[first + i], offsets[first + i + 1]
        while k < end:
            stop = k + 1
            while stop < end and columns[stop] < columns[stop - 1] + _APART:
                stop += 1
            start = columns[k]
            dense = line[: columns[stop - 1] - start + 1]
            dense[:] = 0
            for t in range(weights.size):
                at = start + taps_y[t]
                source = rows[i + taps_x[t]][at : at + dense.size]
                weight = weights[t]
                for m in range(dense.size):
                    dense[m] += weight * source[m]
            for m in range(k, stop):
                values[m] = dense[columns[m] - start]
            k = stop


@_jit
def block_sums(values, columns, offsets, first, stop, start_row, size, sums):
    """sums[(start_row + i) // size, columns[k] // size] += values[k] for the points k of the rows first ≤ i < stop."""
    for i in range(first, stop):
        line = sums[(start_row + i) // size]
        for k in range(offsets[i], offsets[i + 1]):
            line[columns[k] // size] += values[k]


@_jit
def add_blocks(values, table, columns, offsets, first, stop, start_row, size, out):
    """out[k] = values[k] + table[(start_row + i) // size, columns[k] // size]"""
    for i in range(first, stop):
        line = table[(start_row + i) // size]
        for k in range(offsets[i], offsets[i + 1]):
            out[k] = values[k] + line[columns[k] // size]


@_jit
def interpolate_rows(coarse, first_index, weights, columns_index, column_weights, out):
    """out[i, j] = Σ weights[i, s] column_weights[j, t] coarse[first_index[i] + s, columns_index[j, t]]: separable
    interpolation.
    """
    order = weights.shape[1]
    width = coarse.shape[1]
    work = np.empty(width, coarse.dtype)
    for i in range(out.shape[0]):
        for j in range(width):
            total = weights[i, 0] * coarse[first_index[i], j]
            for s in range(1, order):
                total += weights[i, s] * coarse[first_index[i] + s, j]
            work[j] = total
        for j in range(out.shape[1]):
            total = column_weights[j, 0] * work[columns_index[j, 0]]
            for t in range(1, order):
                total += column_weights[j, t] * work[columns_index[j, t]]
            out[i, j] = total


@_jit
def contact_sums(pressure, gap, heights, first, stop):
    """(Σ p g, Σ p (g + h), Σ p, #{p > 0}, min g) of rows first … stop−1."""
    work = energy = load = 0.0
    lowest = np.inf
    count = 0
    for i in range(first, stop):
        for j in range(gap.shape[1]):
            g = gap[i, j]
            lowest = min(lowest, g)
            p = pressure[i, j]
            if p > 0:
                work += p * g
                energy += p * (g + heights[i, j])
                load += p
                count += 1
    return work, energy, load, count, lowest


@_jit
def largest_violation(pressure, gap, level, first, stop):
    """Largest |g − level| where p > 0 and level − g elsewhere, over rows first … stop−1."""
    largest = 0.0
    for i in range(first, stop):
        for j in range(gap.shape[1]):
            away = gap[i, j] - level
            if pressure[i, j] > 0:
                largest = max(largest, abs(away))
            else:
                largest = max(largest, -away)
    return largest


@_jit
def count_contact(pressure, gap, level, first, stop, counts):
    """counts[i] = #{p > 0, or p = 0 and gap < level} of row i."""
    for i in range(first, stop):
        total = 0
        for j in range(pressure.shape[1]):
            p = pressure[i, j]
            total += (p > 0) | ((p == 0) & (gap[i, j] < level))
        counts[i] = total


@_jit
def list_contact(pressure, gap, level, first, stop, offsets, columns):
    """The columns of the points that `count_contact` counts."""
    for i in range(first, stop):
        k = offsets[i]
        for j in range(pressure.shape[1]):
            p = pressure[i, j]
            if (p > 0) | ((p == 0) & (gap[i, j] < level)):
                columns[k] = j
                k += 1


@_jit
def take_rows(field, columns, offsets, first, stop, values):
    """values[k] = field[i, columns[k]] for the listed points of rows first … stop−1."""
    for i in range(first, stop):
        for k in range(offsets[i], offsets[i + 1]):
            values[k] = field[i, columns[k]]


@_jit
def put_rows(field, columns, offsets, first, stop, values):
    """field[i, columns[k]] = values[k] for the listed points of rows first … stop−1."""
    for i in range(first, stop):
        for k in range(offsets[i], offsets[i + 1]):
            field[i, columns[k]] = values[k]


@_jit
def start_rows(coarse_pressure, displacement, heights, reach, pressure):
    """p = max(coarse p, tiny) where reach · p exceeds the gap u − h, else 0; returns Σ p and #{p > 0}."""
    total = 0.0
    count = 0
    for i in range(pressure.shape[0]):
        for j in range(pressure.shape[1]):
            p = coarse_pressure[i, j]
            if reach * p > displacement[i, j] - heights[i, j]:
                p = max(p, 1e-300)
                count += 1
            else:
                p = 0.0
            pressure[i, j] = p
            total += p
    return total, count
