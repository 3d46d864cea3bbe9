"""Nested iteration by Newton's method; on the coarsest grid, the range of the law is reduced step by step."""

from __future__ import annotations

import math

import numpy as np

from pgfmd.errors import SolverError, Uncertifiable
from pgfmd.grid.transfer import Interpolation
from pgfmd.parallel.collectives import shared
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.exponential_wall.newton import Newton
from pgfmd.solvers.gfmd import RESCUE, Dynamics
from pgfmd.solvers.law_operations import LawState
from pgfmd.solvers.nested_iteration import Coarse, NestedIteration

COARSE_TOLERANCE = 3e-3  # certified error asked of a coarse grid: discretisation errors are larger
LOOSE = 0.1  # certified error to which each of these ranges is solved
SHORTEST = 1e-3  # rms heights: a wall that is shorter at the mean pressure, as a hard one, begins with this length
REDUCTION = 4  # each range of the first steps over the next one


class NewtonIteration(NestedIteration[LawState]):
    """Nested iteration by Newton's method.  cycles: whether its steps have cycled on a coarser grid."""

    cycles = False

    def relax(self, problem: ContactProblem, state: LawState, exact: bool = True) -> LawState:
        """Newton from that state.  Where its steps cycle, dynamics, which always converge, on this grid and finer ones;
        there are none for open boundaries.
        """
        goal, iterations = self.goal(exact), 0
        if not problem.grid.reduction.max(float(self.cycles)):  # as ranks without rows of a coarse grid know nothing
            try:
                return Newton(problem).relax(state, goal, self.watch(problem))
            except SolverError as failure:
                if isinstance(failure, Uncertifiable) or not problem.grid.domain.wraps:
                    raise
                if not shared(problem.grid.comm, failure):
                    raise
            self.cycles, iterations = True, state.iterations
        found = Dynamics(problem).run(goal, RESCUE, self.monitor)
        found.iterations += iterations
        return found

    def resume(self, problem: ContactProblem, start: np.ndarray) -> LawState:
        """From the pressure, scaled to the load."""
        grid = problem.grid
        pressure = np.multiply(start, grid.size / grid.reduction.sum(start), dtype=np.float64)
        return self.relax(problem, LawState(pressure, grid.new_field()))

    def energy(self, state: LawState, size: int) -> float:
        """Half the work per point."""
        return state.work / 2

    def coarsest(self, problem: ContactProblem, exact: bool) -> LawState:
        """From a uniform pressure and a range of the rms height, where a few steps suffice, down to the wall's own."""
        shape = problem.grid.local_shape
        state = LawState(np.ones(shape), np.empty(shape))
        length = max(problem.law.range_at(1.0), SHORTEST)
        for power in range(math.ceil(math.log(1 / length, REDUCTION)), 0, -1):
            try:
                Newton(problem.with_law(problem.law.softer(float(REDUCTION**power)))).relax(state, LOOSE)
            except SolverError as failure:  # what is reached only starts the next
                if not shared(problem.grid.comm, failure):
                    raise
        return self.relax(problem, state, exact)

    def goal(self, exact: bool) -> float:
        """The certified error at which a grid is solved."""
        return self.tolerance if exact else max(self.tolerance, COARSE_TOLERANCE)

    def prolong(self, coarse: Coarse, found: LawState, problem: ContactProblem) -> tuple[LawState, bool]:
        """The pressure with which the wall responds to the interpolated displacement and pressure, and False."""
        grid, heights = problem.grid, problem.heights
        interpolation = Interpolation(coarse.place, grid, [found.gap + coarse.heights, found.pressure])
        target = grid.new_field()
        solver = Newton(problem)

        def part(thread: int, first: int, stop: int) -> None:
            displacement, pressure = (interpolation.rows(which, first, stop, thread) for which in (0, 1))
            with np.errstate(over="ignore", invalid="ignore"):  # of loads near the largest number
                target[first:stop] = solver.alpha * pressure - (displacement - heights[first:stop])

        grid.threads.share(part, grid.local_shape[0], grid.band)
        state = LawState(grid.new_field(), grid.new_field(), level=found.level)
        solver.respond(state, target, solver.alpha)
        return state, False


solve_exponential_wall = NewtonIteration.contact
"""The contact under a wall that repels, exponential or not: see `NestedIteration.contact`.  Collective."""
