"""Preconditioned conjugate gradients on a set of points."""

from __future__ import annotations

import math
from typing import Any, Protocol

import numpy as np

from pgfmd.parallel.collectives import Reduction
from pgfmd.solvers.active_set import kernels as set_kernels
from pgfmd.solvers.active_set.unknowns import SetVector, Unknowns

PART = 1 << 16  # entries that a thread takes at a time: fewer cost more to hand out than to compute


class Operator(Protocol):
    """A linear operator between the points of a set."""

    def apply(self, points: Unknowns, values: SetVector, out: Any, /) -> None:
        """out = A · values.  `out` is an array (count,), or for a preconditioner a `SetVector`.  Collective."""


class ConjugateGradients:
    """S A Sᵀ x = residual for an operator A; S restricts to a set.  If `neutral`, Σ x = 0, and the equation holds up to
    a constant.

    Attributes: square, ⟨residual, M residual⟩ of the present residual, with the preconditioner M.
    """

    def __init__(
        self, residual: SetVector, operator: Operator, preconditioner: Operator, neutral: bool = True
    ) -> None:
        """`residual` is overwritten.  Collective."""
        self.points, self.residual = residual.points, residual
        self.operator, self.preconditioner = operator, preconditioner
        self.reduction, self.threads = Reduction(self.points.grid.comm), self.points.grid.threads
        _, total, _, count = self._sums(residual.own, residual.own, self.points.count)
        self.inverse_count = 1 / count if neutral and count else 0.0  # sum · inverse_count: the mean to subtract
        self.z, self.mean = SetVector(self.points), 0.0
        residual.own -= residual.own.dtype.type(total * self.inverse_count)
        self.square = self._precondition()

    def solve(self, wanted: float, most: int) -> tuple[np.ndarray, int]:
        """Iterates until √`square` is at most `wanted` times its first value, at most `most` times.  Returns x (count,)
        and the number of iterations; each applies A once.  Collective.
        """
        residual, z, direction = self.residual.own, self.z.own, SetVector(self.points)
        real, d = residual.dtype.type, direction.own
        x, product = np.zeros_like(residual), np.empty_like(residual)
        d[:] = 0
        before, goal = math.inf, wanted**2 * self.square
        for iteration in range(most):
            if self.square <= goal or self.square <= 0:
                return x, iteration
            turn = real(self.square / before), real(self.mean)
            self.threads.share(lambda _, i, j: set_kernels.turn(d, z, *turn, i, j), len(d), PART)  # noqa: B023 (at once)
            before = self.square
            self.operator.apply(self.points, direction, product)
            curvature, _, total = self._sums(d, product)
            if not curvature > 0:
                return x, iteration
            step = real(before / curvature), real(total * self.inverse_count)
            self.threads.share(
                lambda _, i, j: set_kernels.advance(x, residual, (d, product), *step, (i, j)), len(d), PART  # noqa: B023
            )  # fmt: skip
            self.square = self._precondition()
        return x, most

    def _precondition(self) -> float:
        """z = M · residual, and its mean, which `turn` subtracts.  Returns ⟨residual, z − mean⟩.  Collective."""
        self.preconditioner.apply(self.points, self.residual, self.z)
        square, sum_r, sum_z = self._sums(self.residual.own, self.z.own)
        self.mean = sum_z * self.inverse_count
        return square - self.mean * sum_r

    def _sums(self, a: np.ndarray, b: np.ndarray, *more: float) -> np.ndarray:
        """Σ a b, Σ a, Σ b and the sums of `more` numbers over all ranks.  Collective."""
        parts = self.threads.collect(lambda i, j: set_kernels.dot_and_sums(a, b, i, j), len(a), PART)
        return self.reduction.sums(*map(sum, zip((0.0, 0.0, 0.0), *parts, strict=True)), *more)
