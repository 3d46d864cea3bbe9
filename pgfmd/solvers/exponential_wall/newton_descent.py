"""Newton's method on the displacement, each step of which lowers the dual objective: for contacts on which the steps of
`newton` cycle, as under thin slabs, which bend like plates.

The dual of the problem in `newton` is to minimise, without constraints,

    Φ(v) = ½⟨v, Kv⟩ + ζ ln⟨exp((h − v)/ζ)⟩    over the displacements v = Gq of sources q of mean 1 and of either sign.

Its gradient is q − σ, with the wall's answer σ = exp((h − v)/ζ)/⟨exp((h − v)/ζ)⟩, and its Newton step leads to the
source σ + δp̂, where δp̂ is the step of `newton` at p̂ = σ.  Φ is convex, so that a step that is short enough lowers it.
Few steps are needed if ζ is reduced from the rms height on.  σ is feasible, and is certified.

The linear equations are solved in double precision: under a thin slab long waves of σ − q displace the surface far more
than the step does, and conjugate gradients must cancel that.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import numpy as np

from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.exponential_wall.newton import Newton
from pgfmd.solvers.law_operations import LawState
from pgfmd.solvers.solution import Patience

CUT = 1e-8  # factor on the linear residual in a step: with 1e-2 in single precision, a third of the tests never ended
SETTLED = 1e-2  # promised gain per point over ζ at which the next shorter ζ takes over
ENOUGH = 0.1  # a step is shortened if it gains less than this part of what the slope promises
ROUNDING = 1e-13  # of the objective: smaller gains are rounding
MOST, SHORTEST = 100, 40  # steps for one ζ; times that a step is halved


def descend(
    softer: Iterable[ContactProblem], problem: ContactProblem, state: LawState, tolerance: float,
    monitor: Callable[[LawState], None] | None,
) -> LawState:  # fmt: skip
    """Solves `problem` from a flat displacement, under the `softer` walls in turn and then its own.  Overwrites and
    returns `state`.  Raises SolverError as `Newton.relax`.  Collective.
    """
    source = LawState(np.ones_like(problem.heights), -problem.heights)
    for soft in softer:
        solver = Descent(soft, source)
        solver.answer(state)
        for _ in range(MOST):
            if solver.advance_source(state) <= SETTLED * solver.zeta * soft.grid.size:
                break
    return Descent(problem, source).relax(state, tolerance, monitor)


class Descent(Newton):
    """Steps of a source q and its gap Gq − h, which are overwritten."""

    precision = np.float64

    def __init__(self, problem: ContactProblem, source: LawState) -> None:
        super().__init__(problem)
        self.source = source

    def relax(self, state: LawState, tolerance: float, monitor: Callable[[LawState], None] | None = None) -> LawState:
        """As `Newton.relax`, by steps of the source; the state becomes the wall's answer to it.  Collective."""
        patience = Patience(MOST // 2)
        self.answer(state)
        for _ in range(MOST):
            self.certify(state)
            if monitor is not None:
                monitor(state)
            if self.arrived(state, tolerance):
                return state
            if not patience.take(state.error):
                break
            self.advance_source(state)
        raise self.failure(patience, state, tolerance)

    def answer(self, state: LawState) -> None:
        """Sets the state to the wall's answer σ to the source's gap, and its gap to Gσ − h.  Collective."""
        gap = self.source.gap
        np.exp((self.grid.reduction.min(gap) - gap) / self.zeta, out=state.pressure)
        state.pressure *= self.grid.size / self.grid.reduction.sum(state.pressure)
        self.compute_gap(state)

    def advance_source(self, state: LawState) -> float:
        """One step of the source, and the answer to it; returns what the slope promised to gain.  Collective."""
        source, dot = self.source, self.grid.reduction.dot
        root, y, _ = self.newton_step(state, CUT)
        new = LawState(state.pressure + root * y, np.empty_like(state.gap))
        self.compute_gap(new)
        change, gap_change = new.pressure - source.pressure, new.gap - source.gap
        promised = dot(state.pressure - source.pressure, gap_change)
        linear, square = dot(source.pressure, gap_change), dot(change, gap_change)
        before, step = self.free_energy(source.gap), 1.0
        for _ in range(SHORTEST):  # gain = Φ before − Φ after, as ½⟨v, Kv⟩ = ½⟨q, Gq⟩ is quadratic in the step
            gain = before - self.free_energy(source.gap + step * gap_change) - step * linear - step**2 / 2 * square
            if gain >= ENOUGH * step * promised or promised <= ROUNDING * abs(before):
                break
            step /= 2
        source.pressure += step * change
        source.gap += step * gap_change
        self.answer(state)
        return promised

    def free_energy(self, gap: np.ndarray) -> float:
        """ζ N ln⟨exp(−g/ζ)⟩.  Collective."""
        least, count = self.grid.reduction.min(gap), self.grid.size
        weight = self.grid.reduction.sum(np.exp((least - gap) / self.zeta))
        return count * (self.zeta * math.log(weight / count) - least)
