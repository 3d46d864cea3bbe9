"""Nested iteration for the active set: solve coarse grids first, each a quarter of the work of the next, and start
from them.

`solve_hard_wall` is the solver that the rest of the program calls.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pgfmd.grid import kernels
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.transfer import Interpolation, restrict
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.active_set import kernels as set_kernels
from pgfmd.solvers.active_set.active_set import State
from pgfmd.solvers.active_set.dual import GapSteps
from pgfmd.solvers.active_set.feasible import carry
from pgfmd.solvers.active_set.primal import PressureSteps
from pgfmd.solvers.nondimensional import Dimensionless
from pgfmd.solvers.solution import ContactSolution

COARSEST = 32  # points of the shorter side below which coarser grids bring nothing
FLAT = 1e-2  # rms height of a coarse grid, over that of the surface, below which its contact is another one
PRESSED = 6.0  # times a bound of the rms pressure at full contact: loads that may well bring it about
MOSTLY = 0.45  # share of points with a pressure between its bounds above which the others are the better unknowns

Monitor = Callable[[SlabGrid, State], None]


def solve_hard_wall(
    problem: ContactProblem,
    tolerance: float = 1e-8,
    start: np.ndarray | None = None,
    monitor: Monitor | None = None,
    overwrite_heights: bool = False,
) -> ContactSolution:
    """Pressure and gap of a frictionless contact, hard or of limited pressure, at the imposed mean pressure, to a
    certified relative energy error.  Collective.

    start: a pressure (nx_local, ny) ≥ 0 from a neighbouring load to begin with, instead of coarse grids.  monitor:
    called after each outer step.  overwrite_heights: use their memory, for heights that nobody needs afterwards.
    Raises InputError for what is out of range, SolverError if the tolerance cannot be reached.
    """
    units = Dimensionless(problem, overwrite_heights=overwrite_heights)
    if units.uniform is not None:
        return units.uniform
    levels, scaled, grid = NestedIteration(tolerance, monitor), units.problem, problem.grid
    if start is None:
        state, extra = levels.solve(scaled)
    else:
        state, extra = _full_contact(scaled) or levels.relax(scaled, _begin(scaled, start)), 0.0
    return units.solution(state, state.energy / grid.size, tolerance, extra)


def _begin(problem: ContactProblem, start: np.ndarray) -> State:
    """The state of a given pressure, made feasible.  Collective."""
    grid, top = problem.grid, problem.law.highest
    pressure = np.minimum(start * (problem.load / grid.reduction.sum(start)), top)
    if not carry(grid, pressure, problem.load, top):
        pressure[...] = problem.mean_pressure
    between = int(grid.reduction.sum((pressure > 0) & (pressure < top)))
    return State(pressure, np.empty(grid.local_shape), between=between)


def _full_contact(problem: ContactProblem, margin: float = 1.0) -> State | None:
    """The exact answer p = p̄ + Kh, if that is nowhere beyond a bound.  Collective.

    The rms value of Kh takes half a transform, and only a load above it is worth the other half; differences along y,
    which are free, bound it from below.  A load less than `margin` times that bound is not looked at.
    """
    grid, heights, load = problem.grid, problem.heights, problem.mean_pressure
    if load < margin * _least_deviation(problem):
        return None
    squares = []
    action = problem.solid.apply_stiffness(grid, np.float64, 1.0)

    def measure(block: np.ndarray, first: int, stop: int) -> None:
        action(block, first, stop)
        squares.append(float(np.sum(grid.hermitian_weight[first:stop] * np.abs(block) ** 2)))

    def fill(first: int, stop: int, rows: np.ndarray) -> None:
        rows[...] = heights[first:stop]

    grid.read_spectrum(fill, measure)
    deviation = np.sqrt(grid.reduction.sum(squares)) / grid.size
    if load < deviation:
        return None
    pressure = np.empty(grid.local_shape)

    def drain(first: int, stop: int, rows: np.ndarray) -> None:
        np.divide(rows, grid.size, out=pressure[first:stop])

    grid.convolve(fill, action, drain)
    energy = grid.reduction.dot(pressure, heights) / 2  # before the mean pressure, which may be far larger, is added
    pressure += load
    if grid.reduction.min(pressure) < 0 or grid.reduction.max(pressure) > problem.law.highest:
        return None
    gap = np.zeros(grid.local_shape)
    return State(pressure, gap, True, 0.0, energy, 0.0, contact=grid.size, between=grid.size)


def _least_deviation(problem: ContactProblem) -> float:
    """A lower bound of the rms value of Kh, as |q| ≥ 2 sin(q_y a/2)/a.  Collective."""
    grid, heights = problem.grid, problem.heights
    parts = grid.threads.collect(lambda a, b: kernels.squares_of_steps(heights[a:b]), grid.local_shape[0])
    q = np.geomspace(2 * np.pi / max(grid.lengths), 2 * np.pi / min(grid.spacing))
    factor = np.min(problem.solid.stiffness(q) / q)
    return factor * np.sqrt(grid.reduction.sum(parts) / grid.size) / grid.spacing[1]


class NestedIteration:
    """Solves a problem on its grid from the next coarser one."""

    def __init__(self, tolerance: float, monitor: Monitor | None) -> None:
        self.tolerance, self.monitor = tolerance, monitor

    def relax(self, problem: ContactProblem, state: State, exact: bool = True) -> State:
        """Relax a state, by the unknowns that are fewer in it.  Collective."""
        steps = GapSteps if state.between > MOSTLY * problem.grid.size else PressureSteps
        solver = steps(problem, exact)
        seen = None if self.monitor is None else lambda state: self.monitor(problem.grid, state)
        state = solver.relax(state, self.tolerance, seen)
        solver.free()
        return state

    def solve(self, problem: ContactProblem, exact: bool = True) -> tuple[State, float]:
        """The solution, and the transforms spent on coarser grids, weighted by size.  Collective."""
        grid = problem.grid
        if (state := _full_contact(problem, PRESSED)) is not None:
            return state, 0.0
        coarse = self.coarser(problem)
        if coarse is None:
            if (state := _full_contact(problem)) is None:
                state = State(np.full(grid.local_shape, problem.mean_pressure), np.empty(grid.local_shape))
                state = self.relax(problem, state, exact)
            return state, 0.0
        found, extra = self.solve(coarse, False)
        iterations = found.iterations
        state = full = _full_contact(problem) if found.between == coarse.grid.size else None
        if full is None:
            state = _prolong(coarse, found, problem)
        extra = (extra + coarse.grid.transforms) * coarse.grid.size / grid.size
        coarse.grid.free()
        del found, coarse
        if full is None:
            state = self.relax(problem, state, exact)
        state.iterations += iterations
        return state, extra

    def coarser(self, problem: ContactProblem) -> ContactProblem | None:
        """The problem on the next coarser grid, if its answer is a start.  Collective."""
        if min(problem.grid.shape) <= COARSEST:
            return None
        coarse = problem.grid.coarse()
        heights = restrict(problem.grid, coarse, problem.heights, np.float32)
        if coarse.reduction.dot(heights, heights) < FLAT**2 * coarse.size:
            return None
        return problem.on(coarse, heights)


def _prolong(coarse: ContactProblem, found: State, problem: ContactProblem) -> State:
    """Start on the finer grid: contact is where the coarse pressure, over one coarse pixel, would close the
    interpolated gap; there, roughness that only the finer grid has adds to the pressure (`set_kernels.start_rows`).

    So the fine heights decide near the edge of a patch, which comes out to a fraction of a coarse pixel.  Inside,
    linear interpolation would miss up to 8 % of a wave of eight coarse pixels.
    """
    grid, top = problem.grid, problem.law.highest
    found.gap -= found.level
    interpolation = Interpolation(coarse.grid, grid, [found.pressure, found.gap, coarse.heights])
    reach = max(coarse.grid.spacing) / problem.solid.contact_modulus
    pressure, gap = np.empty(grid.local_shape), np.empty(grid.local_shape)

    def begin(thread: int, first: int, stop: int) -> None:
        rows, fields = slice(first, stop), (interpolation.rows(which, first, stop, thread) for which in range(3))
        set_kernels.start_rows(*fields, problem.heights[rows], reach, pressure[rows], gap[rows])

    grid.threads.share(begin, grid.local_shape[0], grid.band)
    if not carry(grid, pressure, problem.load, top):
        pressure[...] = problem.mean_pressure
    state = State(pressure, gap, found.between > MOSTLY * coarse.grid.size)
    state.between = round(found.between / coarse.grid.size * grid.size)
    if state.opened:
        grid.threads.deal(lambda a, b: set_kernels.open_rows(pressure, gap, 0.0, top, a, b), len(gap))
    return state
