"""The hard wall by the pressures of the points in contact: on the contact set the gap is made constant by conjugate
gradients; then points in tension leave it and points that overlap join.
"""

from __future__ import annotations

import numpy as np

from pgfmd.grid import kernels
from pgfmd.grid.callbacks import Rows
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.active_set.active_set import MOST_INNER, SINGLE_LIMIT, Relaxation, State
from pgfmd.solvers.active_set.conjugate_gradients import solve_on_set
from pgfmd.solvers.active_set.contact_set import ContactSet, SetVector
from pgfmd.solvers.active_set.particle_mesh import inner_response
from pgfmd.solvers.active_set.preconditioner import MultilevelStiffness
from pgfmd.solvers.active_set.tension import cut_tension

PART = 0.05  # of the error that a grid begins with: long waves that it leaves cost most on the next one
LOOSEST = 2e-2  # certified error of a grid that begins a finer one


class PressureSteps(Relaxation):
    """Relaxation that costs least where few points are in contact.

    Attributes: points, the set to solve on next (None before the first look); residual, how far the gap there
    lies below the level of contact.
    """

    def __init__(self, problem: ContactProblem, exact: bool = True):
        super().__init__(problem, exact)
        grid, solid = problem.grid, problem.solid
        self.inner = inner_response(grid, solid.half_space_compliance, solid.compliance, self.compliance[np.float32])
        self.preconditioner = MultilevelStiffness(grid, solid.half_space_stiffness, solid.stiffness)
        self.points = self.residual = None

    def free(self) -> None:
        """Give the memory of coarser transforms back.  Collective."""
        self.inner.free()
        self.preconditioner.free()

    def goal(self, state: State, tolerance: float) -> float:
        """What interpolation from a coarser grid got wrong here tells how much it will get wrong from here: of that, a
        small part, but never what single precision could not reach.
        """
        return max(min(PART * state.error, LOOSEST), SINGLE_LIMIT)

    def look(self, state: State, tolerance: float) -> None:
        """Points in tension leave the set and overlapping points join it; makes the state feasible and certifies it.
        Collective.

        The set is chosen from the pressure with its tensions: once these are cut off, the gap reacts everywhere, and a
        set chosen from it would oscillate.  That reaction is computed on the set alone, approximately, while the error
        is above the tolerance; a state within it has an exact one.

        The certificate compares the feasible p with p' = p − c, as it was before the cut: for any p' of gap g',
        J(p) − J(p*) ≤ ⟨p, g' − min g'⟩ + ½⟨c, Gc⟩, where the cut counts in second order only.
        """
        old = self.points or ContactSet(self.grid, state.pressure, state.gap, -np.inf)
        inside, count = self.grid.reduction.sums(old.sum(state.gap), old.count)
        level = inside / count
        new = ContactSet(self.grid, state.pressure, state.gap, level, old.busy(self.least, level))
        change = None if self.points is None else cut_tension(old, state.pressure, self.load)
        self.points = new
        sums = old.contact_sums(state.pressure, state.gap, self.heights)
        if change is None:
            self.certify(state, sums)
            self.residual = new.below(state.level, state.gap)
            return
        response = np.empty(new.count, np.float32)
        self.inner.apply(old, change, response, new)
        reaction = new.dot(state.pressure, response)
        self.certify(state, sums, reaction)
        bound = 2 * state.energy * state.error
        (reaction,) = self.grid.reduction.sums(reaction)
        state.error = max(state.error, abs(reaction) / (2 * abs(state.energy)))  # a large reaction is not to be trusted
        if not self.exact or state.error > tolerance:
            self.residual = new.below(state.level, state.gap)
            self.residual.own -= response
            return
        bound += self.shift_gap(state, old, change)
        self.certify(state, old.contact_sums(state.pressure, state.gap, self.heights))
        state.error = min(state.error, bound / (2 * state.energy))
        self.residual = new.below(state.level, state.gap)

    def source(self, state: State) -> Rows:
        """The state's pressure, row by row."""
        return super().source(state) if self.points is None else self.points.fill(self.points.take(state.pressure))

    def shift_gap(self, state: State, points: ContactSet, change: SetVector) -> float:
        """gap += G c for a change c of the pressure on a set.  Returns ½⟨c, Gc⟩.  Collective."""

        def drain(first: int, stop: int, rows: np.ndarray):
            gap = state.gap[first:stop]
            kernels.add_rows(gap, rows, gap)
            kernels.least_of_segments(gap, self.least[first:stop])

        before = points.dot(state.gap, change.own)
        self.grid.convolve(points.fill(change.own), self.compliance[np.float32], drain, np.float32)
        (twice,) = self.grid.reduction.sums(points.dot(state.gap, change.own) - before)
        return twice / 2

    def improve(self, state: State, wanted: float, tolerance: float, precision) -> None:
        """Make the gap flatter on the set by the factor `wanted`; pressures there may become negative.  Collective."""
        change, steps = solve_on_set(self.points, self.residual, self.inner, self.preconditioner, wanted, MOST_INNER)
        self.points.add(state.pressure, change)
        state.iterations += steps
