"""Green's function molecular dynamics: damped dynamics of the displacement's Fourier modes against a wall.

After Campañá and Müser 2006 (doi:10.1103/PhysRevB.74.075420).  Mode by mode the displacement moves with its force,
m(q) du(q)/dt = f(q) − K(q) u(q), with a damping m(q) = K(q) + K₀ that gives all modes one time scale, the time step.

A hard wall that only pushed points out of itself would be consistent with the forces only if all modes had one damping.
Here the wall is a spring K₀ with a force f of its own, which each step sets to the solution of

    f/K₀ − gap(f) = f_old/K₀ − gap + c       (gap(f): that of the law; for hard walls, a projection onto f ≥ 0)

so that at rest the gap is that of the law for every K₀; c makes the forces bear the load.  With the displacement
extrapolated by one step this is a primal–dual iteration that converges for every K₀ (Condat 2013,
doi:10.1007/s10957-012-0245-9).  It is fastest if K₀ is the geometric mean of the softest and the stiffest mode.  Steps
are lengthened by the factor 1.8 (they converge below 2), which takes the place of inertia.
"""

from __future__ import annotations

import math

import numpy as np

from pgfmd.errors import SolverError
from pgfmd.grid.transforms import source
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.law_operations import LawOperations, LawState
from pgfmd.solvers.nondimensional import Dimensionless
from pgfmd.solvers.solution import ContactSolution, Monitor

INERTIA, INTERVAL = 1.8, 10
"""Factor on each step (over-relaxation); steps between certificates, each of which costs a convolution."""
RESCUE = 4000  # steps after another method has failed; most contacts take 150 (`options.cost`)


def solve_gfmd(
    problem: ContactProblem,
    tolerance: float = 1e-8,
    start: np.ndarray | None = None,
    monitor: Monitor | None = None,
    max_steps: int = 10000,
) -> ContactSolution:
    """Contact under any convex law by dynamics.  Raises SolverError after `max_steps`; all else as
    `NestedIteration.contact`.  Collective.
    """
    scaled = Dimensionless(problem)
    if scaled.uniform is not None:
        return scaled.uniform
    dynamics, grid = Dynamics(scaled.problem), problem.grid
    if start is not None:
        dynamics.force[...] = start * (grid.size / grid.reduction.sum(start))
    state = dynamics.run(tolerance, max_steps, monitor)
    return scaled.solution(state, state.work / 2, tolerance)


class Dynamics:
    """Displacement (nx_local, ny), its modes (nky_local, nx), and the wall's force over p̄.  Collective to make."""

    def __init__(self, problem: ContactProblem):
        self.grid, self.heights = problem.grid, problem.heights
        self.certifier = LawOperations(problem)
        stiffness = problem.solid.stiffness(np.sqrt(self.grid.q_squared()))
        softest = self.grid.reduction.min(stiffness[stiffness > 0])
        self.spring = math.sqrt(softest * self.grid.reduction.max(stiffness))
        self.mobility = np.where(stiffness > 0, 1 / (stiffness + self.spring), 0)
        self.modes = np.zeros(self.grid.spectral_shape, np.complex128)
        self.displacement, self.force = np.zeros(self.grid.local_shape), np.ones(self.grid.local_shape)

    def run(self, tolerance: float, max_steps: int, monitor: Monitor | None = None) -> LawState:
        """Steps until the certified error is at most `tolerance`.  Raises SolverError after `max_steps`, Uncertifiable
        as soon as only rounding keeps the error above.  Collective.
        """
        state = LawState(self.grid.new_field(), self.grid.new_field())
        level, best = 0.0, math.inf
        for step in range(1, max_steps + 1):
            state.level = level  # where the last step left it: a certificate has a level of its own
            self.step(state)
            level = state.level
            if step % INTERVAL and step < max_steps:
                continue
            state.iterations = step
            self.certifier.compute_gap(state)
            self.certifier.certify(state)
            best = min(best, state.error)
            if monitor is not None:
                monitor(self.grid, state)
            if self.certifier.arrived(state, tolerance):
                return state
        raise SolverError(
            f"GFMD: the certified error is {best:.1e} after {max_steps} steps, above the tolerance {tolerance:.1e}; "
            "allow more iterations, or a larger tolerance"
        )

    def step(self, state: LawState) -> None:
        """One time step; `state.pressure` becomes the new force of the wall.  Collective."""
        displacement, force, target = self.displacement, self.force, state.gap

        def move(block: np.ndarray, first: int, stop: int) -> None:
            modes = self.modes[first:stop]
            block += self.spring * modes
            block *= self.mobility[first:stop]
            modes += INERTIA * (block - modes)
            block *= 1 / self.grid.size

        def drain(first: int, stop: int, rows: np.ndarray) -> None:
            part = displacement[first:stop]
            change = rows - part
            target[first:stop] = force[first:stop] / self.spring + self.heights[first:stop] - rows - change
            part += INERTIA * change

        self.grid.convolve(source(force), move, drain)
        self.certifier.respond(state, target, 1 / self.spring)
        force += INERTIA * (state.pressure - force)
