"""Compiled loops over the points of a set, listed row by row, and over vectors on it: see `kernels` for their rules.

points: (columns, offsets); columns of the points of row i are columns[offsets[i]:offsets[i + 1]], and values on the set
are listed in the same order.  part: (first, stop), the rows or entries first … stop−1.  fields: (pressure, gap).
"""

from __future__ import annotations

import numpy as np

from pgfmd.grid.kernels import jit, u

Points = tuple[np.ndarray, np.ndarray]
Fields = tuple[np.ndarray, np.ndarray]
Part = tuple[int, int]
Splines = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""First node and weights of each row, and of each column."""
Change = tuple[float, float, float]
"""Of a pressure: factor, stiffness, level (`_changed`)."""

_APART, _FEW = 2, 8  # columns between points evaluated together; points below which that is not worth it


@jit
def fill_rows(values: np.ndarray, points: Points, first: int, rows: np.ndarray) -> None:
    """rows[:] = 0; rows[i, columns[k]] = values[k] for the points k of row first + i."""
    columns, offsets = points
    for i in range(rows.shape[0]):
        row = rows[i]
        row[:] = 0
        for k in range(offsets[first + i], offsets[first + i + 1]):
            row[columns[k]] = values[k]


@jit
def fill_wrapped(values: np.ndarray, points: Points, first: int, count: int, margin: int, rows: np.ndarray) -> None:
    """rows[i, margin + columns[k]] = values[k] for the points k of row first + i, i < count, 0 elsewhere; `margin`
    columns on either side repeat those of the other.
    """
    columns, offsets = points
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
def drain_rows(rows: np.ndarray, points: Points, first: int, values: np.ndarray) -> None:
    """values[k] = rows[i, columns[k]] for the points k of row first + i."""
    columns, offsets = points
    for i in range(rows.shape[0]):
        row = rows[i]
        for k in range(offsets[first + i], offsets[first + i + 1]):
            values[k] = row[columns[k]]


@jit
def _thirteen(flat: np.ndarray, p: int, s: int, weights: tuple[float, ...]) -> float:
    """The stencil around flat index p of rows s apart.  Unsigned indices spare the test for negative ones."""
    a, b, c, d, e, f = weights
    centre = a * flat[u(p)] + b * (flat[u(p - 1)] + flat[u(p + 1)]) + c * (flat[u(p - 2)] + flat[u(p + 2)])
    corners = (flat[u(p - s - 1)] + flat[u(p - s + 1)]) + (flat[u(p + s - 1)] + flat[u(p + s + 1)])
    across = d * (flat[u(p - s)] + flat[u(p + s)]) + f * (flat[u(p - 2 * s)] + flat[u(p + 2 * s)])
    return centre + e * corners + across


@jit
def apply_stencil(
    rows: np.ndarray, weights: np.ndarray, points: Points, first: int, count: int, values: np.ndarray
) -> None:
    """values[k] = Σ_st w[s, t] rows[i + 2 + s, columns[k] + 2 + t] for the points k of row first + i, rows i < count.

    weights: w[0, 0], w[0, ±1], w[0, ±2], w[±1, 0], w[±1, ±1], w[±2, 0]; the others are zero.  Points that lie close
    are evaluated together with what lies between them: a loop over contiguous memory is several times faster.
    """
    columns, offsets = points
    flat, stride = rows.reshape(-1), rows.shape[1]
    line = np.empty(stride, values.dtype)
    a, b, c, d, e, f = weights
    six = (a, b, c, d, e, f)
    for i in range(count):
        base = (i + 2) * stride + 2
        k, end = offsets[first + i], offsets[first + i + 1]
        while k < end:
            stop, start = k + 1, columns[k]
            while stop < end and columns[stop] <= columns[stop - 1] + _APART:
                stop += 1
            if stop - k < _FEW:
                for m in range(k, stop):
                    values[m] = _thirteen(flat, base + columns[m], stride, six)
            else:
                for m in range(columns[stop - 1] - start + 1):
                    line[m] = _thirteen(flat, base + start + m, stride, six)
                for m in range(k, stop):
                    values[m] = line[u(columns[m] - start)]
            k = stop


@jit
def correlate(
    vector: tuple[np.ndarray, Points],
    weights: np.ndarray,
    rows: np.ndarray,
    targets: Points,
    part: Part,
    out: np.ndarray,
) -> None:
    """`apply_stencil` to a vector (values, points) on one set, whose rows are listed from two before the first on, for
    the points of another in rows first … stop−1; as many rows at a time as `rows` has room for.
    """
    values, points = vector
    first, stop = part
    batch = rows.shape[0] - 4
    for low in range(first, stop, batch):
        count = min(batch, stop - low)
        fill_wrapped(values, points, low, count + 4, 2, rows)
        apply_stencil(rows, weights, targets, low, count, out)


@jit
def spread_points(
    values: np.ndarray, points: Points, part: Part, splines: Splines, mesh_row: int, mesh: np.ndarray
) -> None:
    """mesh[x_first[i] + s − mesh_row, y_first[k] + t] += x_weights[i, s] y_weights[k, t] values[k] for the points k of
    the rows first ≤ i < stop and s, t < 4; rows outside `mesh` are left out, columns wrap.
    """
    columns, offsets = points
    first, stop = part
    x_first, x_weights, y_first, y_weights = splines
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
def add_interpolated(
    mesh: np.ndarray, mesh_row: int, points: Points, part: Part, splines: Splines, values: np.ndarray
) -> None:
    """values[k] += Σ_st x_weights[i, s] y_weights[k, t] mesh[x_first[i] + s − mesh_row, y_first[k] + t] for the points
    k of the rows first ≤ i < stop; columns wrap.
    """
    columns, offsets = points
    first, stop = part
    x_first, x_weights, y_first, y_weights = splines
    line, ny = np.empty(mesh.shape[1] + 4, mesh.dtype), mesh.shape[1]
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
def block_sums(
    values: np.ndarray, points: Points, part: Part, size: int, column_block: np.ndarray, sums: np.ndarray
) -> None:
    """sums[(i − first) // size, column_block[columns[k]]] += values[k] for the points k of those of rows first … stop−1
    that exist.
    """
    columns, offsets = points
    first, stop = part
    for i in range(max(first, 0), min(stop, offsets.size - 1)):
        line = sums[(i - first) // size]
        for k in range(offsets[i], offsets[i + 1]):
            line[u(column_block[u(columns[k])])] += values[k]


@jit
def subtract_blocks(
    values: np.ndarray,
    table: np.ndarray,
    points: Points,
    part: Part,
    blocks: tuple[np.ndarray, np.ndarray],
    out: np.ndarray,
) -> None:
    """out[k] = values[k] − table[row_block[i], column_block[columns[k]]]; blocks: these two."""
    columns, offsets = points
    first, stop = part
    row_block, column_block = blocks
    for i in range(first, stop):
        line = table[row_block[i]]
        for k in range(offsets[i], offsets[i + 1]):
            out[k] = values[k] - line[u(column_block[u(columns[k])])]


@jit
def _unknown(p: float, g: float, level: float, top: float) -> bool:
    """Whether p lies between its bounds 0 and `top`, or at one of them with a gap that drives it away from there."""
    return ((p > 0) | (g < level)) & ((p < top) | (g > level))


@jit
def count_unknowns(fields: Fields, level: float, top: float, part: Part, counts: np.ndarray) -> None:
    """counts[i] = number of unknowns in row i."""
    pressure, gap = fields
    first, stop = part
    for i in range(first, stop):
        row, above, total = pressure[i], gap[i], 0
        for j in range(row.size):
            total += _unknown(row[u(j)], above[u(j)], level, top)
        counts[i] = total


@jit
def list_unknowns(fields: Fields, level: float, top: float, part: Part, points: Points) -> None:
    """The columns of the points that `count_unknowns` counts."""
    pressure, gap = fields
    first, stop = part
    columns, offsets = points
    for i in range(first, stop):
        row, above, k = pressure[i], gap[i], offsets[i]
        if k == offsets[i + 1]:
            continue
        for j in range(row.size):
            if _unknown(row[u(j)], above[u(j)], level, top):
                columns[k] = j
                k += 1


@jit
def contact_sums(
    pressure: np.ndarray, gap: np.ndarray, heights: np.ndarray, top: float, first: int, stop: int
) -> tuple[tuple[float, float, float, float, float, float, int], float, float]:
    """(Σ p g, Σ p and number of points where 0 < p < top; Σ p (g + h), Σ p², Σ h² and number of points where p > 0),
    and the highest gap where p = top and the lowest where p = 0, over rows first … stop−1.
    """
    work = load = energy = squares = heights_squared = 0.0
    between = count = 0
    highest, lowest = -np.inf, np.inf
    for i in range(first, stop):
        row = pressure[i]
        for j in range(row.size):
            p = row[u(j)]
            g = gap[i, u(j)]
            if p > 0:
                h = heights[i, u(j)]
                energy += p * (g + h)
                squares += p * p
                heights_squared += h * h
                count += 1
                if p < top:
                    work += p * g
                    load += p
                    between += 1
                else:
                    highest = max(highest, g)
            else:
                lowest = min(lowest, g)
    return (work, load, between, energy, squares, heights_squared, count), highest, lowest


@jit
def residual_rows(fields: Fields, level: float, top: float, edges: np.ndarray, first: int, out: np.ndarray) -> None:
    """ρ of the certificate for rows first … of pressure and gap: gap − level where 0 < p < top.  Elsewhere the mean of
    that over the eight neighbours, of which the others count as 0, but at most gap − level where p = 0, and at least
    that where p = top.  edges: the same, or 0, of the rows before and after those of this rank.
    """
    pressure, gap = fields
    rows, ny = pressure.shape
    lines = np.empty((3, ny))
    for i in range(first - 1, first + out.shape[0] + 1):
        line = lines[(i + 1) % 3]
        if i < 0 or i == rows:
            for j in range(ny):  # an assignment of arrays takes seconds to compile, for its messages
                line[j] = edges[0 if i < 0 else 1, j]
        else:
            for j in range(ny):
                line[j] = gap[i, j] - level if 0 < pressure[i, j] < top else 0.0
        if i <= first:
            continue
        p, g, target = pressure[i - 1], gap[i - 1], out[i - 1 - first]
        here = lines[i % 3]
        for j in range(ny):
            if 0 < p[j] < top:
                target[j] = here[j]
                continue
            left, right = j - 1 if j > 0 else ny - 1, j + 1 if j + 1 < ny else 0
            around = 0.0
            for other in range(3):
                around += lines[other, left] + lines[other, j] + lines[other, right]
            around /= 8
            target[j] = min(around, g[j] - level) if p[j] <= 0 else max(around, g[j] - level)


ROUGHER = 0.3  # of the heights that only the finer grid resolves, the start on it flattens this part


@jit
def start_rows(
    coarse: tuple[np.ndarray, np.ndarray, np.ndarray],
    heights: np.ndarray,
    compliance: float,
    pressure: np.ndarray,
    gap: np.ndarray,
) -> None:
    """Pressure and gap that start a finer grid, from those of the coarse one interpolated.  With new = h − coarse h,
    the gap is g = coarse g − new.  Where compliance · coarse p > g the point is in contact: its pressure is
    max(coarse p + ROUGHER · new/compliance, tiny), its gap g + ROUGHER · new.  Elsewhere the pressure is 0.
    """
    coarse_pressure, coarse_gap, coarse_heights = coarse
    for i in range(pressure.shape[0]):
        for j in range(pressure.shape[1]):
            p, new = coarse_pressure[i, j], heights[i, j] - coarse_heights[i, j]
            g = coarse_gap[i, j] - new
            closed = compliance * p > g
            gap[i, j] = g + ROUGHER * new if closed else g
            pressure[i, j] = max(p + ROUGHER / compliance * new, 1e-300) if closed else 0.0


LARGEST = 1e25  # of a residual: sums of such over stencils and meshes stay below what single precision holds


@jit
def take_below(field: np.ndarray, points: Points, part: Part, level: float, values: np.ndarray) -> None:
    """values[k] = level − field[i, columns[k]] for the listed points of rows first … stop−1, at most `LARGEST`."""
    columns, offsets = points
    first, stop = part
    for i in range(first, stop):
        for k in range(offsets[i], offsets[i + 1]):
            values[k] = min(max(level - field[i, columns[k]], -LARGEST), LARGEST)


@jit
def sums_in_blocks(pressure: np.ndarray, points: Points, part: Part, shift: int, top: float, sums: np.ndarray) -> None:
    """sums[0, b] += p and sums[1, b] += min(max(p, 0), top), where b = columns[k] >> shift, for the listed points of
    rows first … stop−1.
    """
    columns, offsets = points
    first, stop = part
    for i in range(first, stop):
        for k in range(offsets[i], offsets[i + 1]):
            column = u(columns[k])
            p = pressure[i, column]
            sums[0, column >> shift] += p
            sums[1, column >> shift] += min(max(p, 0.0), top)


@jit
def cut_and_scale(
    pressure: np.ndarray, points: Points, part: Part, shift: int, top: float, factors: np.ndarray
) -> None:
    """p = min(factors[columns[k] >> shift] · max(p, 0), top) for the listed points of rows first … stop−1."""
    columns, offsets = points
    first, stop = part
    for i in range(first, stop):
        for k in range(offsets[i], offsets[i + 1]):
            column = u(columns[k])
            pressure[i, column] = min(factors[column >> shift] * max(pressure[i, column], 0.0), top)


@jit
def _changed(p: float, g: float, change: Change, top: float) -> float:
    """factor · p where p < top, or if there is a stiffness p + stiffness · (level − g); cut at 0 and `top`."""
    factor, stiffness, level = change
    if stiffness > 0:
        p += stiffness * (level - g)
    elif p < top:
        p *= factor
    return min(max(p, 0.0), top)


@jit
def changed_sums(fields: Fields, change: Change, top: float, first: int, stop: int) -> tuple[float, float]:
    """Σ p after the change, over rows first … stop−1, and its derivative by the level, or by the factor if there is no
    stiffness.
    """
    pressure, gap = fields
    total = slope = 0.0
    for i in range(first, stop):
        for j in range(pressure.shape[1]):
            p = _changed(pressure[i, j], gap[i, j], change, top)
            total += p
            if 0 < p < top:
                slope += change[1] if change[1] > 0 else pressure[i, j]
    return total, slope


@jit
def change_rows(fields: Fields, change: Change, top: float, first: int, stop: int) -> None:
    """Changes the pressure of rows first … stop−1."""
    pressure, gap = fields
    for i in range(first, stop):
        for j in range(pressure.shape[1]):
            pressure[i, j] = _changed(pressure[i, j], gap[i, j], change, top)


@jit
def add_to_rows(field: np.ndarray, points: Points, part: Part, values: np.ndarray) -> None:
    """field[i, columns[k]] += values[k] for the listed points of rows first … stop−1."""
    columns, offsets = points
    first, stop = part
    for i in range(first, stop):
        for k in range(offsets[i], offsets[i + 1]):
            field[i, columns[k]] += values[k]


@jit
def dot_and_sums(a: np.ndarray, b: np.ndarray, first: int, stop: int) -> tuple[float, float, float]:
    """(Σ a b, Σ a, Σ b) over the entries first … stop−1, in double precision."""
    dot = sum_a = sum_b = 0.0
    for k in range(first, stop):
        x, y = np.float64(a[k]), np.float64(b[k])
        dot += x * y
        sum_a += x
        sum_b += y
    return dot, sum_a, sum_b


@jit
def turn(direction: np.ndarray, z: np.ndarray, factor: float, mean: float, first: int, stop: int) -> None:
    """direction = factor · direction + z − mean in the entries first … stop−1."""
    for k in range(first, stop):
        direction[k] = factor * direction[k] + (z[k] - mean)


@jit
def advance(
    x: np.ndarray, residual: np.ndarray, along: tuple[np.ndarray, np.ndarray], step: float, mean: float, part: Part
) -> None:
    """x += step · direction and residual −= step · (product − mean) in the entries first … stop−1; along: direction and
    product.
    """
    direction, product = along
    first, stop = part
    for k in range(first, stop):
        x[k] += step * direction[k]
        residual[k] -= step * (product[k] - mean)
