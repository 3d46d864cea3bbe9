"""Preconditioned conjugate gradients on a set of points."""

from __future__ import annotations

import numpy as np

from pgfmd.parallel.collectives import Reduction
from pgfmd.solvers.active_set import kernels as set_kernels
from pgfmd.solvers.active_set.contact_set import ContactSet, SetVector

PART = 1 << 16  # entries that a thread takes at a time: fewer are not worth waking it for


def solve_on_set(
    points: ContactSet,
    residual: SetVector,
    operator,
    preconditioner,
    reduction_wanted: float,
    most: int,
    neutral: bool = True,
) -> tuple[np.ndarray, int]:
    """x (count,) on the set with S A Sᵀ x = residual; if `neutral`, up to a constant and with Σ x = 0.  Collective.

    `operator` applies A by apply(points, SetVector, out), and `preconditioner` something like its inverse by
    apply(points, SetVector, SetVector).  Overwrites `residual`, which ends as the remaining one.  Stops at the wanted
    reduction of its norm (in the metric of the preconditioner) or after `most` iterations.  Returns x (count,) and the
    number of iterations, each of one convolution.
    """
    threads, reduction = points.grid.threads, Reduction(points.grid.comm)
    real = residual.own.dtype.type

    def sums(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Σ a b, Σ a, Σ b over all ranks."""
        parts = threads.collect(lambda i, j: set_kernels.dot_and_sums(a, b, i, j), len(a), PART)
        return reduction.sums(*map(sum, zip((0.0, 0.0, 0.0), *parts, strict=True)))

    share = 1 / reduction.sum(points.count) if neutral else 0.0  # of the mean that a point takes off
    z, direction = SetVector(points), SetVector(points)
    r, d = residual.own, direction.own
    x, product = np.zeros_like(r), np.empty_like(r)
    d[:] = 0
    r -= real(sums(r, r)[1] * share)
    start, rz_old = None, np.inf
    for iteration in range(most + 1):
        preconditioner.apply(points, residual, z)
        rz, sum_r, sum_z = sums(r, z.own)
        mean_z = sum_z * share
        rz -= mean_z * sum_r  # z is made to sum to zero
        start = rz if start is None else start
        if rz <= reduction_wanted**2 * start or iteration == most or rz <= 0:
            return x, iteration
        turn = real(rz / rz_old), real(mean_z)
        threads.share(lambda _, i, j: set_kernels.turn(d, z.own, *turn, i, j), len(d), PART)  # noqa: B023 (run at once)
        rz_old = rz
        operator.apply(points, direction, product)
        curvature, _, sum_product = sums(d, product)
        if not curvature > 0:
            return x, iteration
        step = real(rz / curvature), real(sum_product * share)
        threads.share(lambda _, i, j: set_kernels.advance(x, r, d, product, *step, i, j), len(d), PART)  # noqa: B023
    return x, most
