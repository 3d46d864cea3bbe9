"""Compiled loops over the points of a set, listed row by row, and over vectors on it: see `kernels` for their rules.

`columns` of the points of row i are columns[offsets[i]:offsets[i + 1]]; values on the set are listed in the same order.
"""

from __future__ import annotations

import numpy as np

from pgfmd.grid.kernels import SEGMENT, jit, u

_APART, _FEW = 2, 8  # columns between points evaluated together; points below which that is not worth it


@jit
def fill_rows(values, columns, offsets, first, rows):
    """rows[:] = 0; rows[i, columns[k]] = values[k] for the points k of row first + i."""
    for i in range(rows.shape[0]):
        row = rows[i]
        row[:] = 0
        for k in range(offsets[first + i], offsets[first + i + 1]):
            row[columns[k]] = values[k]


@jit
def fill_wrapped(values, columns, offsets, first, count, margin, rows):
    """rows[i, margin + columns[k]] = values[k] for the points k of row first + i, i < count, 0 elsewhere; `margin`
    columns on either side repeat those of the other.
    """
    ny = rows.shape[1] - 2 * margin
    for i in range(count):
        row = rows[i]
        row[:] = 0
        for k in range(offsets[first + i], offsets[first + i + 1]):
            row[u(margin + columns[k])] = values[k]
        for j in range(margin):
            row[j] = row[j + ny]
        for j in range(margin):
            row[ny + margin + j] = row[margin + j]


@jit
def drain_rows(rows, columns, offsets, first, values):
    """values[k] = rows[i, columns[k]] for the points k of row first + i."""
    for i in range(rows.shape[0]):
        row = rows[i]
        for k in range(offsets[first + i], offsets[first + i + 1]):
            values[k] = row[columns[k]]


@jit
def _thirteen(flat, p, s, a, b, c, d, e, f):
    """The stencil around flat index p of rows s apart.  Unsigned indices spare the test for negative ones."""
    centre = a * flat[u(p)] + b * (flat[u(p - 1)] + flat[u(p + 1)]) + c * (flat[u(p - 2)] + flat[u(p + 2)])
    corners = (flat[u(p - s - 1)] + flat[u(p - s + 1)]) + (flat[u(p + s - 1)] + flat[u(p + s + 1)])
    across = d * (flat[u(p - s)] + flat[u(p + s)]) + f * (flat[u(p - 2 * s)] + flat[u(p + 2 * s)])
    return centre + e * corners + across


@jit
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
                    values[m] = line[u(columns[m] - start)]
            k = stop


@jit
def correlate(values, columns, offsets, halo, weights, rows, targets, target_offsets, first, stop, out):
    """`apply_stencil` to `values` on one set, listed with so many rows of halo, for the points in rows first … stop−1
    of another; as many rows at a time as `rows` has room for.
    """
    batch = rows.shape[0] - 4
    for low in range(first, stop, batch):
        count = min(batch, stop - low)
        fill_wrapped(values, columns, offsets, low + halo - 2, count + 4, 2, rows)
        apply_stencil(rows, weights, targets, target_offsets, low, count, out)


@jit
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


@jit
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


