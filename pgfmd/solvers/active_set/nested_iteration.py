"""Nested iteration for the hard wall: solve coarse grids first, each a quarter of the work of the next, and start
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
from pgfmd.solvers.active_set.active_set import INNER_REDUCTION, State
from pgfmd.solvers.active_set.dual import GapSteps
from pgfmd.solvers.active_set.primal import PressureSteps
from pgfmd.solvers.nondimensional import Dimensionless
from pgfmd.solvers.solution import ContactSolution

COARSEST = 32  # points of the shorter side below which coarser grids bring nothing
FLAT = 1e-2  # rms height of a coarse grid, over that of the surface, below which it has nothing to say
PRESSED = 6.0  # times a bound of the rms pressure at full contact: loads that may well bring it about
MOSTLY = 0.45  # share of points in contact above which the others are the better unknowns
COARSE_TOLERANCE = 2e-3  # certified error of coarse grids, unless their solver knows better (`Relaxation.goal`)

Monitor = Callable[[SlabGrid, State], None]


def solve_hard_wall(
    problem: ContactProblem,
    tolerance: float = 1e-6,
    start: np.ndarray | None = None,
    monitor: Monitor | None = None,
    overwrite_heights: bool = False,
) -> ContactSolution:
    """Pressure and gap of a hard, frictionless contact at the imposed mean pressure, to a certified relative energy
    error.  Collective.

    start: a pressure (nx_local, ny) from a neighbouring load to begin with, instead of coarse grids.  monitor: called
    after each outer step.  overwrite_heights: use their memory, for heights that nobody needs afterwards.  Raises
    InputError for what is out of range, SolverError if the tolerance cannot be reached.
    """
    units = Dimensionless(problem, overwrite_heights=overwrite_heights)
    if units.uniform is not None:
        return units.uniform
    scaled, grid, extra = units.problem, problem.grid, 0.0
    if start is None:
        state, extra = _cascade(scaled, tolerance, monitor)
    elif (state := _full_contact(scaled)) is None:
        contact = grid.reduction.sum(np.count_nonzero(start)) / grid.size
        state = State(start * (scaled.load / grid.reduction.sum(start)), np.empty(grid.local_shape))
        state = _relax(scaled, state, tolerance, monitor, contact)
    return units.solution(state, state.energy / grid.size, tolerance, extra)


def _full_contact(problem: ContactProblem, margin: float = 1.0) -> State | None:
    """The exact answer p = p̄ + Kh, if that is nowhere negative.  Collective.

    The rms value of Kh takes half a transform, and only a load above it is worth the other half; differences along y,
    which are free, bound it from below.  A load less than `margin` times that bound is not looked at.
    """
    grid, heights, load = problem.grid, problem.heights, problem.mean_pressure
    if load < margin * _least_deviation(problem):
        return None
    squares = []
    action = problem.solid.apply_stiffness(grid, np.float64, 1.0)

    def measure(block: np.ndarray, first: int, stop: int):
        action(block, first, stop)
        squares.append(float(np.sum(grid.hermitian_weight[first:stop] * np.abs(block) ** 2)))

    def fill(first: int, stop: int, rows: np.ndarray):
        rows[...] = heights[first:stop]

    grid.read_spectrum(fill, measure)
    deviation = np.sqrt(grid.reduction.sum(squares)) / grid.size
    if load < deviation:
        return None
    pressure = np.empty(grid.local_shape)

    def drain(first: int, stop: int, rows: np.ndarray):
        np.divide(rows, grid.size, out=pressure[first:stop])

    grid.convolve(fill, action, drain)
    energy = grid.reduction.dot(pressure, heights) / 2  # before the mean pressure, which may be far larger, is added
    pressure += load
    if grid.reduction.min(pressure) < 0:
        return None
    return State(pressure, np.zeros(grid.local_shape), 0.0, energy, 0.0, grid.size)


def _least_deviation(problem: ContactProblem) -> float:
    """A lower bound of the rms value of Kh, as |q| ≥ 2 sin(q_y a/2)/a.  Collective."""
    grid, heights = problem.grid, problem.heights
    parts = grid.threads.collect(lambda a, b: kernels.squares_of_steps(heights[a:b]), grid.local_shape[0])
    q = np.geomspace(2 * np.pi / max(grid.lengths), 2 * np.pi / min(grid.spacing))
    factor = np.min(problem.solid.stiffness(q) / q)
    return factor * np.sqrt(grid.reduction.sum(parts) / grid.size) / grid.spacing[1]


def _relax(
    problem: ContactProblem,
    state: State,
    tolerance: float,
    monitor: Monitor | None,
    contact: float,
    exact: bool = True,
) -> State:
    """Relax a state of which about the share `contact` of all points touch.  Collective."""
    steps = GapSteps if contact > MOSTLY else PressureSteps
    solver = steps(problem, exact)
    if steps is GapSteps and state.energy > 0:  # the coarse grid's gap is better than any that its pressure makes
        solver.improve(state, INNER_REDUCTION, tolerance, np.float32)
    seen = None if monitor is None else lambda state: monitor(problem.grid, state)
    state = solver.relax(state, tolerance, seen)
    solver.free()
    return state


def _cascade(
    problem: ContactProblem, tolerance: float, monitor: Monitor | None, exact: bool = True
) -> tuple[State, float]:
    """Solve this grid from the next coarser one.  Returns the state and the transforms spent on coarser grids,
    weighted by size.
    """
    grid = problem.grid
    if (state := _full_contact(problem, PRESSED)) is not None:
        return state, 0.0
    coarse = _coarser(problem)
    if coarse is None:
        if (state := _full_contact(problem)) is None:
            state = State(np.full(grid.local_shape, problem.mean_pressure), np.empty(grid.local_shape))
            state = _relax(problem, state, tolerance, monitor, 0.0, exact)
        return state, 0.0
    found, extra = _cascade(coarse, COARSE_TOLERANCE, monitor, False)
    contact, iterations = found.contact / coarse.grid.size, found.iterations
    state = full = _full_contact(problem) if contact == 1 else None
    if full is None:
        state = _prolong(coarse, found, problem)
    extra = (extra + coarse.grid.transforms) * coarse.grid.size / grid.size
    coarse.grid.free()
    del found, coarse
    if full is None:
        state = _relax(problem, state, tolerance, monitor, contact, exact)
    state.iterations += iterations
    return state, extra


def _coarser(problem: ContactProblem) -> ContactProblem | None:
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
    interpolated gap.

    So the fine heights decide near the edge of a patch, which comes out to a fraction of a coarse pixel.  Inside,
    linear interpolation would miss up to 8 % of a wave of eight coarse pixels.
    """
    grid, heights, load = problem.grid, problem.heights, problem.mean_pressure
    displacement = found.gap  # whose memory is not needed any more
    displacement += coarse.heights
    displacement -= found.level
    interpolation = Interpolation(coarse.grid, grid, [displacement, found.pressure])
    reach = max(coarse.grid.spacing) / problem.solid.contact_modulus
    pressure, gap = np.empty(grid.local_shape), np.empty(grid.local_shape)
    gaps_matter = found.contact > MOSTLY * coarse.grid.size

    sums = np.empty((-(-grid.local_shape[0] // grid.band), 2))

    def begin(thread: int, first: int, stop: int):
        rows, (u, p) = slice(first, stop), (interpolation.rows(which, first, stop, thread) for which in (0, 1))
        sums[first // grid.band] = kernels.start_rows(p, u, heights[rows], reach, pressure[rows])
        if gaps_matter:
            kernels.start_gap(pressure[rows], u, heights[rows], gap[rows])

    grid.threads.share(begin, grid.local_shape[0], grid.band)
    total, count = grid.reduction.sums(*sums.sum(axis=0))
    if total > 1e-200 * count and count:
        grid.threads.scale(pressure, load * grid.size / total)
    else:  # the coarse grid says nothing about this one
        pressure[...] = load
    return State(pressure, gap, energy=found.energy * grid.size / coarse.grid.size if gaps_matter else 0.0)
