"""Compiled loops.  Each keeps the NumPy line that it replaces as its specification, and a test holds the two together.

All kernels release the GIL, so that the threads of one rank can share the blocks of a slab between them.
"""

from __future__ import annotations

import math

import numba
import numpy as np

_jit = numba.njit(nogil=True, cache=True, fastmath={"contract", "arcp", "nsz", "reassoc"}, error_model="numpy")

_u = np.uintp  # of indices: spares the test for negative ones, without which loops are not vectorised
_APART, _FEW = 2, 8  # columns between points evaluated together; points below which that is not worth it


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
    scale = np.empty_like(qx_squared)
    for j in range(qy_squared.size):
        for i in range(scale.size):  # apart from the product, so that roots and quotients are taken many at a time
            scale[i] = factor / math.sqrt(qx_squared[i] + qy_squared[j])
        if qx_squared[0] + qy_squared[j] == 0:
            scale[0] = 0
        row = block[j]
        for i in range(scale.size):
            row[i, 0] *= scale[i]
            row[i, 1] *= scale[i]


@_jit
def multiply_by_q(block, qx_squared, qy_squared, factor):
    """block[j, i] *= factor · sqrt(qx²[i] + qy²[j]); the last axis of `block` holds (real, imaginary)."""
    scale = np.empty_like(qx_squared)
    for j in range(qy_squared.size):
        for i in range(scale.size):
            scale[i] = factor * math.sqrt(qx_squared[i] + qy_squared[j])
        row = block[j]
        for i in range(scale.size):
            row[i, 0] *= scale[i]
            row[i, 1] *= scale[i]


@_jit
def fill_rows(values, columns, offsets, first, rows):
    """rows[:] = 0; rows[i, columns[k]] = values[k] for the points k of row first + i."""
    for i in range(rows.shape[0]):
        row = rows[i]
        row[:] = 0
        for k in range(offsets[first + i], offsets[first + i + 1]):
            row[columns[k]] = values[k]


@_jit
def fill_wrapped(values, columns, offsets, first, count, margin, rows):
    """rows[i, margin + columns[k]] = values[k] for the points k of row first + i, i < count, 0 elsewhere; `margin`
    columns on either side repeat those of the other.
    """
    ny = rows.shape[1] - 2 * margin
    for i in range(count):
        row = rows[i]
        row[:] = 0
        for k in range(offsets[first + i], offsets[first + i + 1]):
            row[_u(margin + columns[k])] = values[k]
        for j in range(margin):
            row[j] = row[j + ny]
        for j in range(margin):
            row[ny + margin + j] = row[margin + j]


@_jit
def drain_rows(rows, columns, offsets, first, values):
    """values[k] = rows[i, columns[k]] for the points k of row first + i."""
    for i in range(rows.shape[0]):
        row = rows[i]
        for k in range(offsets[first + i], offsets[first + i + 1]):
            values[k] = row[columns[k]]


@_jit
def _thirteen(flat, p, s, a, b, c, d, e, f):
    """The stencil around flat index p of rows s apart.  Unsigned indices spare the test for negative ones."""
    centre = a * flat[_u(p)] + b * (flat[_u(p - 1)] + flat[_u(p + 1)]) + c * (flat[_u(p - 2)] + flat[_u(p + 2)])
    corners = (flat[_u(p - s - 1)] + flat[_u(p - s + 1)]) + (flat[_u(p + s - 1)] + flat[_u(p + s + 1)])
    across = d * (flat[_u(p - s)] + flat[_u(p + s)]) + f * (flat[_u(p - 2 * s)] + flat[_u(p + 2 * s)])
    return centre + e * corners + across


@_jit
def apply_stencil(rows, weights, columns, offsets, first, count, values):
    """values[k] = Σ_st w[s, t] rows[i + 2 + s, columns[k] + 2 + t] for the points k of row first + i, rows i < count.

    weights: w[0, 0], w[0, ±1], w[0, ±2], w[±1, 0], w[±1, ±1], w[±2, 0]; the others are zero.  Points that lie close
    are evaluated together with what lies between them: a loop over contiguous memory is several times faster.
    """
    flat, stride = rows.reshape(-1), rows.shape[1]
    line = np.empty(stride, values.dtype)
    a, b, c, d, e, f = weights
    for i in range(count):
        base = (i + 2) * stride + 2
        k, end = offsets[first + i], offsets[first + i + 1]
        while k < end:
            stop, start = k + 1, columns[k]
            while stop < end and columns[stop] <= columns[stop - 1] + _APART:
                stop += 1
            if stop - k < _FEW:
                for m in range(k, stop):
                    values[m] = _thirteen(flat, base + columns[m], stride, a, b, c, d, e, f)
            else:
                for m in range(columns[stop - 1] - start + 1):
                    line[m] = _thirteen(flat, base + start + m, stride, a, b, c, d, e, f)
                for m in range(k, stop):
                    values[m] = line[_u(columns[m] - start)]
            k = stop


