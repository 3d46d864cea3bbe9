"""The wall by the pressures between their bounds: on these points the gap is made constant by conjugate gradients;
then pressures beyond a bound are cut, and points whose gap drives them away from a bound join.
"""

from __future__ import annotations

import numpy as np

from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.active_set.active_set import MOST_INNER, Precision, Relaxation, State
from pgfmd.solvers.active_set.conjugate_gradients import ConjugateGradients
from pgfmd.solvers.active_set.contact_set import ContactSet
from pgfmd.solvers.active_set.feasible import make_feasible
from pgfmd.solvers.active_set.particle_mesh import inner_response
from pgfmd.solvers.active_set.preconditioner import MultilevelStiffness

PART = 0.05  # of the error that a grid begins with: long waves that it leaves cost most on the next one
LOOSEST = 2e-2  # error of a grid that begins a finer one
FINEST = 1e-8  # and the least: what single precision reaches on any grid


class PressureSteps(Relaxation):
    """Relaxation that costs least where few points are in contact."""

    def __init__(self, problem: ContactProblem, exact: bool = True) -> None:
        super().__init__(problem, exact)
        grid, solid = problem.grid, problem.solid
        self.inner = inner_response(grid, solid.half_space_compliance, solid.compliance, self.compliance[np.float32])
        self.preconditioner = MultilevelStiffness(grid, solid.half_space_stiffness, solid.stiffness)

    @property
    def pixel_stiffness(self) -> float:
        """Pressure of a pixel over its displacement under that.  Collective at first."""
        return 1 / self.means[0] if self.means[0] > 0 else 1.0

    def free(self) -> None:
        """Give the memory of coarser transforms back.  Collective."""
        self.inner.free()
        self.preconditioner.free()

    def goal(self, estimate: float, tolerance: float) -> float:
        """A part of the error that interpolation from a coarser grid has left: the next one will leave as much."""
        return max(min(PART * estimate, LOOSEST), tolerance / 4, FINEST)

    def look(self, state: State, precision: Precision) -> ConjugateGradients:
        """The gap of the pressure; the system makes it constant where the pressure can change.  Collective."""
        self.compute_gap(state, precision)
        self.measure(state)
        points = ContactSet(self.grid, (state.pressure, state.gap), state.level, self.top)
        return ConjugateGradients(points.below(state.level, state.gap), self.inner, self.preconditioner)

    def improve(self, state: State, system: ConjugateGradients, wanted: float) -> None:
        """Make the gap flatter on the set by the factor `wanted`, and the pressure feasible.  Collective."""
        change, steps = system.solve(wanted, MOST_INNER)
        system.points.add(state.pressure, change)
        state.iterations += steps
        make_feasible(system.points, (state.pressure, state.gap), self.load, self.top, self.pixel_stiffness)
