"""Logarithm and exponential without branches and calls, so that loops over them are vectorised: a logarithm takes .9 ns
where that of the C library takes 3.6 (AVX-512).
"""

from __future__ import annotations

import math

import numpy as np

from pgfmd.parallel.compiled import compiled

LN2_HIGH, LN2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10  # ln 2 in two parts, the first of 32 bits
ROOT_HALF = 0x3FE6A09E667F3BCD  # bits of √½
LEAST = -708.0  # below, the exponential counts as 0; from −708.4 down it is not a normal number
# Coefficients from the highest power down: 2/(2n + 1) for zⁿ⁻¹, and 1/n! for rⁿ⁻².
LOGARITHM = tuple(2 / (2 * n + 1) for n in range(10, 0, -1))
EXPONENTIAL = tuple(1 / math.factorial(n) for n in range(13, 1, -1))

_inlined = compiled(inline="always")


@_inlined
def _polynomial(coefficients: tuple[float, ...], x: float) -> float:
    """Σ c xᵏ by Horner's rule; the loop is unrolled."""
    total = 0.0
    for coefficient in coefficients:
        total = total * x + coefficient
    return total


@_inlined
def logarithm(x: float) -> float:
    """ln x of a normal number x > 0; the error is below 1 unit of the last place (.81 at most, as measured).

    With x = 2ᵏ (1 + f), √½ ≤ 1 + f < √2, and s = f/(2 + f), the series of ln((1 + s)/(1 − s)) in s; summed as in FDLIBM
    (Sun Microsystems 1993, e_log.c), so that f is not rounded.
    """
    bits = np.float64(x).view(np.int64)
    k = (bits - ROOT_HALF) >> 52
    f = np.int64(bits - (k << 52)).view(np.float64) - 1.0
    s = f / (2.0 + f)
    z = s * s
    series = _polynomial(LOGARITHM, z) * z
    half = 0.5 * f * f
    return k * LN2_HIGH - ((half - (s * (half + series) + k * LN2_LOW)) - f)


@_inlined
def exponential(x: float) -> float:
    """exp x of a number x ≤ 0; the error is below 1 unit of the last place (.92 at most, as measured); 0 below `LEAST`.

    With x = k ln 2 + r, |r| ≤ ln 2/2: the Taylor series in r, times 2ᵏ.
    """
    within = max(x, LEAST)
    k = np.floor(within * (1 / (LN2_HIGH + LN2_LOW)) + 0.5)
    r = (within - k * LN2_HIGH) - k * LN2_LOW
    series = _polynomial(EXPONENTIAL, r)
    power = np.int64((np.int64(k) + 1023) << 52).view(np.float64)
    return (1 + (r + r * r * series)) * power if x >= LEAST else 0.0
