"""The active-set step that lowers the energy each time, for contacts on which larger steps go round in circles.

Points that are released together may push each other back.  Here a step releases the points that their gap drives away
from a bound, and solves for them and for those between the bounds.  Released points that the solution drives beyond
their bound stay at it, and the rest is solved again.  In that direction the energy falls at least up to where the first
point meets a bound: no set comes twice (Nocedal and Wright 2006, section 16.5, with blocks of points for single ones).
"""

from __future__ import annotations

import math

import numpy as np

from pgfmd.solvers.active_set.active_set import State
from pgfmd.solvers.active_set.conjugate_gradients import ConjugateGradients
from pgfmd.solvers.active_set.primal import PressureSteps
from pgfmd.solvers.active_set.unknowns import Unknowns

CUT = 1e-3  # factor on the residual in one step: the signs of the solution decide, single precision has no more
ENOUGH = 0.1  # a step beyond a bound is shortened if it gains less than this part of what the slope promises
TRIALS = 4  # lengths that are tried before a step ends where the first point meets a bound


class Descent(PressureSteps):
    """Relaxation in double precision by steps none of which raises the energy; takes more fields."""

    precision = np.float64
    patience, most_steps = 60, 2000

    def improve(self, state: State, system: ConjugateGradients, wanted: float, enough: float) -> None:
        """A step shortened until it lowers the energy enough; `wanted` and `enough` do not matter.  Collective."""
        reduction, pressure, gap = self.grid.reduction, state.pressure.copy(), state.gap - state.level
        points, direction = self._direction(state)
        with np.errstate(divide="ignore", invalid="ignore"):
            room = np.where(direction < 0, pressure / -direction, (self.highest - pressure) / direction)
        room[direction == 0] = np.inf  # the step at which each point meets a bound
        furthest, promised = reduction.min(room), -reduction.dot(gap, direction) / 2
        step = 1.0
        for trial in range(TRIALS + 1):
            np.add(pressure, step * direction, out=state.pressure)
            state.pressure[room <= step] = np.where(direction < 0, 0.0, self.highest)[room <= step]
            self.feasible.make(self.problem, points, (state.pressure, state.gap))
            if step <= furthest:
                return
            self.compute_gap(state, self.precision)
            change = state.pressure - pressure
            gain = -reduction.dot(gap + (state.gap - state.level), change) / 2
            if gain >= ENOUGH * step * promised:
                return
            step = max(furthest, min(step / 4, math.sqrt(step * furthest))) if trial < TRIALS - 1 else furthest

    def _direction(self, state: State) -> tuple[Unknowns, np.ndarray]:
        """The unknowns, and the change (nx_local, ny) that makes the gap constant on them, by which all that are at a
        bound leave it.  Collective.
        """
        pressure, gap, level = state.pressure, state.gap, state.level
        # shown: the gap by which unknowns are chosen, infinite at points that stay at their bound
        low, high, shown = pressure <= 0, pressure >= self.highest, gap.copy()
        while True:
            points = Unknowns(self.grid, (pressure, shown), level, self.highest)
            system = ConjugateGradients(points.below(level, gap), self.inner.apply, self.preconditioner.apply)
            change, steps = system.solve(CUT)
            state.iterations += steps
            direction = np.zeros_like(pressure)
            points.add(direction, change)
            back = low & (shown < level) & (direction <= 0) | high & (shown > level) & (direction >= 0)
            if not self.grid.reduction.any(bool(back.any())):
                return points, direction
            shown[back] = np.where(low, np.inf, -np.inf)[back]
