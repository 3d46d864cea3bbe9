"""Preconditioned conjugate gradients on a set of points."""

from __future__ import annotations

import numpy as np

from ..parallel import Reduction
from .contact_set import ContactSet


def solve_on_set(
    points: ContactSet,
    residual: np.ndarray,
    operator,
    preconditioner,
    reduction_wanted: float,
    most: int,
    neutral: bool = True,
) -> tuple[np.ndarray, int]:
    """x (count,) on the set with S A Sᵀ x = residual; if `neutral`, up to a constant and with Σ x = 0.  Collective.

    `operator` applies A and `preconditioner` something like its inverse, both by apply(points, values, out).
    Overwrites `residual` (count,), which ends as the remaining one.  Stops at the wanted reduction of its norm (in
    the metric of the preconditioner) or after `most` iterations.  Returns x (count,) and the number of iterations,
    each of one convolution.
    """
    reduction = Reduction(points.grid.comm)
    share = 1 / reduction.sum(points.count) if neutral else 0.0  # of the mean that a point takes off
    r = residual
    x, z, product = np.zeros_like(r), np.empty_like(r), np.empty_like(r)
    direction = None
    (sum_r,) = reduction.sums(_sum(r))
    r -= r.dtype.type(sum_r * share)
    start = rz_old = None
    for iteration in range(most + 1):
        preconditioner.apply(points, r, z)
        rz, sum_z, sum_r = reduction.sums(_dot(r, z), _sum(z), _sum(r))
        mean_z = sum_z * share
        rz -= mean_z * sum_r  # z is made to sum to zero
        start = rz if start is None else start
        if rz <= reduction_wanted**2 * start or iteration == most or rz <= 0:
            return x, iteration
        if direction is None:
            direction = z - r.dtype.type(mean_z)
        else:
            direction *= r.dtype.type(rz / rz_old)
            direction += z
            direction -= r.dtype.type(mean_z)
        rz_old = rz
        operator.apply(points, direction, product)
        curvature, sum_product = reduction.sums(_dot(direction, product), _sum(product))
        if not curvature > 0:
            return x, iteration
        step = r.dtype.type(rz / curvature)
        x += step * direction
        product -= r.dtype.type(sum_product * share)
        product *= step
        r -= product
    return x, most


def _sum(a: np.ndarray) -> float:
    return float(a.sum(dtype=np.float64))


def _dot(a: np.ndarray, b: np.ndarray) -> float:
    """Σ a b in float64, in parts short enough for the single-precision sums inside to be exact enough."""
    part = 4096
    return float(sum(np.dot(a[i : i + part], b[i : i + part]).astype(np.float64) for i in range(0, len(a), part)))
