"""Newton's method for any wall the pressure of which decreases with the gap, p = P(e).

With the law's gap e at the pressure of each point and w = √(−P'(e)), Newton's equation for the change δp̂ = w y is

    (1 + w G w) y = −w (g − e − c),     Σ w y = 0,

which for P = exp(−e/ζ) is that of `newton` over ζ.  The pointwise step α p̂⁺ − e⁺ = α (p̂ + δp̂) − (g + Gδp̂) + c is the
same.  A step is shortened where the objective rises along it, by three values of its slope, ⟨g − e, p̂₁ − p̂₀⟩: that
needs no energy of the law in closed form.
"""

from __future__ import annotations

import math

import numpy as np

from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.exponential_wall.newton import BACK, Merits, Newton
from pgfmd.solvers.law_operations import LawState

STIFFEST = 1e4  # −P' over 1/α at most: where the wall is hard, −P' is infinite
SHORTENED = 10  # times, down to 1e-6 of the step


class LawNewton(Newton):
    """Newton iterations for a problem under a law that knows its `gap_and_slope`."""

    def __init__(self, problem: ContactProblem):
        super().__init__(problem)
        self.law_gap, self.slope = problem.grid.new_field(), problem.grid.new_field()

    def merits(self, state: LawState) -> Merits:
        """None: steps are judged by slopes."""
        return math.inf, math.inf

    def linearise(self, pressure: np.ndarray) -> None:
        """The law's gap e and −P'(e), at most `STIFFEST`/α, at pressures (nx_local, ny)."""
        self.each(self.problem.law.gap_and_slope, pressure, self.law_gap, self.slope)
        np.minimum(self.slope, STIFFEST / self.alpha, out=self.slope)

    def start(self, state: LawState, root: np.ndarray, residual: np.ndarray) -> tuple[float, float]:
        """Fills w and −w (g − e − c) with c such that Σ w × that is 0; returns the sum of its squares, and Σ w².
        Collective.
        """
        self.linearise(state.pressure)
        sums = self.grid.reduction
        mass = sums.sum(self.slope)
        away = state.gap - self.law_gap
        level = sums.dot(self.slope, away) / mass if mass > 0 else 0.0
        np.sqrt(self.slope, out=root, casting="same_kind")
        np.multiply(root, level - away, out=residual, casting="same_kind")
        return sums.dot(residual, residual), max(mass, np.finfo(float).tiny)

    def advance(self, state: LawState, wanted: float, before: Merits) -> Merits:
        """One Newton step, shortened while the objective rises along it.  Collective."""
        old, level = LawState(state.pressure.copy(), state.gap.copy()), state.level
        self.respond(state, self.newton_target(state, wanted), self.alpha)
        self.compute_gap(state)

        def slope(part: float) -> float:
            """⟨g − e − c, new − old⟩ at that part of the step, where g and p are linear; c only keeps digits."""
            change, scratch = state.pressure - old.pressure, self.slope  # which `start` fills anew
            if part > 0:
                np.multiply(change, part, out=scratch)
                scratch += old.pressure
                self.linearise(scratch)
            np.subtract(state.gap, old.gap, out=scratch)
            scratch *= part
            scratch += old.gap
            scratch -= self.law_gap
            scratch -= level
            return float(self.grid.reduction.dot(scratch, change))

        first = slope(0.0)
        for _ in range(SHORTENED):
            last = slope(1.0)
            if last <= abs(first) / 2 or first + 4 * slope(0.5) + last <= 0:  # Simpson's rule
                break
            self.step_back(old.pressure, old.gap, state)
            first *= BACK
        self.certify(state)
        return before
