"""Preconditioned conjugate gradients on a set of points."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from pgfmd.grid.kernels import jit, u
from pgfmd.parallel.collectives import Reduction
from pgfmd.solvers.active_set.unknowns import SetVector

ENTRIES = 1 << 16  # that a thread takes at a time: fewer cost more to hand out than to compute
MOST_ITERATIONS = 300
DIVERGED = 1e16  # growth of `square` beyond which rounding rules; at 1e22 single precision overflows

Pair = tuple[float, float]
Operator = Callable[[SetVector, np.ndarray], None]
"""operator(values, out): out (count,) = A · values on a set, in single precision; may overwrite the halo of `values`.
Collective."""


class Mean(NamedTuple):
    """How a system treats Σ x.  If `neutral`, Σ x = 0, and the equation holds up to a constant.  Else compliance · Σ x
    is added to A x, and about `capacity` is the Σ x that answers a residual of 1.
    """

    neutral: bool = True
    compliance: float = 0.0
    capacity: float = 0.0


NEUTRAL, FREE = Mean(), Mean(False)


class ConjugateGradients:
    """S A Sᵀ x = residual for an operator A; S restricts to a set, `Mean` says what becomes of Σ x.  square: ⟨residual,
    M residual⟩ now, with the preconditioner M; rms: of the first residual; constant: what a neutral system took off it.
    """

    def __init__(self, residual: SetVector, operator: Operator, preconditioner: Operator, mean: Mean = NEUTRAL) -> None:
        """`residual` is overwritten.  Collective."""
        self.points, self.residual = residual.points, residual
        self.operator, self.preconditioner = operator, preconditioner
        self.reduction, self.threads = Reduction(self.points.grid.comm), self.points.grid.threads
        squares, total, _, count = self._sums(residual.own, residual.own, self.points.count)
        self.rms = math.sqrt(squares / count) if count else 0.0
        share = 1 / count if count else 0.0
        # sum · inverse_count: the mean to subtract, of a neutral system
        self.inverse_count, self.compliance = share * mean.neutral, mean.compliance
        self.capacity = mean.capacity * share**2
        self.z: np.ndarray | None = None
        self.mean = 0.0
        self.constant = total * self.inverse_count
        residual.own -= residual.own.dtype.type(self.constant)
        self.square = self._precondition()

    def solve(self, wanted: float) -> tuple[np.ndarray, int]:
        """Iterates until √`square` is at most `wanted` times its first value, `MOST_ITERATIONS` times at most.  Returns
        x (count,) and the number of iterations; each applies A once.  Once only: the residual is lost.  Collective.
        """
        if self.z is None:
            self._precondition()
        assert self.z is not None
        residual, z, direction = self.residual.own, self.z, SetVector(self.points)
        real, d, x = residual.dtype.type, direction.own, np.zeros_like(residual)
        product = z  # one array: z is read before A is applied, and made anew after the product is read
        d[:] = 0
        before, goal, most = math.inf, wanted**2 * self.square, DIVERGED * self.square
        steps = 0
        while max(goal, 0) < self.square < most and steps < MOST_ITERATIONS:
            turn = real(self.square / before), real(self.mean)
            self.threads.deal(partial(next_direction, d, z, turn), len(d), ENTRIES)
            before = self.square
            self.operator(direction, product)
            curvature, load, total = self._sums(d, product)
            shift = total * self.inverse_count - self.compliance * load
            curvature += self.compliance * load * load
            if not curvature > 0:
                break
            step = real(before / curvature), real(shift)
            self.threads.deal(partial(advance, x, residual, (d, product), step), len(d), ENTRIES)
            self.square, steps = self._precondition(), steps + 1
        del self.residual, self.z  # the next system is made while this one still has its name
        return x, steps

    def make_room(self) -> None:
        """Frees the preconditioned residual, which `solve` makes anew."""
        self.z = None

    def lower(self, number: float) -> None:
        """Takes a number off the residual of a system that is not neutral, before it is solved.  Collective."""
        self.residual.own -= self.residual.own.dtype.type(number)
        self.square = self._precondition()

    def _precondition(self) -> float:
        """z = M · residual, and its mean; returns ⟨residual, z − mean⟩.  Collective."""
        self.z = np.empty_like(self.residual.own) if self.z is None else self.z
        self.preconditioner(self.residual, self.z)
        square, sum_r, sum_z = self._sums(self.residual.own, self.z)
        self.mean = sum_z * self.inverse_count - sum_r * self.capacity
        return square - self.mean * sum_r

    def _sums(self, a: np.ndarray, b: np.ndarray, *more: float) -> list[float]:
        """Σ a b, Σ a, Σ b and the sums of `more` numbers over all ranks.  Collective."""
        if len(a) <= ENTRIES:
            return self.reduction.sums(*dot_and_sums(a, b, 0, len(a)), *more).tolist()
        parts = self.threads.collect(lambda i, j: dot_and_sums(a, b, i, j), len(a), ENTRIES)
        return self.reduction.sums(*map(sum, zip(*parts, strict=True)), *more).tolist()


@jit
def dot_and_sums(a: np.ndarray, b: np.ndarray, first: int, stop: int) -> tuple[float, float, float]:
    """(Σ a b, Σ a, Σ b) over the entries first … stop−1, in double precision."""
    dot = sum_a = sum_b = 0.0
    for k in range(first, stop):
        x, y = np.float64(a[u(k)]), np.float64(b[u(k)])
        dot += x * y
        sum_a += x
        sum_b += y
    return dot, sum_a, sum_b


@jit
def next_direction(direction: np.ndarray, z: np.ndarray, turn: Pair, first: int, stop: int) -> None:
    """direction = factor · direction + z − mean in the entries first … stop−1; turn: factor and mean."""
    factor, mean = turn
    for k in range(first, stop):
        direction[u(k)] = factor * direction[u(k)] + (z[u(k)] - mean)


@jit
def advance(
    x: np.ndarray, residual: np.ndarray, along: tuple[np.ndarray, np.ndarray], step: Pair, first: int, stop: int
) -> None:
    """x += factor · direction and residual −= factor · (product − mean) in the entries first … stop−1; along: direction
    and product; step: factor and mean.
    """
    (direction, product), (factor, mean) = along, step
    for k in range(first, stop):
        x[u(k)] += factor * direction[u(k)]
        residual[u(k)] -= factor * (product[u(k)] - mean)
