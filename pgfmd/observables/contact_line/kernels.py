"""Compiled loops of the contact line.  A field `signed` holds the pressure in contact and −E' g/a outside; `around` are
its values about one pair of neighbours, a contact pixel and an open one (out of contact):

    around[0 … 3]    along the pair, outward: the pixel before the contact pixel, the pair, the pixel after the open one
    around[4 … 7]    left and right of the contact pixel, left and right of the open one
"""

from __future__ import annotations

import math

import numpy as np

from pgfmd.parallel.compiled import compiled

_jit = compiled()
_inner = compiled(no_cpython_wrapper=True)  # for what loops call

# Last axis of a table, see `table.EdgeTable`.  Not Python numbers: for each of those Numba compiles a function anew.
OFFSET, COSINE, PLACE, INNER, OUTER = map(np.int64, range(5))
_ROUNDS = 8  # of `locate`, at most; more of them change the area that the line adds by .1 % where λ_s = 4a
_LARGEST = 1e6  # of pressures and gaps over those of a pair, which may both vanish: keeps squares finite

Fields = tuple[np.ndarray, np.ndarray, np.ndarray]  # pressure, gap (nx_local, ny); two more rows each way (2, 4, ny)
Lookup = tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray], float]  # see `line_of_pixel`


@_inner
def _distance(value: float, scale: float) -> float:
    """Roughly linear in the distance to the edge on both sides: p² inside, −(¾E'g/a)^(2/3) outside."""
    if value > 0:
        return min(value / scale, _LARGEST) ** 2
    return -np.cbrt((0.75 * max(value / scale, -_LARGEST)) ** 2)


@_inner
def describe(around: np.ndarray, ratio: float) -> tuple[float, float]:
    """(share of the pressure in p + E'g/a at the pair, angle between the pair and the apparent normal, 0 … π/2).

    ratio: spacing across the pair over that along it.
    """
    scale = around[1] - around[2]
    left = _distance(around[4], scale) + _distance(around[6], scale)
    right = _distance(around[5], scale) + _distance(around[7], scale)
    middle = _distance(around[1], scale) - _distance(around[2], scale)
    along = middle
    for i in range(4, 6):
        along += _distance(around[i], scale) - _distance(around[i + 2], scale)
    across = abs(right - left) / (4 * ratio)
    return around[1] / scale, math.atan2(across, max(along / 3, 1e-9))


@_jit
def describe_all(around: np.ndarray, ratio: float, share: np.ndarray, angle: np.ndarray) -> None:
    """`describe` of each row of `around` (count, 8)."""
    for i in range(len(around)):
        share[i], angle[i] = describe(around[i], ratio)


@_inner
def _bracket(at: float, count: int) -> tuple[int, float]:
    """Index of the left one of the two points about `at`, of `count` evenly spaced from 0 to 1; weight of the right."""
    x = min(at, 1.0) * (count - 1)
    i = min(int(x), count - 2)
    return i, x - i


@_inner
def _look(table: np.ndarray, row: tuple[int, float], column: tuple[int, float], which: int) -> float:
    """Bilinear interpolation in table (angles, shares, quantities)."""
    (j, y), (i, x) = row, column
    low = table[j, i, which] * (1 - x) + table[j, i + 1, which] * x
    high = table[j + 1, i, which] * (1 - x) + table[j + 1, i + 1, which] * x
    return low * (1 - y) + high * y


@_inner
def _bounded(ratio: float, bound: float) -> float:
    return min(max(ratio, 1 / bound), bound)


@_jit
def locate(around: np.ndarray, ratio: float, table: np.ndarray, bound: float) -> tuple[float, float]:
    """(area between the line and the middle of the pair, in pixels; |cosine| of the line's normal to the pair).

    Near the edge p = K√d (1 + αd + βd²) and g = (4K/3E') |d|^1.5 (1 − ⅗α|d| + 3/7 β|d|²).  The table is exact for
    α = β = 0.  g/p at the pair is first reduced to this case: it is multiplied by P^a G^b, where P and G are p₂/p and
    g₂/g over their values at α = β = 0.  a and b cancel the terms of first and second order.  P and G are clipped to
    1/bound … bound.
    """
    plain, angle = describe(around, ratio)
    pressure, gap = around[1], -around[2]
    inward, outward = max(around[0], 0.0) / pressure, max(-around[3], 0.0) / max(gap, 1e-300)  # p₂/p, g₂/g
    row, share = _bracket(angle * (2 / math.pi), table.shape[0]), plain
    for _ in range(_ROUNDS):
        column = _bracket(share, table.shape[1])
        t = min(max(_look(table, row, column, PLACE), -0.2), 1.0)
        inner = _bounded(_look(table, row, column, INNER) * inward, bound)
        outer = _bounded(_look(table, row, column, OUTER) * outward, bound)
        first = 0.6 + 0.4 * t
        b = (t * t - 3 / 7 * (1 - t) ** 2 - first * (2 * t + 1)) / (0.6 * (2 * t + 1) + 3 / 7 * (3 - 2 * t))
        a = first + 0.6 * b
        before, share = share, pressure / (pressure + gap * math.exp(a * math.log(inner) + b * math.log(outer)))
        if abs(share - before) < 1e-4:
            break
    column = _bracket(share, table.shape[1])
    return _look(table, row, column, OFFSET), _look(table, row, column, COSINE)


