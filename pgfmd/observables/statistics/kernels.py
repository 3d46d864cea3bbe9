"""Compiled loops of the observables.  Each keeps the NumPy line that it replaces as its specification.

All release the GIL, so that the threads of a rank can share the rows.
"""

from __future__ import annotations

import math

import numba
import numpy as np

_jit = numba.njit(nogil=True, cache=True, fastmath={"contract", "nsz"}, error_model="numpy")


@_jit
def power_in_place(parts):
    """parts[..., 0] = |z|² and parts[..., 1] = 0 for a complex block seen as (real, imaginary) along its last axis."""
    for j in range(parts.shape[0]):
        row = parts[j]
        for i in range(row.shape[0]):
            row[i, 0] = row[i, 0] * row[i, 0] + row[i, 1] * row[i, 1]
            row[i, 1] = 0.0


@_jit
def bin_rows(values, along, across, weight, edges, sums):
    """sums[b] += Σ weight[j] values[j, i] over all points with b = searchsorted(edges, along[i] + across[j]).

    `along` rises up to its middle and falls again, as squares of wave numbers in FFT order or of periodic distances do:
    the bin of one point is found from that of the point before.
    """
    n = along.size
    for j in range(across.size):
        for side in range(2):
            b, total = 0, 0.0
            for k in range(n // 2 + 1 if side == 0 else n - n // 2 - 1):
                i = k if side == 0 else n - 1 - k
                at = along[i] + across[j]
                while b < edges.size and at > edges[b]:
                    sums[b] += weight[j] * total
                    total = 0.0
                    b += 1
                total += values[j, i]
            sums[b] += weight[j] * total


@_jit
def bin_geometry(along, across, weight, edges, counts, roots):
    """`bin_rows` of the values 1, into `counts`, and √(along[i] + across[j]), into `roots`."""
    n = along.size
    for j in range(across.size):
        for side in range(2):
            b, count, total = 0, 0.0, 0.0
            for k in range(n // 2 + 1 if side == 0 else n - n // 2 - 1):
                i = k if side == 0 else n - 1 - k
                at = along[i] + across[j]
                while b < edges.size and at > edges[b]:
                    counts[b] += weight[j] * count
                    roots[b] += weight[j] * total
                    count, total = 0.0, 0.0
                    b += 1
                count += 1.0
                total += math.sqrt(at)
            counts[b] += weight[j] * count
            roots[b] += weight[j] * total


@_jit
def count_edges(pressure, above, first, stop):
    """(points p > 0, contact/non-contact edges to the row before, and to the column before) of rows first … stop−1.

    `above` (1, ny) is the row before row 0; column 0 follows the last one.
    """
    count = across_x = across_y = 0
    for i in range(first, stop):
        row = pressure[i]
        before = pressure[i - 1] if i > 0 else above[0]
        left = row[row.size - 1] > 0
        for j in range(row.size):
            here = row[j] > 0
            count += here
            across_x += here != (before[j] > 0)
            across_y += here != left
            left = here
    return count, across_x, across_y


@_jit
def positive_range(field, first, stop):
    """(least value > 0 or inf, least value, largest value) of rows first … stop−1."""
    least_positive, least, largest = np.inf, np.inf, -np.inf
    for i in range(first, stop):
        for j in range(field.shape[1]):
            value = field[i, j]
            least, largest = min(least, value), max(largest, value)
            if value > 0:
                least_positive = min(least_positive, value)
    return least_positive, least, largest


@_jit
def histogram(field, edges, logarithmic, first, stop, counts):
    """counts += numpy.histogram(rows[rows != 0], edges): bins hold their lower edge, the last one both.

    `edges` are evenly spaced, in the logarithm if `logarithmic` (then all are positive).
    """
    m = counts.size
    origin = math.log10(edges[0]) if logarithmic else edges[0]
    scale = m / ((math.log10(edges[m]) if logarithmic else edges[m]) - origin)
    for i in range(first, stop):
        for j in range(field.shape[1]):
            value = field[i, j]
            if value == 0 or value < edges[0] or value > edges[m]:
                continue
            b = int(((math.log10(value) if logarithmic else value) - origin) * scale)
            b = min(max(b, 0), m - 1)
            while b > 0 and value < edges[b]:  # rounding of the guess
                b -= 1
            while b < m - 1 and value >= edges[b + 1]:
                b += 1
            counts[b] += 1


@_jit
def power_sums(field, scale, first, stop, sums):
    """sums[n] += Σ (scale · p)^(n+1) over the points p > 0 of rows first … stop−1."""
    for i in range(first, stop):
        for j in range(field.shape[1]):
            if field[i, j] > 0:
                x = field[i, j] * scale
                power = 1.0
                for n in range(sums.size):
                    power *= x
                    sums[n] += power


@_jit
def count_digits(keys, prefix, shift, first, stop, counts):
    """counts[(key >> shift) & 0xFFFF] += 1 for the keys with key >> shift >> 16 == prefix, of rows first … stop−1.

    `keys`: float64 fields seen as int64; a key is made to have the order of its number, as an unsigned integer.
    """
    for i in range(first, stop):
        for j in range(keys.shape[1]):
            bits = keys[i, j]
            key = np.uint64(bits) ^ np.uint64(0x8000000000000000) if bits >= 0 else ~np.uint64(bits)
            high = key >> np.uint64(shift)
            if shift == 48 or (high >> np.uint64(16)) == prefix:
                counts[high & np.uint64(0xFFFF)] += 1
