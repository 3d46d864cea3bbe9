"""The exponential wall at imposed load: Newton's method on a cascade of grids.

`solve_exponential_wall` solves coarse grids first, the coarsest with ζ reduced step by step.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np

from pgfmd.errors import SolverError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.transfer import Interpolation, restrict
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.exponential_wall import kernels
from pgfmd.solvers.exponential_wall.newton import Newton
from pgfmd.solvers.nondimensional import Dimensionless
from pgfmd.solvers.relaxation import WallState
from pgfmd.solvers.solution import ContactSolution, Monitor

COARSEST = 32  # points of the shorter side below which coarser grids bring nothing
COARSE_TOLERANCE = 3e-3  # certified error asked of a coarse grid: discretisation errors are larger
FLAT = 1e-2  # rms height of a coarse grid over that of the surface, below which its solution is no good start
LOOSE, REDUCTION = 0.1, 4  # certified error and factor between the steps of a ζ continuation


def solve_exponential_wall(
    problem: ContactProblem,
    tolerance: float = 1e-6,
    start: np.ndarray | None = None,
    monitor: Monitor | None = None,
    overwrite_heights: bool = False,
) -> ContactSolution:
    """Contact under an exponential wall, to a certified relative energy error.  Collective.

    start: a pressure (nx_local, ny) from a neighbouring load to begin with, instead of coarse grids.  monitor: called
    after each outer step.  overwrite_heights: use their memory.  Raises InputError for what is out of range,
    SolverError if the tolerance cannot be reached.
    """
    units = Dimensionless(problem, overwrite_heights=overwrite_heights)
    if units.uniform is not None:
        return units.uniform
    if start is None:
        state, extra = _cascade(units.problem, tolerance, monitor)
    else:
        state, extra = _relax(units.problem, _feasible(problem.grid, start), tolerance, monitor), 0.0
    return units.solution(state, state.work / 2, tolerance, extra)


def _relax(problem: ContactProblem, state: WallState, tolerance: float, monitor: Monitor | None) -> WallState:
    """Newton from that state; should it fail, by continuation in ζ from a uniform pressure.  Collective."""
    try:
        return Newton(problem).relax(state, tolerance, _watch(problem, monitor))
    except SolverError:
        if state.error <= LOOSE:
            raise
    state.pressure[...] = 1.0
    return _continue(problem, state, tolerance, monitor)


def _continue(problem: ContactProblem, state: WallState, tolerance: float, monitor: Monitor | None) -> WallState:
    """From ζ = rms height, where a few steps suffice from any start, down to the wall's own.  Collective."""
    solver = Newton(problem)
    steps = max(0, math.ceil(math.log(1 / solver.zeta, REDUCTION)))
    for power in range(steps, 0, -1):
        Newton(problem.with_law(solver.law.softer(REDUCTION**power))).relax(state, LOOSE)
    return solver.relax(state, tolerance, _watch(problem, monitor))


def _watch(problem: ContactProblem, monitor: Monitor | None) -> Callable[[WallState], None] | None:
    return None if monitor is None else partial(monitor, problem.grid)


def _cascade(problem: ContactProblem, tolerance: float, monitor: Monitor | None) -> tuple[WallState, float]:
    """Solve from the next coarser grid on.  Returns also the transforms of those, by size.  Collective."""
    grid = problem.grid
    coarse = _coarser(problem)
    if coarse is None:
        state = WallState(np.ones(grid.local_shape), np.empty(grid.local_shape))
        return _continue(problem, state, tolerance, monitor), 0.0
    found, extra = _cascade(coarse, max(tolerance, COARSE_TOLERANCE), monitor)
    state = _prolong(coarse, found, problem)
    extra = (extra + coarse.grid.transforms) * coarse.grid.size / grid.size
    coarse.grid.free()
    return _relax(problem, state, tolerance, monitor), extra


def _coarser(problem: ContactProblem) -> ContactProblem | None:
    """The problem on the next coarser grid, if its answer is a start.  Collective."""
    if min(problem.grid.shape) <= COARSEST:
        return None
    coarse = problem.grid.coarse()
    heights = restrict(problem.grid, coarse, problem.heights)
    if coarse.reduction.dot(heights, heights) < FLAT**2 * coarse.size:
        return None
    return problem.on(coarse, heights)


def _prolong(coarse: ContactProblem, found: WallState, problem: ContactProblem) -> WallState:
    """Start on the finer grid: its wall answers to the interpolated displacement and pressure.  Collective."""
    grid, heights = problem.grid, problem.heights
    interpolation = Interpolation(coarse.grid, grid, [found.gap + coarse.heights, found.pressure])
    target = np.empty(grid.local_shape)
    solver = Newton(problem)

    def part(thread: int, first: int, stop: int) -> None:
        displacement, pressure = (interpolation.rows(which, first, stop, thread) for which in (0, 1))
        kernels.start_rows(pressure, displacement, heights[first:stop], solver.alpha, target[first:stop])

    grid.threads.share(part, grid.local_shape[0], grid.band)
    state = WallState(np.empty(grid.local_shape), np.empty(grid.local_shape), level=found.level)
    state.iterations = found.iterations
    solver.respond(state, target, solver.alpha)
    return state


def _feasible(grid: SlabGrid, pressure: np.ndarray) -> WallState:
    """The state of a given pressure, scaled to the load.  Collective."""
    return WallState(pressure * (grid.size / grid.reduction.sum(pressure)), np.empty(grid.local_shape))