@_jit
def spread_points(values, columns, offsets, first, stop, x_first, x_weights, y_first, y_weights, mesh_row, mesh):
    """mesh[x_first[i] + s − mesh_row, y_first[k] + t] += x_weights[i, s] y_weights[k, t] values[k] for the points k of
    the rows first ≤ i < stop and s, t < 4; rows outside `mesh` are left out, columns wrap.
    """
    ny = mesh.shape[1]
    line = np.empty(ny + 4, mesh.dtype)
    for i in range(first, stop):
        if offsets[i] == offsets[i + 1]:
            continue
        line[:] = 0
        for k in range(offsets[i], offsets[i + 1]):
            column = columns[k]
            at = y_first[column] + 1
            for t in range(4):
                line[at + t] += y_weights[column, t] * values[k]
        line[ny] += line[0]
        for t in range(1, 4):
            line[t] += line[ny + t]
        for s in range(4):
            row = x_first[i] + s - mesh_row
            weight = x_weights[i, s]
            if 0 <= row < mesh.shape[0] and weight != 0:
                target = mesh[row]
                for j in range(ny):
                    target[j] += weight * line[j + 1]


@_jit
def add_interpolated(mesh, mesh_row, columns, offsets, first, stop, x_first, x_weights, y_first, y_weights, values):
    """values[k] += Σ_st x_weights[i, s] y_weights[k, t] mesh[x_first[i] + s − mesh_row, y_first[k] + t] for the points
    k of the rows first ≤ i < stop; columns wrap.
    """
    ny = mesh.shape[1]
    line = np.empty(ny + 4, mesh.dtype)
    for i in range(first, stop):
        if offsets[i] == offsets[i + 1]:
            continue
        at = x_first[i] - mesh_row
        a, b, c, d = x_weights[i]
        for j in range(ny):
            line[j + 1] = a * mesh[at, j] + b * mesh[at + 1, j] + c * mesh[at + 2, j] + d * mesh[at + 3, j]
        line[0] = line[ny]
        for t in range(3):
            line[ny + 1 + t] = line[1 + t]
        for k in range(offsets[i], offsets[i + 1]):
            column = columns[k]
            at = y_first[column] + 1
            total = values[k]
            for t in range(4):
                total += y_weights[column, t] * line[at + t]
            values[k] = total


@_jit
def scale_modes(block, scale):
    """block *= scale; the last axis of `block` holds (real, imaginary)."""
    for j in range(scale.shape[0]):
        for i in range(scale.shape[1]):
            block[j, i, 0] *= scale[j, i]
            block[j, i, 1] *= scale[j, i]


