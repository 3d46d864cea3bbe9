"""What solvers for any convex law do on one grid: the gap of a pressure, its certificate, the wall's answer.

Pressures are over their mean, p̂ = p/p̄, so that feasible ones have mean 1; gaps and heights share one unit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pgfmd.grid import kernels
from pgfmd.physics.problem import ContactProblem


@dataclass
class WallState:
    """p̂ and g (nx_local, ny) on one grid, and what is known about them; `error` is the bound on J(p̂) − J(p̂*) over
    ⟨p̂, Gp̂⟩.
    """

    pressure: np.ndarray
    gap: np.ndarray
    error: float = np.inf
    objective: float = np.inf
    work: float | None = None  # ⟨p̂, Gp̂⟩, if that is known better than from p̂ and g
    level: float = 0.0  # c: at the solution the law's gap at p̂ is g − c
    contact: int = 0  # points that carry more than the mean
    iterations: int = 0


class WallRelaxation:
    """A dimensionless `problem` of mean pressure 1, and what is computed of its states."""

    def __init__(self, problem: ContactProblem):
        self.problem, self.grid, self.heights, self.law = problem, problem.grid, problem.heights, problem.law
        scale = 1 / self.grid.size
        self.compliance = {
            kind: problem.solid.apply_compliance(self.grid, kind, scale) for kind in (np.float32, np.float64)
        }

    def compute_gap(self, state: WallState) -> None:
        """g = Gp̂ − h in double precision, and ⟨p̂, Gp̂⟩, which g does not tell where h is far larger.  Collective."""
        parts = []

        def fill(first: int, stop: int, rows: np.ndarray):
            rows[...] = state.pressure[first:stop]

        def drain(first: int, stop: int, rows: np.ndarray):
            parts.append((first, float(np.vdot(rows, state.pressure[first:stop]))))
            kernels.subtract_rows(rows, self.heights[first:stop], state.gap[first:stop])

        self.grid.convolve(fill, self.compliance[np.float64], drain)
        state.work = self.grid.reduction.sum([part for _, part in sorted(parts)]) / self.grid.size

    def total(self, kernel, *arguments) -> np.ndarray:
        """The sums over all rows of all ranks of what a kernel returns for some rows.  Collective."""
        parts = self.grid.threads.collect(
            lambda a, b: np.atleast_1d(kernel(*arguments, a, b)), self.grid.local_shape[0]
        )
        return self.grid.reduction.sums(*np.sum(parts, axis=0))

    def certify(self, state: WallState) -> None:
        """Objective, energy and certified error of a feasible state.  Collective."""
        count = self.grid.size
        least = self.grid.reduction.min(state.gap)
        found = self.law.certify(self.total, state.pressure, state.gap, self.heights, least)
        state.level, state.contact = found.level, found.contact
        state.work = found.work / count if state.work is None else state.work
        state.objective = found.potential / count - state.work / 2 + least
        state.error = found.bound / count / state.work if state.work > 0 else np.inf

    def respond(self, state: WallState, target: np.ndarray, compliance: float) -> None:
        """The law's answer p̂ with compliance · p̂ − gap(p̂) = target + c, with c such that its mean is 1; the search
        begins at the state's c.  Collective.
        """
        count, level, low, high = self.grid.size, state.level, -np.inf, np.inf
        # What is missing is made up by a factor; to the hard wall's certificate that is an error of first order.
        enough = 1e-9 * count if self.law.range > 0 else 0.0
        for _ in range(200):
            total, slope = self.total(self.law.respond, target, compliance, level, state.pressure)
            if abs(total - count) <= enough:
                break
            low, high = (level, high) if total < count else (low, level)
            if total > 0:  # Newton for Σ p̂, which is nearly linear in c, or for its logarithm: the shorter step
                steps = (count - total) / slope, math.log(count / total) * total / slope
                trial = level + min(steps, key=abs)
            else:  # all underflowed: up to where the highest point alone would carry its share
                trial = compliance - self.grid.reduction.max(target)
            if abs(trial - level) <= 1e-15 * abs(level):
                break
            level = trial if low < trial < high else (low + high) / 2
        state.pressure *= count / total
        state.level = level
