"""Compiled loops of the exponential wall.

Pressures are over their mean, p̂ = p/p̄; gaps g, ζ and the heights share one unit.

The dual of the contact problem is a quadratic form plus ζ times the negative entropy of the pressure, hence the name.
"""

from __future__ import annotations

import math

import numba
import numpy as np

_jit = numba.njit(nogil=True, cache=True, error_model="numpy")


@_jit
def wright_omega(z):
    """ω > 0 with ω + ln ω = z, to a few units of rounding.

    Iteration of Fritsch, Shafer and Crowley 1973, doi:10.1145/361952.361970.
    """
    if z < -1:
        x = math.exp(z)
        w = x / (1 + x)
        if z < -40:
            return x
    elif z < 3:
        w = 1 + (z - 1) / 2 + (z - 1) ** 2 / 16
    else:
        logarithm = math.log(z)
        w = z - logarithm + logarithm / z
    for _ in range(2):
        r = z - w - math.log(w)
        t = (1 + w) * (1 + w + 2 * r / 3)
        w *= 1 + r / (1 + w) * (t - r / 2) / (t - r)
    return w


@_jit
def lowest(gap, first, stop):
    """min g of rows first … stop−1."""
    found = np.inf
    for i in range(first, stop):
        for j in range(gap.shape[1]):
            found = min(found, gap[i, j])
    return found


@_jit
def moments(pressure, gap, heights, zeta, least, first, stop):
    """(Σ exp((least − g)/ζ), Σ p̂ (g − least + ζ ln p̂), Σ p̂ (g + h), #{p̂ > 1}) of some rows."""
    weight = potential = work = 0.0
    loaded = 0
    for i in range(first, stop):
        for j in range(gap.shape[1]):
            g, p = gap[i, j], pressure[i, j]
            away = g - least
            if away < 745 * zeta:
                weight += math.exp(-away / zeta)
            if p > 0:
                potential += p * (away + zeta * math.log(p))
                work += p * (g + heights[i, j])
                loaded += p > 1
    return weight, potential, work, loaded


@_jit
def divergence(pressure, gap, zeta, least, log_scale, first, stop):
    """Σ p̂ ln(p̂/σ̂) − p̂ + σ̂ with σ̂ = exp((least − g)/ζ + log_scale): no term is negative, so nothing cancels."""
    total = 0.0
    for i in range(first, stop):
        for j in range(gap.shape[1]):
            p = pressure[i, j]
            exponent = (least - gap[i, j]) / zeta + log_scale
            if p > 0:
                t = math.log(p) - exponent
                total += p * (t + math.expm1(-t)) if t > -30 else p * (t - 1) + math.exp(exponent)
            elif exponent > -745:
                total += math.exp(exponent)
    return total


@_jit
def newton_start(pressure, gap, zeta, level, root, residual, first, stop):
    """root = √p̂; residual = −√p̂ (g + ζ ln p̂ − level), and 0 where p̂ = 0; returns Σ residual²."""
    total = 0.0
    for i in range(first, stop):
        for j in range(gap.shape[1]):
            p = pressure[i, j]
            s = math.sqrt(p)
            r = -s * (gap[i, j] + zeta * math.log(p) - level) if p > 0 else 0.0
            root[i, j] = s
            residual[i, j] = r
            total += r * r
    return total


@_jit
def next_direction(residual, beta, direction, first, stop):
    """direction = residual + beta direction."""
    for i in range(first, stop):
        for j in range(residual.shape[1]):
            direction[i, j] = residual[i, j] + beta * direction[i, j]


@_jit
def curvature_sums(root, direction, product, first, stop):
    """(Σ (√p̂ d) product, Σ d², Σ p̂ product): what a step along d needs."""
    curved = square = along = 0.0
    for i in range(first, stop):
        for j in range(root.shape[1]):
            s, d, q = np.float64(root[i, j]), np.float64(direction[i, j]), np.float64(product[i, j])
            curved += s * d * q
            square += d * d
            along += s * s * q
    return curved, square, along


@_jit
def step(root, direction, product, mean, zeta, length, change, response, residual, first, stop):
    """change += length d; response += length product; residual −= length (ζ d + √p̂ (product − mean)); Σ residual²."""
    total = 0.0
    for i in range(first, stop):
        for j in range(root.shape[1]):
            d, q = direction[i, j], product[i, j]
            change[i, j] += length * d
            response[i, j] += length * q
            r = residual[i, j] - length * (zeta * d + root[i, j] * (q - mean))
            residual[i, j] = r
            total += np.float64(r) ** 2
    return total


@_jit
def level_sum(pressure, gap, zeta, first, stop):
    """Σ p̂ (g + ζ ln p̂)."""
    total = 0.0
    for i in range(first, stop):
        for j in range(gap.shape[1]):
            p = pressure[i, j]
            if p > 0:
                total += p * (gap[i, j] + zeta * math.log(p))
    return total


@_jit
def respond_hard(target, reach, level, pressure, first, stop):
    """p̂ = max(target + level, 0)/reach; returns Σ p̂ and Σ dp̂/dlevel."""
    total = slope = 0.0
    for i in range(first, stop):
        for j in range(target.shape[1]):
            p = max(target[i, j] + level, 0.0) / reach
            pressure[i, j] = p
            total += p
            slope += p > 0
    return total, slope / reach


@_jit
def respond(target, reach, zeta, level, pressure, first, stop):
    """p̂ with reach p̂ + ζ ln p̂ = target + level, the positive part of that if ζ = 0; returns Σ p̂ and Σ dp̂/dlevel."""
    if zeta == 0:
        return respond_hard(target, reach, level, pressure, first, stop)
    b = zeta / reach
    shift = -math.log(b)
    total = slope = 0.0
    for i in range(first, stop):
        for j in range(target.shape[1]):
            w = wright_omega((target[i, j] + level) / zeta + shift)
            pressure[i, j] = b * w
            total += b * w
            slope += w / (1 + w)
    return total, slope / reach


@_jit
def newton_target(pressure, gap, root, change, response, reach, target, first, stop):
    """target = reach (p̂ + δp̂) − (g + response), δp̂ = √p̂ change: what the linearised step says of every point."""
    for i in range(first, stop):
        for j in range(gap.shape[1]):
            p = pressure[i, j] + root[i, j] * change[i, j]
            target[i, j] = reach * p - (gap[i, j] + response[i, j])


@_jit
def mix(old_pressure, old_gap, fraction, pressure, gap, first, stop):
    """pressure, gap ← old + fraction (pressure − old), the same for the gap."""
    for i in range(first, stop):
        for j in range(gap.shape[1]):
            pressure[i, j] = old_pressure[i, j] + fraction * (pressure[i, j] - old_pressure[i, j])
            gap[i, j] = old_gap[i, j] + fraction * (gap[i, j] - old_gap[i, j])


@_jit
def largest_deviation(pressure, gap, zeta, level, first, stop):
    """Largest |g + ζ ln p̂ − level| where p̂ ≥ 1."""
    largest = 0.0
    for i in range(first, stop):
        for j in range(gap.shape[1]):
            if pressure[i, j] >= 1:
                largest = max(largest, abs(gap[i, j] + zeta * math.log(pressure[i, j]) - level))
    return largest


@_jit
def start_rows(coarse_pressure, displacement, heights, reach, target):
    """target = reach · coarse p̂ − (u − h)."""
    for i in range(target.shape[0]):
        for j in range(target.shape[1]):
            target[i, j] = reach * coarse_pressure[i, j] - (displacement[i, j] - heights[i, j])