@_inner
def _signed(pressure: np.ndarray, gap: np.ndarray, halo: np.ndarray, i: int, j: int, scale: float) -> float:
    """`signed` at row i, column j of a slab with two more rows before and after it: halo = (pressure, gap) of them."""
    rows, columns = pressure.shape
    if j < 0:
        j += columns
    elif j >= columns:
        j -= columns
    if i < 0 or i >= rows:
        k = i + 2 if i < 0 else i - rows + 2
        p, g = halo[0, k, j], halo[1, k, j]
    else:
        p, g = pressure[i, j], gap[i, j]
    return p if p > 0 else -scale * max(g, 0.0)


@_inner
def line_of_pixel(
    fields: Fields, lookup: Lookup, i: int, j: int, around: np.ndarray
) -> tuple[float, float, float, float]:
    """What the line adds at contact pixel (i, j): (area in pixels beyond the pixel itself, Σ cos θ over its open
    neighbours along x, the same along y, corners).  Each cosine is a length in spacings across the pair.

    fields: pressure, gap (nx_local, ny) and their two more rows before and after the slab (2, 4, ny)
    lookup: (E'/spacing, spacing across the pair over that along it, table), each for pairs along x and along y; and
    `bound` of `locate`
    corners: a quarter for each convex corner of the contact's outline, minus a quarter for each concave one; their sum
    over a patch is the number of its outer outlines less that of its holes.
    """
    pressure, gap, halo = fields
    scales, ratios, tables, bound = lookup
    area = corners = 0.0
    length_x = length_y = 0.0
    for axis in range(2):
        scale = scales[axis]
        for sign in (-1, 1):
            di, dj = (sign, 0) if axis == 0 else (0, sign)
            if _signed(pressure, gap, halo, i + di, j + dj, scale) > 0:
                continue
            for k in range(8):
                along, across = (k - 1, 0) if k < 4 else ((k - 4) // 2, 2 * (k % 2) - 1)
                row, column = i + along * di + across * dj, j + along * dj + across * di
                around[k] = _signed(pressure, gap, halo, row, column, scale)
            offset, cosine = locate(around, ratios[axis], tables[axis], bound)
            area += offset
            if axis == 0:
                length_x += cosine
            else:
                length_y += cosine
    for di in (-1, 1):
        one = _signed(pressure, gap, halo, i + di, j, 1.0) > 0
        for dj in (-1, 1):
            other = _signed(pressure, gap, halo, i, j + dj, 1.0) > 0
            if one == other and not _signed(pressure, gap, halo, i + di, j + dj, 1.0) > 0:
                corners += -0.25 if one else 0.25
    return area, length_x, length_y, corners


@compiled(inline="always")
def add_line(fields: Fields, lookup: Lookup, i: int, columns: tuple[int, int], total: np.ndarray) -> None:
    """Adds `line_of_pixel` of the contact pixels of row i in columns start … stop−1 to `total` (4,)."""
    around = np.empty(8)
    pressure, halo = fields[0], fields[2]
    rows, ny = pressure.shape
    row = pressure[i]
    above = pressure[i - 1] if i > 0 else halo[0, 1]
    below = pressure[i + 1] if i + 1 < rows else halo[0, 2]
    for j in range(columns[0], columns[1]):
        if not row[j] > 0:
            continue
        left, right = j - 1 if j > 0 else ny - 1, j + 1 if j + 1 < ny else 0
        if row[left] > 0 and row[right] > 0 and above[left] > 0 and above[j] > 0 and above[right] > 0:
            if below[left] > 0 and below[j] > 0 and below[right] > 0:
                continue
        area, length_x, length_y, corners = line_of_pixel(fields, lookup, i, j, around)
        total[0] += area
        total[1] += length_x
        total[2] += length_y
        total[3] += corners


@_jit
def add_lines_of_rows(fields: Fields, lookup: Lookup, first: int, total: np.ndarray) -> None:
    """`add_line` of row first + i to total[i], for each i."""
    for i in range(len(total)):
        add_line(fields, lookup, first + i, (0, fields[0].shape[1]), total[i])


@_jit
def add_lines_of_patches(
    fields: Fields, lookup: Lookup, runs: tuple[np.ndarray, np.ndarray], patch: np.ndarray, total: np.ndarray,
    of_rows: np.ndarray,
) -> None:  # fmt: skip
    """`add_line` of each run to total[p] of its patch p = patch[run] and to of_rows[i] of its row i.

    runs: themselves and the first of each row, as in `patches.run_length`
    """
    columns, first = runs
    for i in range(len(of_rows)):
        for k in range(first[i + 1], first[i + 2]):
            of_run = np.zeros(4)
            add_line(fields, lookup, i, (columns[k, 0], columns[k, 1]), of_run)
            for which in range(4):
                total[patch[k], which] += of_run[which]
                of_rows[i, which] += of_run[which]
