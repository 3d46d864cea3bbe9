"""Nested iteration by active sets: what starts on each grid, and what can be answered at once.

`solve_hard_wall` is the solver that the rest of the program calls.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from pgfmd.errors import SolverError, Uncertifiable
from pgfmd.grid import kernels
from pgfmd.grid.transfer import Interpolation
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.active_set import kernels as set_kernels
from pgfmd.solvers.active_set.active_set import State
from pgfmd.solvers.active_set.descent import Descent
from pgfmd.solvers.active_set.dual import GapSteps
from pgfmd.solvers.active_set.feasible import carry
from pgfmd.solvers.active_set.primal import PressureSteps
from pgfmd.solvers.cost import GAPS_FROM
from pgfmd.solvers.nested_iteration import Coarse, NestedIteration
from pgfmd.solvers.nondimensional import Dimensionless
from pgfmd.solvers.solution import ContactSolution, Monitor

PRESSED = 6.0  # full contact is tried before coarse grids if p̄ is this many times the lower bound of the rms of Kh


def solve_hard_wall(
    problem: ContactProblem,
    tolerance: float = 1e-8,
    start: np.ndarray | None = None,
    monitor: Monitor | None = None,
    overwrite_heights: bool = False,
) -> ContactSolution:
    """Pressure and gap of a frictionless contact with a hard wall, or one of limited hardness, at the imposed mean
    pressure, to a certified relative energy error.  Collective.

    start: a pressure (nx_local, ny) ≥ 0 from a neighbouring load to begin with, instead of coarse grids.  monitor:
    called after each outer step.  overwrite_heights: their memory is used, and they are lost.
    Raises InputError for what is out of range, SolverError if the tolerance cannot be reached.
    """
    nested, grid = ActiveSetIteration(tolerance, monitor), problem.grid
    units = Dimensionless(problem, overwrite_heights=overwrite_heights)
    if units.uniform is not None:
        return units.uniform
    scaled = units.problem
    if start is None:
        state, extra = nested.solve(scaled)
    else:
        state, extra = _full_contact(scaled) or nested.relax(scaled, _begin(scaled, start)), 0.0
    return units.solution(state, state.energy / grid.size, tolerance, extra)


def _begin(problem: ContactProblem, start: np.ndarray) -> State:
    """The state of a given pressure, made feasible.  Collective."""
    grid, top = problem.grid, problem.law.highest
    state = State(np.minimum(start * (problem.load / grid.reduction.sum(start)), top), -problem.heights)
    fields = state.pressure, state.gap
    carry(grid, fields, problem.load, top, problem.solid.contact_modulus / max(grid.spacing))
    state.between = int(grid.reduction.sum((state.pressure > 0) & (state.pressure < top)))
    return state


def _full_contact(problem: ContactProblem, margin: float = 1.0) -> State | None:
    """The state of full contact, p = p̄ + Kh, or None if that is beyond a bound somewhere.  Collective.

    It is not tried, and the answer is None, if p̄ is below `margin` times a lower bound of the rms of Kh.
    """
    grid, heights, mean_pressure = problem.grid, problem.heights, problem.mean_pressure
    if mean_pressure < margin * _least_deviation(problem):
        return None
    pressure = np.empty(grid.local_shape)

    def fill(first: int, stop: int, rows: np.ndarray) -> None:
        rows[...] = heights[first:stop]

    def drain(first: int, stop: int, rows: np.ndarray) -> None:
        pressure[first:stop] = rows

    grid.convolve(fill, problem.solid.apply_stiffness(grid, np.float64, 1 / grid.size), drain)
    energy = grid.reduction.dot(pressure, heights) / 2  # without the mean pressure, which may be far larger
    pressure += mean_pressure
    if grid.reduction.min(pressure) < 0 or grid.reduction.max(pressure) > problem.law.highest:
        return None
    gap = np.zeros(grid.local_shape)
    return State(pressure, gap, True, 0.0, energy, 0.0, contact=grid.size, between=grid.size)


def _least_deviation(problem: ContactProblem) -> float:
    """A lower bound of the rms of Kh from differences of heights along y: |q| ≥ 2 |sin(q_y a/2)|/a.  Collective."""
    grid, heights = problem.grid, problem.heights
    parts = grid.threads.collect(lambda a, b: kernels.squares_of_steps(heights[a:b]), grid.local_shape[0])
    q = np.geomspace(2 * np.pi / max(grid.lengths), 2 * np.pi / min(grid.spacing))
    factor = np.min(problem.solid.stiffness(q) / q)
    return factor * np.sqrt(grid.reduction.sum(parts) / grid.size) / grid.spacing[1]


class ActiveSetIteration(NestedIteration[State]):
    """Nested iteration by active sets."""

    def at_once(self, problem: ContactProblem) -> State | None:
        """Full contact, where the load may well bring it about."""
        return _full_contact(problem, PRESSED)

    def coarsest(self, problem: ContactProblem, exact: bool) -> State:
        """From a uniform pressure."""
        if (state := _full_contact(problem)) is not None:
            return state
        shape = problem.grid.local_shape
        return self.relax(problem, State(np.full(shape, problem.mean_pressure), np.empty(shape)), exact)

    def prolong(self, coarse: Coarse, found: State, problem: ContactProblem) -> tuple[State, bool]:
        """Full contact and True, if both grids have it; else a start from the coarse state and False."""
        full = _full_contact(problem) if found.between == coarse.place.size else None
        return (full, True) if full is not None else (_prolong(coarse, found, problem), False)

    def relax(self, problem: ContactProblem, state: State, exact: bool = True) -> State:
        """Relaxes a state with pressures or gaps as unknowns, whichever cost less (`GAPS_FROM`); if the error stops
        falling, by steps that lower the energy each time.  Collective.
        """
        by_gaps = problem.law.highest == np.inf and state.between > GAPS_FROM * problem.grid.size
        steps = GapSteps if by_gaps else PressureSteps
        solver = steps(problem, exact)
        if state.estimated:
            solver.begin(state)
        try:
            state = solver.relax(state, self.tolerance, self.watch(problem))
        except Uncertifiable:
            raise
        except SolverError:
            solver.free()
            solver, state.opened = Descent(problem, exact), False
            state = solver.relax(state, self.tolerance, self.watch(problem))
        solver.free()
        return state


def _prolong(coarse: Coarse, found: State, problem: ContactProblem) -> State:
    """The state with which the finer grid starts.  Collective.

    A point is in contact if the interpolated pressure, acting on one coarse pixel, displaces it by more than the gap
    to the fine heights.  In contact, roughness that only the finer grid resolves adds to the pressure
    (`set_kernels.start_rows`).  So the edge of a patch is right to a fraction of a coarse pixel.
    """
    grid, top = problem.grid, problem.law.highest
    found.gap -= found.level
    interpolation = Interpolation(coarse.place, grid, [found.pressure, found.gap, coarse.heights])
    compliance = max(coarse.place.spacing) / problem.solid.contact_modulus
    pressure, gap = np.empty(grid.local_shape), np.empty(grid.local_shape)

    def begin(thread: int, first: int, stop: int) -> None:
        rows, read = slice(first, stop), partial(interpolation.rows, first=first, stop=stop, thread=thread)
        fields = read(0), read(1), read(2)
        set_kernels.start_rows(fields, problem.heights[rows], compliance, pressure[rows], gap[rows])

    grid.threads.share(begin, grid.local_shape[0], grid.band)
    carry(grid, (pressure, gap), problem.load, top, 1 / compliance)
    return State(pressure, gap, estimated=True, between=round(found.between / coarse.place.size * grid.size))
