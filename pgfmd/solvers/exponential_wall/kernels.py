"""Compiled loops of Newton's method for the exponential wall.

Pressures are over their mean, p̂ = p/p̄; gaps g, ζ and the heights share one unit.
fields: (pressure, gap); start: (root, residual); along: (direction, product); numbers: (mean, ζ, length); found:
(change, response, residual), in `newton_target` (root, change, response).
"""

from __future__ import annotations

import math

import numba
import numpy as np

from pgfmd.physics.laws.exponential import relative_entropy

Pair = tuple[np.ndarray, np.ndarray]
_jit = numba.njit(nogil=True, cache=True, error_model="numpy")


@_jit
def newton_start(fields: Pair, zeta: float, level: float, start: Pair, first: int, stop: int) -> float:
    """root = √p̂; residual = −√p̂ (g + ζ ln p̂ − level), and 0 where p̂ = 0; returns Σ residual²."""
    pressure, gap = fields
    root, residual = start
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
def next_direction(residual: np.ndarray, beta: np.float32, direction: np.ndarray, first: int, stop: int) -> None:
    """direction = residual + beta direction."""
    for i in range(first, stop):
        for j in range(residual.shape[1]):
            direction[i, j] = residual[i, j] + beta * direction[i, j]


@_jit
def curvature_sums(
    root: np.ndarray, direction: np.ndarray, product: np.ndarray, first: int, stop: int
) -> tuple[float, float, float]:
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
def step(
    root: np.ndarray,
    along: Pair,
    numbers: tuple[float, float, float],
    found: tuple[np.ndarray, np.ndarray, np.ndarray],
    first: int,
    stop: int,
) -> float:
    """change += length d; response += length product; residual −= length (ζ d + √p̂ (product − mean)); Σ residual²."""
    direction, product = along
    mean, zeta, length = numbers
    change, response, residual = found
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
def level_sum(fields: Pair, zeta: float, first: int, stop: int) -> float:
    """Σ p̂ (g + ζ ln p̂)."""
    pressure, gap = fields
    total = 0.0
    for i in range(first, stop):
        for j in range(gap.shape[1]):
            p = pressure[i, j]
            if p > 0:
                total += p * (gap[i, j] + zeta * math.log(p))
    return total


@_jit
def newton_target(
    fields: Pair,
    found: tuple[np.ndarray, np.ndarray, np.ndarray],
    compliance: float,
    target: np.ndarray,
    first: int,
    stop: int,
) -> None:
    """target = compliance (p̂ + δp̂) − (g + response), δp̂ = √p̂ change: what the linearised step says of every point."""
    pressure, gap = fields
    root, change, response = found
    for i in range(first, stop):
        for j in range(gap.shape[1]):
            p = pressure[i, j] + root[i, j] * change[i, j]
            target[i, j] = compliance * p - (gap[i, j] + response[i, j])


@_jit
def mix(old: Pair, fraction: float, fields: Pair, first: int, stop: int) -> None:
    """pressure, gap ← old + fraction (pressure − old), the same for the gap."""
    old_pressure, old_gap = old
    pressure, gap = fields
    for i in range(first, stop):
        for j in range(gap.shape[1]):
            pressure[i, j] = old_pressure[i, j] + fraction * (pressure[i, j] - old_pressure[i, j])
            gap[i, j] = old_gap[i, j] + fraction * (gap[i, j] - old_gap[i, j])


@_jit
def start_rows(
    coarse_pressure: np.ndarray, displacement: np.ndarray, heights: np.ndarray, compliance: float, target: np.ndarray
) -> None:
    """target = compliance · coarse p̂ − (u − h)."""
    for i in range(target.shape[0]):
        for j in range(target.shape[1]):
            target[i, j] = compliance * coarse_pressure[i, j] - (displacement[i, j] - heights[i, j])


@_jit
def weight_and_potential(fields: Pair, zeta: float, least: float, first: int, stop: int) -> tuple[float, float]:
    """(Σ exp((least − g)/ζ), Σ p̂ (g − least + ζ ln p̂)) of some rows."""
    pressure, gap = fields
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
def work(fields: Pair, heights: np.ndarray, first: int, stop: int) -> float:
    """Σ p̂ (g + h) of some rows."""
    pressure, gap = fields
    total = 0.0
    for i in range(first, stop):
        for j in range(gap.shape[1]):
            total += pressure[i, j] * (gap[i, j] + heights[i, j])
    return total


@_jit
def divergence(fields: Pair, zeta: float, least: float, log_scale: float, first: int, stop: int) -> float:
    """Σ p̂ ln(p̂/σ̂) − p̂ + σ̂ of some rows, with σ̂ = exp((least − g)/ζ + log_scale)."""
    pressure, gap = fields
    total = 0.0
    for i in range(first, stop):
        for j in range(gap.shape[1]):
            total += relative_entropy(pressure[i, j], (least - gap[i, j]) / zeta + log_scale)
    return total
