"""Compiled loops of Newton's method, over rows of some fields."""

from __future__ import annotations

import numpy as np

from pgfmd.parallel.compiled import compiled

Pair = tuple[np.ndarray, np.ndarray]

_jit = compiled()


@_jit
def curvature_sums(root: np.ndarray, direction: np.ndarray, product: np.ndarray) -> tuple[float, float, float]:
    """(Σ (w d) product, Σ d², Σ w² product): what a step along d needs; root: w."""
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
    root: np.ndarray, system: Pair, sums: Pair, residual: np.ndarray, numbers: tuple[np.float32, np.float32]
) -> float:
    """One step of conjugate gradients: with system = (d, product), sums = (change, response) and numbers = (mean,
    length), change += length d; response += length product; residual −= length (d + w (product − mean)); returns
    Σ residual².
    """
    direction, product = system
    change, response = sums
    mean, length = numbers
    total = 0.0
    for i in range(root.shape[0]):
        for j in range(root.shape[1]):
            d, q = direction[i, j], product[i, j]
            change[i, j] += length * d
            response[i, j] += length * q
            r = residual[i, j] - length * (d + root[i, j] * (q - mean))
            residual[i, j] = r
            total += np.float64(r) ** 2
    return total
