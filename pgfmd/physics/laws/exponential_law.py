"""The exponential wall: p = σ_ref exp(−gap/ζ).

Its dual energy is ζ times the negative entropy of the pressure, φ(p) = ζ p (ln(p/σ_ref) − 1).
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from pgfmd.grid.kernels import jit, u
from pgfmd.options.rules import POSITIVE
from pgfmd.options.section import key
from pgfmd.parallel.compiled import compiled
from pgfmd.physics.laws.law import ContactLaw, Units

if TYPE_CHECKING:
    from pgfmd.physics.solids.solid import Solid

LN2_HIGH, LN2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10  # ln 2 in two parts, the first of 32 bits
ROOT_HALF = 0x3FE6A09E667F3BCD  # bits of √½
LEAST = -708.0  # below, the exponential counts as 0; from −708.4 down it is not a normal number
MOST = 709.0  # above, it counts as infinite; from 709.8 up it is
UNDERFLOW = 800.0  # gap over ζ at which the pressure underflows
LAST = 2 * np.finfo(np.float64).eps  # relative error of a logarithm and of its argument
# Coefficients from the highest power down: 2/(2n + 1) for zⁿ⁻¹, and 1/n! for rⁿ⁻².
LOGARITHM = tuple(2 / (2 * n + 1) for n in range(10, 0, -1))
EXPONENTIAL = tuple(1 / math.factorial(n) for n in range(13, 1, -1))

_jit, _inlined = compiled(), compiled(inline="always")


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
    """exp x; the error is below 1 unit of the last place (.92 at most, as measured); 0 below `LEAST`, infinite above
    `MOST`.

    With x = k ln 2 + r, |r| ≤ ln 2/2: the Taylor series in r, times 2ᵏ.
    """
    within = min(max(x, LEAST), MOST)
    k = np.floor(within * (1 / (LN2_HIGH + LN2_LOW)) + 0.5)
    r = (within - k * LN2_HIGH) - k * LN2_LOW
    series = _polynomial(EXPONENTIAL, r)
    power = np.int64((np.int64(k) + 1023) << 52).view(np.float64)
    value = (1 + (r + r * r * series)) * power if x >= LEAST else 0.0
    return value if x <= MOST else np.inf


@dataclass(frozen=True, kw_only=True)
class ExponentialWall(ContactLaw):
    """A repulsive wall: pressure = sigma_ref exp(−gap/zeta).  sigma_ref only shifts all gaps."""

    kind: ClassVar[str] = "exponential"
    methods: ClassVar[tuple[str, ...]] = ("newton", "gfmd")
    releases: ClassVar[bool] = False
    effort: ClassVar[float] = 2.5

    zeta: float = key(POSITIVE, about="ζ, over which the pressure decays", unit="length", needed=True, example=0.25)
    sigma_ref: float | None = key(
        POSITIVE, about="pressure at gap 0; the contact modulus if not given", unit="pressure"
    )

    @property
    def ends(self) -> tuple[float, float]:
        return -math.inf, math.inf

    @property
    def reach(self) -> float:
        return UNDERFLOW * self.zeta

    @property
    def length_scale(self) -> float:
        return self.zeta

    def softness(self, pressure: np.ndarray) -> float:
        return self.zeta * float(pressure.sum())

    def gap(self, pressure: float, solid: Solid) -> float:
        """ζ ln(σ_ref/p)."""
        return self.zeta * math.log((self.sigma_ref or solid.contact_modulus) / pressure)

    def pressure_at(self, gap: float, solid: Solid) -> float:
        """σ_ref exp(−g/ζ), up to exp(200)."""
        return (self.sigma_ref or solid.contact_modulus) * math.exp(min(-gap / self.zeta, 200.0))

    def in_units(self, units: Units) -> ExponentialWall:
        """p̂ = exp(−ĝ/ζ̂)."""
        return ExponentialWall(zeta=self.zeta / units.height, sigma_ref=1.0)

    def softer(self, factor: float) -> ExponentialWall:
        return dataclasses.replace(self, zeta=self.zeta * factor)

    def gap_and_slope(self, pressure: np.ndarray, gap: np.ndarray, slope: np.ndarray) -> None:
        """As `ContactLaw.gap_and_slope`; where p underflows, the gap from which on it does."""
        with np.errstate(divide="ignore"):
            np.log(pressure, out=gap)
        np.maximum(gap, -UNDERFLOW, out=gap)
        gap *= -self.zeta
        np.divide(pressure, self.zeta, out=slope)

    def respond(self, target: np.ndarray, pressure: np.ndarray, compliance: float, level: float) -> tuple[float, float]:
        """p with compliance · p + ζ ln p = target + level."""
        b = self.zeta / compliance
        fill_omega(target, pressure, b, self.zeta, level)
        total, slope = scale_omega(pressure, b)
        return total, slope / compliance

    def moments(self, pressure: np.ndarray, gap: np.ndarray, threshold: float) -> tuple[float, float, int, float]:
        """(Σ p (g + ζ ln p), Σ p, number of points with p > threshold, ζ Σ p)."""
        potential, load, contact = moments(pressure, gap, threshold, self.zeta)
        return potential, load, contact, self.zeta * load

    def excess(
        self, pressure: np.ndarray, gap: np.ndarray, residual: np.ndarray, compliance: float, level: float
    ) -> float:
        """The excess is ζ times the relative entropy of p to exp(−(g − level − ε)/ζ)."""
        return excess(pressure, gap, residual, compliance, self.zeta, level)

    def finish(self, pressure: np.ndarray, gap: np.ndarray, level: float, units: Units) -> float:
        """As `ContactLaw.finish`; the violation is taken over points with more than the mean pressure."""
        return finish_rows(pressure, gap, self.zeta, level, units)


@_inlined
def wright_omega(z: float) -> float:
    """ω with ω + ln ω = z, to a few units of the last place; 0 below `LEAST`.

    Iteration of Fritsch, Shafer and Crowley 1973, doi:10.1145/361952.361970, without branches, so that loops over it
    are vectorised: 10 ns a point, where one with branches took 40 (AVX-512).
    """
    small, large = exponential(min(z, 0.0)), logarithm(max(z, 3.0))
    w = z - large + large / z if z >= 3 else 1 + (z - 1) / 2 + (z - 1) * (z - 1) / 16
    w = max(w if z >= -1 else small / (1 + small), 1e-300)
    for _ in range(2):
        r = z - w - logarithm(w)
        t = (1 + w) * (1 + w + 2 * r / 3)
        w *= 1 + r / (1 + w) * (t - r / 2) / (t - r)
    return w if z >= -40 else small


@_jit
def fill_omega(target: np.ndarray, omega: np.ndarray, b: float, zeta: float, level: float) -> None:
    """ω + ln ω = (target + level)/ζ − ln b."""
    shift = -math.log(b)
    for i in range(target.shape[0]):
        for j in range(target.shape[1]):
            omega[i, u(j)] = wright_omega((target[i, u(j)] + level) / zeta + shift)


@jit
def scale_omega(omega: np.ndarray, b: float) -> tuple[float, float]:
    """Σ b ω and Σ ω/(1 + ω); ω becomes b ω.  No loop calls it: linked into another, it would be vectorised anew, and a
    process that compiles would add up in another order than one that loads.
    """
    total = slope = 0.0
    for i in range(omega.shape[0]):
        for j in range(omega.shape[1]):
            w = omega[i, u(j)]
            omega[i, u(j)] = b * w
            total += b * w
            slope += w / (1 + w)
    return total, slope


@_jit
def moments(pressure: np.ndarray, gap: np.ndarray, threshold: float, zeta: float) -> tuple[float, float, int]:
    """(Σ p̂ (g + ζ ln p̂), Σ p̂, #{p̂ > threshold})."""
    loaded, potential = 0, 0.0
    for point, p in np.ndenumerate(pressure):
        loaded += p > threshold
        if p > 0:
            potential += p * (gap[point] + zeta * math.log(p))
    return potential, pressure.sum(), loaded


@_jit
def relative_entropy(pressure: float, exponent: float) -> float:
    """p ln(p/σ) − p + σ with σ = exp(exponent): never negative, and without cancellation."""
    if pressure > 0:
        t = math.log(pressure) - exponent
        return pressure * (t + math.expm1(-t)) if t > -30 else pressure * (t - 1) + math.exp(exponent)
    return math.exp(exponent)


@_jit
def excess(
    pressure: np.ndarray, gap: np.ndarray, residual: np.ndarray, compliance: float, zeta: float, level: float
) -> float:
    """residual = compliance · (p̂ − p̂⁺), where compliance · p̂⁺ + ζ ln p̂⁺ = compliance · p̂ − (g − level); returns
    ζ Σ relative_entropy(p̂, −(g − level − residual)/ζ) and its rounding error.

    The residual also equals g − level + ζ ln p̂⁺, which has more digits where compliance · p̂ is large.  A difference t
    of logarithms with the error δ changes the relative entropy by at most p |1 − e^−t| δ + p δ².
    """
    b = zeta / compliance
    shift = -math.log(b)
    total, answers = 0.0, np.empty(gap.shape[1])
    for i in range(gap.shape[0]):
        for j in range(gap.shape[1]):
            away = gap[i, u(j)] - level
            answers[u(j)] = b * wright_omega((compliance * pressure[i, u(j)] - away) / zeta + shift)
        for j in range(gap.shape[1]):
            p, away, answer = pressure[i, j], gap[i, j] - level, answers[j]
            if compliance * p > zeta + abs(away):
                r = away + zeta * math.log(answer)
            else:
                r = compliance * (p - answer)
            residual[i, j] = r
            exponent = (r - away) / zeta
            total += relative_entropy(p, exponent)
            if p > 0:
                logarithm = math.log(p)
                unsure = LAST * (1 + abs(logarithm) + abs(away) / zeta)
                total += p * unsure * (abs(math.expm1(exponent - logarithm)) + unsure)
    return zeta * total


@_jit
def finish_rows(pressure: np.ndarray, gap: np.ndarray, zeta: float, level: float, units: Units) -> float:
    """p̂ and g to physical `units`; returns the largest |g + ζ ln p̂ − level| where p̂ ≥ 1."""
    largest = 0.0
    for i in range(gap.shape[0]):
        for j in range(gap.shape[1]):
            away = gap[i, j] - level
            if pressure[i, j] >= 1:
                largest = max(largest, abs(away + zeta * math.log(pressure[i, j])))
            gap[i, j] = away * units.height + units.offset
            pressure[i, j] *= units.pressure
    return largest