@_jit
def block_sums(values, columns, offsets, first, stop, size, column_block, sums):
    """sums[(i − first) // size, column_block[columns[k]]] += values[k] for the points k of rows first … stop−1."""
    for i in range(first, stop):
        line = sums[(i - first) // size]
        for k in range(offsets[i], offsets[i + 1]):
            line[_u(column_block[_u(columns[k])])] += values[k]


@_jit
def add_blocks(values, table, columns, offsets, first, stop, row_block, column_block, out):
    """out[k] = values[k] + table[row_block[i], column_block[columns[k]]]"""
    for i in range(first, stop):
        line = table[row_block[i]]
        for k in range(offsets[i], offsets[i + 1]):
            out[k] = values[k] + line[_u(column_block[_u(columns[k])])]


@_jit
def interpolate_rows(coarse, first_index, weights, columns_first, column_weights, out):
    """out[i, j] = Σ_st weights[i, s] column_weights[j, t] coarse[first_index[i] + s, columns_first[j] + t]: separable
    interpolation by `order` = 2 or 4 points; columns from −1 on, wrapping.
    """
    order, width = weights.shape[1], coarse.shape[1]
    line = np.empty(width + 4, coarse.dtype)
    for i in range(out.shape[0]):
        line[:] = 0
        for s in range(order):
            weight, row = weights[i, s], coarse[first_index[i] + s]
            for j in range(width):
                line[_u(j + 1)] += weight * row[j]
        line[0] = line[width]
        for t in range(3):
            line[width + 1 + t] = line[1 + t]
        target = out[i]
        if order == 2:
            for j in range(target.size):
                at = columns_first[j] + 1
                target[j] = column_weights[j, 0] * line[_u(at)] + column_weights[j, 1] * line[_u(at + 1)]
        else:
            for j in range(target.size):
                at = columns_first[j] + 1
                inner = column_weights[j, 1] * line[_u(at + 1)] + column_weights[j, 2] * line[_u(at + 2)]
                target[j] = inner + column_weights[j, 0] * line[_u(at)] + column_weights[j, 3] * line[_u(at + 3)]


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
def open_gap(pressure, gap, level, first, stop):
    """gap = 0 where p > 0, max(gap − level, 0) elsewhere, in rows first … stop−1."""
    for i in range(first, stop):
        for j in range(gap.shape[1]):
            gap[i, j] = 0.0 if pressure[i, j] > 0 else max(gap[i, j] - level, 0.0)


@_jit
def close_pressure(pressure, gap, first, stop):
    """p = 0 where the gap is not 0, max(p, 0) elsewhere, in rows first … stop−1; returns Σ p."""
    total = 0.0
    for i in range(first, stop):
        for j in range(gap.shape[1]):
            p = 0.0 if gap[i, j] != 0 else max(pressure[i, j], 0.0)
            pressure[i, j] = p
            total += p
    return total


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
        k, end = offsets[i], offsets[i + 1]
        if k == end:
            continue
        row, above = pressure[i], gap[i]
        for j in range(row.size):
            p = row[j]
            if (p > 0) | ((p == 0) & (above[j] < level)):
                columns[k] = j
                k += 1
                if k == end:
                    break


@_jit
def take_rows(field, columns, offsets, first, stop, values):
    """values[k] = field[i, columns[k]] for the listed points of rows first … stop−1."""
    for i in range(first, stop):
        for k in range(offsets[i], offsets[i + 1]):
            values[k] = field[i, columns[k]]


@_jit
def take_below(field, columns, offsets, first, stop, level, values):
    """values[k] = level − field[i, columns[k]] for the listed points of rows first … stop−1."""
    for i in range(first, stop):
        for k in range(offsets[i], offsets[i + 1]):
            values[k] = level - field[i, columns[k]]


@_jit
def dot_rows(field, columns, offsets, first, stop, values):
    """Σ field[i, columns[k]] values[k] over the listed points of rows first … stop−1."""
    total = 0.0
    for i in range(first, stop):
        for k in range(offsets[i], offsets[i + 1]):
            total += field[i, columns[k]] * values[k]
    return total


@_jit
def sum_rows(field, columns, offsets, first, stop):
    """Σ field[i, columns[k]] over the listed points of rows first … stop−1."""
    total = 0.0
    for i in range(first, stop):
        for k in range(offsets[i], offsets[i + 1]):
            total += field[i, columns[k]]
    return total


@_jit
def cut_negative(field, columns, offsets, first, stop, change):
    """f = max(f, 0) and change[k] = what that added, for the listed points of rows first … stop−1; returns #{f < 0}."""
    count = 0
    for i in range(first, stop):
        for k in range(offsets[i], offsets[i + 1]):
            value = field[i, columns[k]]
            change[k] = max(-value, 0.0)
            if value < 0:
                field[i, columns[k]] = 0.0
                count += 1
    return count


@_jit
def signed_sums(field, columns, offsets, first, stop, shift, sums):
    """sums[0, b] += f and sums[1, b] += max(f, 0), where b = columns[k] >> shift, for the listed points of rows first
    … stop−1.
    """
    for i in range(first, stop):
        for k in range(offsets[i], offsets[i + 1]):
            column = _u(columns[k])
            value = field[i, column]
            sums[0, column >> shift] += value
            sums[1, column >> shift] += max(value, 0.0)


@_jit
def cut_and_scale(field, columns, offsets, first, stop, shift, factors, change):
    """f = factors[columns[k] >> shift] · max(f, 0) and change[k] = what that added, for the listed points of rows first
    … stop−1.
    """
    for i in range(first, stop):
        for k in range(offsets[i], offsets[i + 1]):
            column = _u(columns[k])
            old = field[i, column]
            new = factors[column >> shift] * max(old, 0.0)
            field[i, column] = new
            change[k] = new - old


@_jit
def put_rows(field, columns, offsets, first, stop, values):
    """field[i, columns[k]] = values[k] for the listed points of rows first … stop−1."""
    for i in range(first, stop):
        for k in range(offsets[i], offsets[i + 1]):
            field[i, columns[k]] = values[k]


@_jit
def add_to_rows(field, columns, offsets, first, stop, values):
    """field[i, columns[k]] += values[k] for the listed points of rows first … stop−1."""
    for i in range(first, stop):
        for k in range(offsets[i], offsets[i + 1]):
            field[i, columns[k]] += values[k]


@_jit
def dot_and_sums(a, b, first, stop):
    """(Σ a b, Σ a, Σ b) over the entries first … stop−1, in double precision."""
    dot = sum_a = sum_b = 0.0
    for k in range(first, stop):
        x, y = np.float64(a[k]), np.float64(b[k])
        dot += x * y
        sum_a += x
        sum_b += y
    return dot, sum_a, sum_b


@_jit
def turn(direction, z, factor, mean, first, stop):
    """direction = factor · direction + z − mean in the entries first … stop−1."""
    for k in range(first, stop):
        direction[k] = factor * direction[k] + (z[k] - mean)


@_jit
def advance(x, residual, direction, product, step, mean, first, stop):
    """x += step · direction and residual −= step · (product − mean) in the entries first … stop−1."""
    for k in range(first, stop):
        x[k] += step * direction[k]
        residual[k] -= step * (product[k] - mean)


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
