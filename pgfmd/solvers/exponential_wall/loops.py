"""Compiled loops of Newton's method for the exponential wall, over rows of some fields.

Pressures are over their mean, p̂ = p/p̄; gaps g, ζ and the heights share one unit.
"""

from __future__ import annotations

import math

import numpy as np

from pgfmd.parallel.compiled import compiled
from pgfmd.physics.laws.exponential_law import relative_entropy

Pair = tuple[np.ndarray, np.ndarray]

_jit = compiled()


@_jit
def newton_start(
    pressure: np.ndarray, gap: np.ndarray, root: np.ndarray, residual: np.ndarray, zeta: float, level: float
) -> float:
    """root = √p̂; residual = −√p̂ (g + ζ ln p̂ − level), and 0 where p̂ = 0; returns Σ residual²."""
    total = 0.0
    for i in range(gap.shape[0]):
        for j in range(gap.shape[1]):
            p = pressure[i, j]
            s = math.sqrt(p)
            r = -s * (gap[i, j] + zeta * math.log(p) - level) if p > 0 else 0.0
            root[i, j] = s
            residual[i, j] = r
            total += np.float64(residual[i, j]) ** 2  # as it is in single precision, where it may have vanished
    return total


@_jit
def curvature_sums(root: np.ndarray, direction: np.ndarray, product: np.ndarray) -> tuple[float, float, float]:
    """(Σ (√p̂ d) product, Σ d², Σ p̂ product): what a step along d needs."""
    curved = square = along = 0.0
    for i in range(root.shape[0]):
        for j in range(root.shape[1]):
            s, d, q = np.float64(root[i, j]), np.float64(direction[i, j]), np.float64(product[i, j])
            curved += s * d * q
            square += d * d
            along += s * s * q
    return curved, square, along


@_jit
def step(
    root: np.ndarray, system: Pair, sums: Pair, residual: np.ndarray, numbers: tuple[np.float32, np.float32, np.float32]
) -> float:
    """One step of conjugate gradients: with system = (d, product), sums = (change, response) and numbers = (mean, ζ,
    length), change += length d; response += length product; residual −= length (ζ d + √p̂ (product − mean)); returns
    Σ residual².
    """
    direction, product = system
    change, response = sums
    mean, zeta, length = numbers
    total = 0.0
    for i in range(root.shape[0]):
        for j in range(root.shape[1]):
            d, q = direction[i, j], product[i, j]
            change[i, j] += length * d
            response[i, j] += length * q
            r = residual[i, j] - length * (zeta * d + root[i, j] * (q - mean))
            residual[i, j] = r
            total += np.float64(r) ** 2
    return total


@_jit
def weight_and_potential(pressure: np.ndarray, gap: np.ndarray, zeta: float, least: float) -> tuple[float, float]:
    """(Σ exp((least − g)/ζ), Σ p̂ (g − least + ζ ln p̂))."""
    weight = potential = 0.0
    for i in range(gap.shape[0]):
        for j in range(gap.shape[1]):
            p, away = pressure[i, j], gap[i, j] - least
            if away < 745 * zeta:  # beyond, exp underflows
                weight += math.exp(-away / zeta)
            if p > 0:
                potential += p * (away + zeta * math.log(p))
    return weight, potential


@_jit
def work(pressure: np.ndarray, gap: np.ndarray, heights: np.ndarray) -> float:
    """Σ p̂ (g + h)."""
    total = 0.0
    for i in range(gap.shape[0]):
        for j in range(gap.shape[1]):
            total += pressure[i, j] * (gap[i, j] + heights[i, j])
    return total


@_jit
def divergence(pressure: np.ndarray, gap: np.ndarray, zeta: float, least: float, log_scale: float) -> float:
    """Σ p̂ ln(p̂/σ̂) − p̂ + σ̂ with σ̂ = exp((least − g)/ζ + log_scale)."""
    total = 0.0
    for i in range(gap.shape[0]):
        for j in range(gap.shape[1]):
            total += relative_entropy(pressure[i, j], (least - gap[i, j]) / zeta + log_scale)
    return total
