"""Nested iteration by Newton's method for the exponential wall; on the coarsest grid, ζ is reduced step by step."""

from __future__ import annotations

import math

import numpy as np

from pgfmd.errors import SolverError, Uncertifiable
from pgfmd.grid.transfer import Interpolation
from pgfmd.parallel.collectives import shared
from pgfmd.physics.laws.exponential_law import ExponentialWall
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.exponential_wall.newton import LawNewton, Newton, descend
from pgfmd.solvers.law_operations import LawState
from pgfmd.solvers.nested_iteration import Coarse, NestedIteration

COARSE_TOLERANCE = 3e-3  # certified error asked of a coarse grid: discretisation errors are larger
LOOSE = 0.1  # certified error to which each ζ of a continuation is solved
SHORTEST = 1e-3  # rms heights: a wall that is shorter at the mean pressure, as a hard one, begins with this length
REDUCTION = 4  # each ζ of a continuation over the next one


class NewtonIteration(NestedIteration[LawState]):
    """Nested iteration by Newton's method."""

    def relax(self, problem: ContactProblem, state: LawState, exact: bool = True) -> LawState:
        """Newton from that state; should it fail, by continuation in ζ from a uniform pressure."""
        try:
            return newton(problem).relax(state, self.goal(exact), self.watch(problem))
        except SolverError as failure:
            if isinstance(failure, Uncertifiable) or not shared(problem.grid.comm, failure):
                raise
            state.pressure[...] = 1.0
        return self.continuation(problem, state, exact)

    def resume(self, problem: ContactProblem, start: np.ndarray) -> LawState:
        """From the pressure, scaled to the load."""
        grid = problem.grid
        pressure = np.multiply(start, grid.size / grid.reduction.sum(start), dtype=np.float64)
        return self.relax(problem, LawState(pressure, grid.new_field()))

    def energy(self, state: LawState, size: int) -> float:
        """Half the work per point."""
        return state.work / 2

    def coarsest(self, problem: ContactProblem, exact: bool) -> LawState:
        """By continuation from a uniform pressure."""
        shape = problem.grid.local_shape
        return self.continuation(problem, LawState(np.ones(shape), np.empty(shape)), exact)

    def continuation(self, problem: ContactProblem, state: LawState, exact: bool) -> LawState:
        """From ζ = rms height, where a few steps suffice from any start, down to the wall's own.  If the error stops
        falling, the same by steps that lower the dual objective each time.  Collective.
        """
        tolerance, watch = self.goal(exact), self.watch(problem)
        length = max(problem.law.range_at(1.0), SHORTEST)
        powers = range(max(0, math.ceil(math.log(1 / length, REDUCTION))), 0, -1)
        softer = [problem.with_law(problem.law.softer(float(REDUCTION**power))) for power in powers]
        for soft in softer:
            try:
                newton(soft).relax(state, LOOSE)
            except SolverError as failure:  # what is reached only starts the next
                if not shared(problem.grid.comm, failure):
                    raise
        try:
            return newton(problem).relax(state, tolerance, watch)
        except SolverError as failure:
            if isinstance(failure, Uncertifiable) or not shared(problem.grid.comm, failure):
                raise
            if not isinstance(problem.law, ExponentialWall):  # `descend` needs its dual objective
                raise
            return descend(softer, problem, state, tolerance, watch)

    def goal(self, exact: bool) -> float:
        """The certified error at which a grid is solved."""
        return self.tolerance if exact else max(self.tolerance, COARSE_TOLERANCE)

    def prolong(self, coarse: Coarse, found: LawState, problem: ContactProblem) -> tuple[LawState, bool]:
        """The pressure with which the wall responds to the interpolated displacement and pressure, and False."""
        grid, heights = problem.grid, problem.heights
        interpolation = Interpolation(coarse.place, grid, [found.gap + coarse.heights, found.pressure])
        target = grid.new_field()
        solver = newton(problem)

        def part(thread: int, first: int, stop: int) -> None:
            displacement, pressure = (interpolation.rows(which, first, stop, thread) for which in (0, 1))
            with np.errstate(over="ignore", invalid="ignore"):  # of loads near the largest number
                target[first:stop] = solver.alpha * pressure - (displacement - heights[first:stop])

        grid.threads.share(part, grid.local_shape[0], grid.band)
        state = LawState(grid.new_field(), grid.new_field(), level=found.level)
        solver.respond(state, target, solver.alpha)
        return state, False


def newton(problem: ContactProblem) -> Newton:
    """The steps for the law of the problem.  Collective."""
    return (Newton if isinstance(problem.law, ExponentialWall) else LawNewton)(problem)


solve_exponential_wall = NewtonIteration.contact
"""The contact under an exponential wall: see `NestedIteration.contact`.  Collective."""
