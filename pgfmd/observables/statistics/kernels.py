"""Compiled loops of the observables.  Each docstring gives the formula or the NumPy line that the loop replaces.

All release the GIL, so that the threads of a rank can share the rows.
"""

from __future__ import annotations

import math

import numpy as np

from pgfmd.parallel.compiled import compiled

FAST = {"contract", "nsz"}
_jit = compiled(fastmath=FAST)


@_jit
def bin_rows(
    values: np.ndarray, along: np.ndarray, across: np.ndarray, weight: np.ndarray, edges: np.ndarray, sums: np.ndarray
) -> None:
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
def bin_geometry(
    along: np.ndarray, across: np.ndarray, weight: np.ndarray, edges: np.ndarray, counts: np.ndarray, roots: np.ndarray
) -> None:
    """`bin_rows` of the values 1, into `counts`, and √(along[i] + across[j]), into `roots`; along[i] = along[n − i]."""
    n = along.size
    for j in range(across.size):
        b, count, total = 0, 0.0, 0.0
        for i in range(n // 2 + 1):
            at = along[i] + across[j]
            while b < edges.size and at > edges[b]:
                counts[b] += weight[j] * count
                roots[b] += weight[j] * total
                count, total = 0.0, 0.0
                b += 1
            alike = 1.0 if i == 0 or 2 * i == n else 2.0
            count += alike
            total += alike * math.sqrt(at)
        counts[b] += weight[j] * count
        roots[b] += weight[j] * total


@_jit
def survey(field: np.ndarray, first: int, stop: int) -> tuple[int, float, float, float, float]:
    """(number of values > 0, sum, least value > 0 or inf, least value, largest value) of rows first … stop−1."""
    positive, total, least_positive, least, largest = 0, 0.0, np.inf, np.inf, -np.inf
    for i in range(first, stop):
        sum_of_row = 0.0
        for j in range(field.shape[1]):
            value = field[i, j]
            sum_of_row += value
            least = value if value < least else least
            largest = value if value > largest else largest
            if value > 0:
                positive += 1
                least_positive = value if value < least_positive else least_positive
        total += sum_of_row
    return positive, total, least_positive, least, largest


@compiled(fastmath=FAST, no_cpython_wrapper=True)
def find_bin(value: float, at: float, edges: np.ndarray, origin: float, scale: float) -> int | np.int64:
    """The bin that holds a value: its lower edge belongs to it, and the last bin holds both of its edges.

    at: the value, or its logarithm if that is what the edges are evenly spaced in; `origin` is the first edge there and
    `scale` the number of bins per unit.  (at − origin)·scale is the first guess.
    """
    guess, last = (at - origin) * scale, edges.size - 2
    b = 0 if guess < 0 else np.int64(guess) if guess < last else last
    while b > 0 and value < edges[b]:  # rounding of the guess
        b -= 1
    while b < last and value >= edges[b + 1]:
        b += 1
    return b


@_jit
def histogram(field: np.ndarray, edges: np.ndarray, first: int, stop: int, counts: np.ndarray) -> None:
    """counts += numpy.histogram(rows[rows != 0], edges), for evenly spaced edges."""
    scale = counts.size / (edges[counts.size] - edges[0])
    for i in range(first, stop):
        for j in range(field.shape[1]):
            value = field[i, j]
            if value != 0 and edges[0] <= value <= edges[counts.size]:
                counts[find_bin(value, value, edges, edges[0], scale)] += 1


@_jit
def contact_sums(
    field: np.ndarray,
    mean: float,
    first: int,
    stop: int,
    bins: tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]],
    powers: np.ndarray,
) -> None:
    """Over the points p > 0 of rows first … stop−1: histograms, added to the counts in `bins`, and Σ (p/mean)^(n+1),
    added to powers[n].

    bins: (edges, counts), evenly spaced, and the same again evenly spaced in the logarithm.
    """
    (even, count), (logarithmic, log_count) = bins
    scale = count.size / (even[count.size] - even[0])
    origin = math.log10(logarithmic[0])
    log_scale = log_count.size / (math.log10(logarithmic[log_count.size]) - origin)
    for i in range(first, stop):
        for j in range(field.shape[1]):
            p = field[i, j]
            if not p > 0:
                continue
            if even[0] <= p <= even[count.size]:
                count[find_bin(p, p, even, even[0], scale)] += 1
            if logarithmic[0] <= p <= logarithmic[log_count.size]:
                log_count[find_bin(p, math.log10(p), logarithmic, origin, log_scale)] += 1
            x, power = p / mean, 1.0
            for n in range(powers.size):
                power *= x
                powers[n] += power


@_jit
def count_digits(field: np.ndarray, prefix: np.uint64, shift: int, first: int, stop: int, counts: np.ndarray) -> None:
    """counts[(key >> shift) & 0xFFFF] += 1 for the keys with key >> shift >> 16 == prefix, of rows first … stop−1.

    field: float64 numbers, viewed as int64.  The key of a number is an unsigned integer; keys have the order of the
    numbers.
    """
    for i in range(first, stop):
        for j in range(field.shape[1]):
            bits = field[i, j]
            key = np.uint64(bits) ^ np.uint64(0x8000000000000000) if bits >= 0 else ~np.uint64(bits)
            high = key >> np.uint64(shift)
            if shift == 48 or (high >> np.uint64(16)) == prefix:
                counts[high & np.uint64(0xFFFF)] += 1
