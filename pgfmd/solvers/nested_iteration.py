"""Nested iteration: the solution on each grid starts the next finer one, which has four times as many points."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

import numpy as np

from pgfmd.grid.transfer import restrict
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.solution import Monitor, State

COARSEST = 32  # points of the shorter side below which coarser grids bring nothing
FLAT = 1e-2  # rms height of a coarse grid over that of the surface, below which its solution is no good start

Own = TypeVar("Own", bound=State)
"""What a solver knows of one grid."""


class NestedIteration(Generic[Own]):
    """Solves dimensionless problems to a tolerance, each grid from the next coarser one."""

    def __init__(self, tolerance: float, monitor: Monitor | None) -> None:
        self.tolerance, self.monitor = tolerance, monitor

    def solve(self, problem: ContactProblem, exact: bool = True) -> tuple[Own, float]:
        """The solution, and the transforms spent on coarser grids, weighted by size.  Collective.

        exact: the error is certified to the tolerance; otherwise the grid only starts a finer one.
        """
        if (state := self.at_once(problem)) is not None:
            return state, 0.0
        coarse = self.coarser(problem)
        if coarse is None:
            return self.coarsest(problem, exact), 0.0
        found, transforms = self.solve(coarse, False)
        iterations, share = found.iterations, coarse.grid.size / problem.grid.size
        state, solved = self.prolong(coarse, found, problem)
        transforms = (transforms + coarse.grid.transforms) * share
        coarse.grid.free()
        del found, coarse
        if not solved:
            state = self.relax(problem, state, exact)
        state.iterations += iterations
        return state, transforms

    def coarser(self, problem: ContactProblem) -> ContactProblem | None:
        """The problem on the next coarser grid, or None if its solution would be no good start.  Collective."""
        if min(problem.grid.shape) <= COARSEST:
            return None
        coarse = problem.grid.coarse()
        heights = restrict(problem.grid, coarse, problem.heights, np.float32)
        if coarse.reduction.dot(heights, heights) < FLAT**2 * coarse.size:
            return None
        return problem.on(coarse, heights)

    def at_once(self, problem: ContactProblem) -> Own | None:
        """The solution, if it needs no iteration.  Collective."""
        return None

    def coarsest(self, problem: ContactProblem, exact: bool) -> Own:
        """The solution without a coarser grid.  Collective."""
        raise NotImplementedError

    def prolong(self, coarse: ContactProblem, found: Own, problem: ContactProblem) -> tuple[Own, bool]:
        """The state with which the finer grid starts, and whether that is its solution.  Collective."""
        raise NotImplementedError

    def relax(self, problem: ContactProblem, state: Own, exact: bool = True) -> Own:
        """Iterates from that state, which is overwritten.  Collective.  Raises SolverError."""
        raise NotImplementedError

    def watch(self, problem: ContactProblem) -> Callable[[Own], None] | None:
        """The monitor of one grid."""
        monitor = self.monitor
        return None if monitor is None else lambda state: monitor(problem.grid, state)
