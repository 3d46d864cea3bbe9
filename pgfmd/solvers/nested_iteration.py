"""Nested iteration: the solution on each grid starts the next finer one, which has four times as many points."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from pgfmd.errors import SolverError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.transfer import SubGrid, restrict_locally
from pgfmd.parallel.collectives import shared
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.nondimensional import Dimensionless
from pgfmd.solvers.solution import SOLVER_SHARE, ContactSolution, Monitor, SolverState

COARSEST, NARROWEST = 32, 8  # root of the number of points, and points of the shorter side, not to be coarsened
FLAT = 1e-2  # rms height on a coarse grid over that on the fine one, below which its solution is no good start

StateType = TypeVar("StateType", bound=SolverState)


class Coarse(NamedTuple):
    """The next coarser grid, and the heights (nx_local, ny) there."""

    place: SubGrid
    heights: np.ndarray


class NestedIteration(Generic[StateType]):
    """Solves problems to a tolerance, each grid from the next coarser one.  `contact` takes physical problems, all else
    dimensionless ones; rms: of the heights of the finest.
    """

    def __init__(self, tolerance: float, monitor: Monitor | None) -> None:
        self.tolerance, self.monitor, self.rms = tolerance, monitor, 1.0

    @classmethod
    def contact(
        cls,
        problem: ContactProblem,
        tolerance: float = 1e-8,
        start: np.ndarray | None = None,
        monitor: Monitor | None = None,
        overwrite_heights: bool = False,
    ) -> ContactSolution:
        """The contact, to a certified relative energy error.  Collective.

        start: a pressure (nx_local, ny) ≥ 0 from a neighbouring load to begin with, instead of coarse grids.  monitor:
        called after each outer step.  overwrite_heights: their memory is used, and they are lost.  Raises InputError
        for what is out of range, SolverError if the tolerance cannot be reached.
        """
        share = 1.0 if problem.grid.storage is np.float64 else SOLVER_SHARE
        nested = cls(share * tolerance, monitor)
        scaled = Dimensionless(problem, overwrite_heights)
        if scaled.uniform is not None:
            return scaled.uniform
        nested.rms = scaled.rms
        problem.grid.make_room()  # filled in double precision by the surface; single precision takes half of them
        if start is None:
            state, transforms = nested.solve(scaled.problem)
        else:
            state, transforms = nested.resume(scaled.problem, start), 0.0
        return scaled.solution(state, nested.energy(state, problem.grid.size), tolerance, transforms)

    def solve(self, problem: ContactProblem, exact: bool = True) -> tuple[StateType, float]:
        """The solution, and the transforms spent on coarser grids, weighted by size.  exact: the error is certified to
        the tolerance; otherwise the grid only starts a finer one.  Collective.
        """
        coarse = self.coarser(problem)
        if coarse is None:
            return self.coarsest(problem, exact), 0.0
        try:
            found, transforms = self._solve_coarse(problem, coarse)
        except SolverError as failure:
            if shared(problem.grid.comm, failure):
                coarse.place.free()
            raise
        iterations = found.iterations
        transforms *= coarse.place.size / problem.grid.size
        coarse.place.free()
        state, is_solution = self.prolong(coarse, found, problem)
        del found, coarse
        if not is_solution:
            state = self.relax(problem, state, exact)
        state.iterations += iterations
        return state, transforms

    def _solve_coarse(self, problem: ContactProblem, coarse: Coarse) -> tuple[StateType, float]:
        """Solves on the coarse grid; ranks without it get no rows.  Also returns its transforms.  Collective."""

        def solve(grid: SlabGrid) -> tuple[StateType, float]:
            found, transforms = self.solve(problem.on(grid, coarse.heights), False)
            return found, transforms + grid.transforms

        def numbers(solved: tuple[StateType, float]) -> tuple[StateType, float]:
            own: Any = solved[0]
            no_rows = np.empty((0, coarse.place.shape[1]))
            return dataclasses.replace(own, pressure=no_rows, gap=no_rows), solved[1]

        return coarse.place.on_all(solve, numbers)

    def coarser(self, problem: ContactProblem) -> Coarse | None:
        """The next coarser grid, or None if the solution there would be no good start.  Collective."""
        if problem.grid.size <= COARSEST**2 or min(problem.grid.shape) <= NARROWEST:
            return None
        place = SubGrid.coarse(problem.grid)
        heights = restrict_locally(problem.grid, place, problem.heights)
        if not problem.grid.domain.wraps:
            return Coarse(place, heights)
        flat = problem.grid.reduction.dot(heights, heights) < (FLAT * self.rms) ** 2 * place.size
        return None if flat else Coarse(place, heights)

    def resume(self, problem: ContactProblem, start: np.ndarray) -> StateType:
        """The solution from a given pressure, which need not be feasible.  Collective."""
        raise NotImplementedError

    def energy(self, state: StateType, size: int) -> float:
        """½⟨p, Gp⟩ per point, on a grid of `size` points."""
        raise NotImplementedError

    def coarsest(self, problem: ContactProblem, exact: bool) -> StateType:
        """The solution without a coarser grid.  Collective."""
        raise NotImplementedError

    def prolong(self, coarse: Coarse, found: StateType, problem: ContactProblem) -> tuple[StateType, bool]:
        """The state with which the finer grid starts, and whether that is its solution.  Collective."""
        raise NotImplementedError

    def relax(self, problem: ContactProblem, state: StateType, exact: bool = True) -> StateType:
        """Iterates from that state, which is overwritten.  Collective.  Raises SolverError."""
        raise NotImplementedError

    def watch(self, problem: ContactProblem) -> Callable[[StateType], None] | None:
        """The monitor of one grid."""
        monitor = self.monitor
        return None if monitor is None else lambda state: monitor(problem.grid, state)