@jit
def block_sums(values, columns, offsets, first, stop, size, column_block, sums):
    """sums[(i − first) // size, column_block[columns[k]]] += values[k] for the points k of rows first … stop−1."""
    for i in range(first, stop):
        line = sums[(i - first) // size]
        for k in range(offsets[i], offsets[i + 1]):
            line[u(column_block[u(columns[k])])] += values[k]


@jit
def add_blocks(values, table, columns, offsets, first, stop, row_block, column_block, out):
    """out[k] = values[k] + table[row_block[i], column_block[columns[k]]]"""
    for i in range(first, stop):
        line = table[row_block[i]]
        for k in range(offsets[i], offsets[i + 1]):
            out[k] = values[k] + line[u(column_block[u(columns[k])])]


@jit
def mark_busy(columns, offsets, least, level, first, stop, busy):
    """busy[i, s] = whether the segment s of row i holds a listed point or has a least value below `level`."""
    for i in range(first, stop):
        for s in range(least.shape[1]):
            busy[i, s] = least[i, s] < level
        for k in range(offsets[i], offsets[i + 1]):
            busy[i, u(columns[k]) // SEGMENT] = True


@jit
def count_contact(pressure, gap, level, busy, first, stop, counts):
    """counts[i] = #{p > 0, or p = 0 and gap < level} of row i, in its busy segments."""
    for i in range(first, stop):
        row, above, total = pressure[i], gap[i], 0
        for s in range(busy.shape[1]):
            if busy[i, s]:
                for j in range(s * SEGMENT, min((s + 1) * SEGMENT, row.size)):
                    p = row[u(j)]
                    total += (p > 0) | ((p == 0) & (above[u(j)] < level))
        counts[i] = total


@jit
def list_contact(pressure, gap, level, busy, first, stop, offsets, columns):
    """The columns of the points that `count_contact` counts."""
    for i in range(first, stop):
        row, above, k, end = pressure[i], gap[i], offsets[i], offsets[i + 1]
        for s in range(busy.shape[1]):
            if busy[i, s] and k < end:
                for j in range(s * SEGMENT, min((s + 1) * SEGMENT, row.size)):
                    p = row[u(j)]
                    if (p > 0) | ((p == 0) & (above[u(j)] < level)):
                        columns[k] = j
                        k += 1


@jit
def contact_sums(pressure, gap, heights, columns, offsets, first, stop):
    """(Σ p g, Σ p (g + h), Σ p, #{p > 0}) over the listed points of rows first … stop−1 where p > 0."""
    work = energy = load = 0.0
    count = 0
    for i in range(first, stop):
        for k in range(offsets[i], offsets[i + 1]):
            j = u(columns[k])
            p, g = pressure[i, j], gap[i, j]
            if p > 0:
                work += p * g
                energy += p * (g + heights[i, j])
                load += p
                count += 1
    return work, energy, load, count


@jit
def take_rows(field, columns, offsets, first, stop, values):
    """values[k] = field[i, columns[k]] for the listed points of rows first … stop−1."""
    for i in range(first, stop):
        for k in range(offsets[i], offsets[i + 1]):
            values[k] = field[i, columns[k]]


@jit
def take_below(field, columns, offsets, first, stop, level, values):
    """values[k] = level − field[i, columns[k]] for the listed points of rows first … stop−1."""
    for i in range(first, stop):
        for k in range(offsets[i], offsets[i + 1]):
            values[k] = level - field[i, columns[k]]


@jit
def dot_rows(field, columns, offsets, first, stop, values):
    """Σ field[i, columns[k]] values[k] over the listed points of rows first … stop−1."""
    total = 0.0
    for i in range(first, stop):
        for k in range(offsets[i], offsets[i + 1]):
            total += field[i, columns[k]] * values[k]
    return total


@jit
def sum_rows(field, columns, offsets, first, stop):
    """Σ field[i, columns[k]] over the listed points of rows first … stop−1."""
    total = 0.0
    for i in range(first, stop):
        for k in range(offsets[i], offsets[i + 1]):
            total += field[i, columns[k]]
    return total


@jit
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


@jit
def signed_sums(field, columns, offsets, first, stop, shift, sums):
    """sums[0, b] += f and sums[1, b] += max(f, 0), where b = columns[k] >> shift, for the listed points of rows first
    … stop−1.
    """
    for i in range(first, stop):
        for k in range(offsets[i], offsets[i + 1]):
            column = u(columns[k])
            value = field[i, column]
            sums[0, column >> shift] += value
            sums[1, column >> shift] += max(value, 0.0)


@jit
def cut_and_scale(field, columns, offsets, first, stop, shift, factors, change):
    """f = factors[columns[k] >> shift] · max(f, 0) and change[k] = what that added, for the listed points of rows first
    … stop−1.
    """
    for i in range(first, stop):
        for k in range(offsets[i], offsets[i + 1]):
            column = u(columns[k])
            old = field[i, column]
            new = factors[column >> shift] * max(old, 0.0)
            field[i, column] = new
            change[k] = new - old


@jit
def put_rows(field, columns, offsets, first, stop, values):
    """field[i, columns[k]] = values[k] for the listed points of rows first … stop−1."""
    for i in range(first, stop):
        for k in range(offsets[i], offsets[i + 1]):
            field[i, columns[k]] = values[k]


@jit
def add_to_rows(field, columns, offsets, first, stop, values):
    """field[i, columns[k]] += values[k] for the listed points of rows first … stop−1."""
    for i in range(first, stop):
        for k in range(offsets[i], offsets[i + 1]):
            field[i, columns[k]] += values[k]


@jit
def dot_and_sums(a, b, first, stop):
    """(Σ a b, Σ a, Σ b) over the entries first … stop−1, in double precision."""
    dot = sum_a = sum_b = 0.0
    for k in range(first, stop):
        x, y = np.float64(a[k]), np.float64(b[k])
        dot += x * y
        sum_a += x
        sum_b += y
    return dot, sum_a, sum_b


@jit
def turn(direction, z, factor, mean, first, stop):
    """direction = factor · direction + z − mean in the entries first … stop−1."""
    for k in range(first, stop):
        direction[k] = factor * direction[k] + (z[k] - mean)


@jit
def advance(x, residual, direction, product, step, mean, first, stop):
    """x += step · direction and residual −= step · (product − mean) in the entries first … stop−1."""
    for k in range(first, stop):
        x[k] += step * direction[k]
        residual[k] -= step * (product[k] - mean)
