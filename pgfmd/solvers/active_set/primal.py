"""The active-set step whose unknowns are the pressures between their bounds.

Conjugate gradients make the gap constant on these points.  Then pressures beyond a bound are cut, and points that their
gap drives away from a bound become unknowns.  Under a hard wall this is done two or three times with the response of
the mesh to the changes, before the gap is computed by full transforms.
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.active_set.active_set import CUT_POWER, Precision, Relaxation, State
from pgfmd.solvers.active_set.conjugate_gradients import ConjugateGradients
from pgfmd.solvers.active_set.feasible import Feasible
from pgfmd.solvers.active_set.particle_mesh import MeshResponse, inner_response
from pgfmd.solvers.active_set.preconditioner import MultilevelStiffness
from pgfmd.solvers.active_set.unknowns import Unknowns

CLOSE = 1e-4  # least part of the energy error that steps by the mesh alone leave: its response is right to one per cent
NEAR = 3.0  # gap over the rms residual up to which the mesh updates gaps: points farther away did not come into contact


class PressureSteps(Relaxation):
    """Relaxation that costs least where few points are in contact."""

    def __init__(self, problem: ContactProblem, exact: bool = True) -> None:
        super().__init__(problem, exact)
        grid, solid = problem.grid, problem.solid
        self.inner = inner_response(grid, solid.half_space_compliance, solid.compliance, self.compliance[np.float32])
        self.feasible = Feasible(problem)
        self.preconditioner = MultilevelStiffness(grid, solid.half_space_stiffness, solid.stiffness)

    def free(self) -> None:
        """Frees the transforms of the inner solver.  Collective."""
        super().free()
        self.preconditioner.free()

    def _begin(self, state: State) -> None:
        """Adapts the start to roughness that only this grid resolves: one iteration with the near part of the response.
        Blocks of pixels keep their loads, since the coarser grid has long waves right.  Collective.
        """
        state.estimated = False
        if isinstance(self.inner, MeshResponse):
            points = Unknowns(self.grid, (state.pressure, state.gap), 0.0, self.highest)
            near = self.inner.stencil.apply, partial(self.preconditioner.apply, near_only=True)
            self._solve(state, ConjugateGradients(points.below(0.0, state.gap), *near), 0.5)

    def linearise(self, state: State, precision: Precision) -> ConjugateGradients:
        """Computes the gap.  The system makes it constant on the unknowns.  Collective."""
        if state.estimated:
            self._begin(state)
        self.compute_gap(state, precision)
        return self._system(state)

    def _system(self, state: State) -> ConjugateGradients:
        """The system for a gap that is known.  Collective."""
        self.measure(state)
        points = Unknowns(self.grid, (state.pressure, state.gap), state.level, self.highest)
        return ConjugateGradients(points.below(state.level, state.gap), self.inner.apply, self.preconditioner.apply)

    def improve(self, state: State, system: ConjugateGradients, wanted: float, enough: float) -> None:
        """Makes the gap constant on the unknowns, solving for them anew as they change: the mesh tells the response to
        the change so far.  Collective.

        Full transforms follow once `system.square` has probably fallen to the part `enough`; if that is less than
        `CLOSE`, in equal steps.
        """
        part = enough ** (1 / math.ceil(math.log(max(enough, CLOSE**9), CLOSE)))
        goal = part * system.square
        meshed = isinstance(self.inner, MeshResponse) and self.highest == math.inf
        wanted = max(wanted, math.sqrt(part)) if meshed else wanted
        while meshed and wanted**2 * system.square > 1.1 * goal:
            near = Unknowns(self.grid, (state.pressure, state.gap), state.level + NEAR * system.rms)
            square, change = system.square, near.below(0.0, state.pressure)
            self._solve(state, system, wanted)
            change.own -= near.below(0.0, state.pressure).own
            response = np.empty(near.count, np.float32)
            self.inner.apply(change, response)
            near.add(state.gap, response)
            system = self._system(state)
            if not goal < system.square < square / 2:
                return
            wanted = max(math.sqrt(goal / system.square), (system.square / square) ** CUT_POWER)
        self._solve(state, system, wanted)

    def _solve(self, state: State, system: ConjugateGradients, wanted: float) -> None:
        """Reduces the gap's deviation from a constant on the unknowns by the factor `wanted`, and makes the pressure
        feasible.  Collective.
        """
        change, steps = system.solve(wanted)
        system.points.add(state.pressure, change)
        state.iterations += steps
        self.feasible.make(system.points, (state.pressure, state.gap))
