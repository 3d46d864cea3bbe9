"""Compiled loops of Newton's method for the exponential wall.

Pressures are over their mean, p̂ = p/p̄; gaps g, ζ and the heights share one unit.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from pgfmd.physics.laws.exponential import relative_entropy

_jit = numba.njit(nogil=True, cache=True, error_model="numpy")


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
def newton_target(pressure, gap, root, change, response, compliance, target, first, stop):
    """target = compliance (p̂ + δp̂) − (g + response), δp̂ = √p̂ change: what the linearised step says of every point."""
    for i in range(first, stop):
        for j in range(gap.shape[1]):
            p = pressure[i, j] + root[i, j] * change[i, j]
            target[i, j] = compliance * p - (gap[i, j] + response[i, j])


@_jit
def mix(old_pressure, old_gap, fraction, pressure, gap, first, stop):
    """pressure, gap ← old + fraction (pressure − old), the same for the gap."""
    for i in range(first, stop):
        for j in range(gap.shape[1]):
            pressure[i, j] = old_pressure[i, j] + fraction * (pressure[i, j] - old_pressure[i, j])
            gap[i, j] = old_gap[i, j] + fraction * (gap[i, j] - old_gap[i, j])


@_jit
def start_rows(coarse_pressure, displacement, heights, compliance, target):
    """target = compliance · coarse p̂ − (u − h)."""
    for i in range(target.shape[0]):
        for j in range(target.shape[1]):
            target[i, j] = compliance * coarse_pressure[i, j] - (displacement[i, j] - heights[i, j])


@_jit
def weight_and_potential(pressure, gap, zeta, least, first, stop):
    """(Σ exp((least − g)/ζ), Σ p̂ (g − least + ζ ln p̂)) of some rows."""
    weight = potential = 0.0
    for i in range(first, stop):
        for j in range(gap.shape[1]):
            p, away = pressure[i, j], gap[i, j] - least
            if away < 745 * zeta:
                weight += math.exp(-away / zeta)
            if p > 0:
                potential += p * (away + zeta * math.log(p))
    return weight, potential


@_jit
def work(pressure, gap, heights, first, stop):
    """Σ p̂ (g + h) of some rows."""
    total = 0.0
    for i in range(first, stop):
        for j in range(gap.shape[1]):
            total += pressure[i, j] * (gap[i, j] + heights[i, j])
    return total


@_jit
def divergence(pressure, gap, zeta, least, log_scale, first, stop):
    """Σ p̂ ln(p̂/σ̂) − p̂ + σ̂ of some rows, with σ̂ = exp((least − g)/ζ + log_scale)."""
    total = 0.0
    for i in range(first, stop):
        for j in range(gap.shape[1]):
            total += relative_entropy(pressure[i, j], (least - gap[i, j]) / zeta + log_scale)
    return total
