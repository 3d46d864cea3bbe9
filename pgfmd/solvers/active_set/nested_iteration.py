"""Nested iteration for the hard wall: solve coarse grids first, each a quarter of the work of the next, and start
from them.

`solve_hard_wall` is the solver that the rest of the program calls; it makes heights dimensionless, answers what needs
no iteration, runs the levels and gives physical quantities back.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from pgfmd.grid import kernels
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.transfer import Interpolation, restrict
from pgfmd.physics.elasticity import Elasticity
from pgfmd.solvers import nondimensional
from pgfmd.solvers.active_set.active_set import INNER_REDUCTION, State
from pgfmd.solvers.active_set.dual import GapSteps
from pgfmd.solvers.active_set.primal import PressureSteps
from pgfmd.solvers.solution import ContactSolution

COARSEST = 32  # points of the shorter side below which coarser grids bring nothing
FLAT = 1e-2  # rms height of a coarse grid, over that of the surface, below which it has nothing to say
PRESSED = 6.0  # times a bound of the rms pressure at full contact: loads that may well bring it about
MOSTLY = 0.45  # share of points in contact above which the others are the better unknowns
COARSE_TOLERANCE = 2e-3  # certified error of coarse grids, unless their solver knows better (`Relaxation.goal`)


def solve_hard_wall(
    grid: SlabGrid,
    heights: np.ndarray,
    mean_pressure: float,
    elasticity: Elasticity,
    tolerance: float = 1e-6,
    start: np.ndarray | None = None,
    monitor: Callable[[SlabGrid, State], None] | None = None,
    overwrite_heights: bool = False,
) -> ContactSolution:
    """Pressure and gap of a hard, frictionless contact at the imposed mean pressure, to a certified relative energy
    error.  Collective.

    heights: (nx_local, ny) in units of length, of any offset and size.  start: a pressure (nx_local, ny) from a
    neighbouring load to begin with, instead of coarse grids.  monitor: called after each outer step.
    overwrite_heights: use their memory, for heights that nobody needs afterwards.  Raises SolverError if the tolerance
    cannot be reached.
    """
    began, transforms = time.perf_counter(), grid.transforms
    reduce = grid.reduction
    heights, height = nondimensional.dimensionless(grid, heights, mean_pressure, elasticity, overwrite_heights)
    unit = elasticity.contact_modulus * (height or 1.0) / min(grid.spacing)  # of pressure
    scaled = _Scaled(elasticity, unit / (height or 1.0))
    if mean_pressure == 0 or height == 0:  # nothing touches, or everything does
        pressure = np.full(grid.local_shape, float(mean_pressure))
        highest = reduce.max(heights) * height
        gap = highest - heights * height
        return ContactSolution(
            pressure, gap, mean_pressure, highest, 0.0, 0.0, 0.0, 0, 0.0, time.perf_counter() - began
        )
    load = mean_pressure / unit
    extra = 0.0
    if start is None:
        state, extra = _cascade(grid, heights, scaled, load, tolerance, monitor)
    elif (state := _full_contact(grid, heights, scaled, load)) is None:
        contact = reduce.sum(np.count_nonzero(start)) / grid.size
        state = State(start / unit, np.empty(grid.local_shape))
        np.maximum(state.pressure, 0, out=state.pressure)
        state.pressure *= load * grid.size / reduce.sum(state.pressure)
        state = _relax(grid, heights, scaled, load, state, tolerance, monitor, contact)

    def finish(first: int, stop: int) -> float:
        return kernels.finish_rows(state.pressure[first:stop], state.gap[first:stop], state.level, unit, height)

    violation = reduce.max(grid.threads.collect(finish, grid.local_shape[0]))
    return ContactSolution(
        pressure=state.pressure,
        gap=state.gap,
        mean_pressure=mean_pressure,
        mean_gap=-state.level * height,
        elastic_energy=state.energy / grid.size * unit * height,
        certified_error=state.error,
        max_violation=violation,
        iterations=state.iterations,
        transforms=grid.transforms - transforms + extra,
        seconds=time.perf_counter() - began,
    )


class _Scaled:
    """The elastic response in dimensionless quantities: displacement in rms heights per pressure in `pressure_unit`."""

    def __init__(self, elasticity: Elasticity, factor: float):
        self.elasticity, self.factor = elasticity, factor

    def apply_compliance(self, grid: SlabGrid, dtype, factor: float):
        return self.elasticity.apply_compliance(grid, dtype, factor * self.factor)

    def apply_stiffness(self, grid: SlabGrid, dtype, factor: float):
        return self.elasticity.apply_stiffness(grid, dtype, factor / self.factor)

    def stiffness(self, q: np.ndarray) -> np.ndarray:
        return self.elasticity.stiffness(q) / self.factor

    def compliance(self, q: np.ndarray) -> np.ndarray:
        return self.elasticity.compliance(q) * self.factor

    def half_space_compliance(self, q: np.ndarray) -> np.ndarray:
        return 1 / self.half_space_stiffness(q)

    def half_space_stiffness(self, q: np.ndarray) -> np.ndarray:
        return 0.5 * self.elasticity.contact_modulus * q / self.factor


def _full_contact(
    grid: SlabGrid, heights: np.ndarray, scaled: _Scaled, load: float, margin: float = 1.0
) -> State | None:
    """The exact answer p = p̄ + Kh, if that is nowhere negative.  Collective.

    The rms value of Kh takes half a transform, and only a load above it is worth the other half; differences along y,
    which are free, bound it from below.  A load less than `margin` times that bound is not looked at.
    """
    if load < margin * _least_deviation(grid, heights, scaled):
        return None
    squares = []
    action = scaled.apply_stiffness(grid, np.float64, 1.0)

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
        np.add(rows, load * grid.size, out=pressure[first:stop])

    grid.convolve(fill, action, drain)
    pressure /= grid.size
    if grid.reduction.min(pressure) < 0:
        return None
    energy = grid.reduction.dot(pressure, heights) / 2
    return State(pressure, np.zeros(grid.local_shape), 0.0, energy, 0.0, grid.size)


def _least_deviation(grid: SlabGrid, heights: np.ndarray, scaled: _Scaled) -> float:
    """A lower bound of the rms value of Kh, as |q| ≥ 2 sin(q_y a/2)/a.  Collective."""

    parts = grid.threads.collect(lambda a, b: kernels.squares_of_steps(heights[a:b]), grid.local_shape[0])
    q = np.geomspace(2 * np.pi / max(grid.lengths), 2 * np.pi / min(grid.spacing))
    factor = np.min(scaled.stiffness(q) / q)
    return factor * np.sqrt(grid.reduction.sum(parts) / grid.size) / grid.spacing[1]


def _relax(grid, heights, scaled, load, state, tolerance, monitor, contact: float, exact: bool = True) -> State:
    """Relax a state of which about the share `contact` of all points touch.  Collective."""
    steps = GapSteps if contact > MOSTLY else PressureSteps
    solver = steps(grid, heights, scaled, load * grid.size, exact)
    if steps is GapSteps and state.energy > 0:  # the coarse grid's gap is better than any that its pressure makes
        solver.improve(state, INNER_REDUCTION, tolerance, np.float32)
    seen = None if monitor is None else lambda state: monitor(grid, state)
    state = solver.relax(state, tolerance, seen)
    solver.free()
    return state


def _cascade(grid, heights, scaled, load, tolerance, monitor, exact: bool = True) -> tuple[State, float]:
    """Solve this grid from the next coarser one.  Returns the state and the transforms spent on coarser
    grids, weighted by size.
    """
    if (state := _full_contact(grid, heights, scaled, load, PRESSED)) is not None:
        return state, 0.0
    coarse, coarse_heights = _coarser(grid, heights)
    if coarse is None:
        if (state := _full_contact(grid, heights, scaled, load)) is None:
            state = State(np.full(grid.local_shape, load), np.empty(grid.local_shape))
            state = _relax(grid, heights, scaled, load, state, tolerance, monitor, 0.0, exact)
        return state, 0.0
    found, extra = _cascade(coarse, coarse_heights, scaled, load, COARSE_TOLERANCE, monitor, False)
    contact, iterations = found.contact / coarse.size, found.iterations
    state = full = _full_contact(grid, heights, scaled, load) if contact == 1 else None
    if full is None:
        state = _prolong(coarse, found, coarse_heights, grid, heights, load, scaled)
    extra = (extra + coarse.transforms) * coarse.size / grid.size
    coarse.free()
    del found, coarse_heights
    if full is None:
        state = _relax(grid, heights, scaled, load, state, tolerance, monitor, contact, exact)
    state.iterations += iterations
    return state, extra


def _coarser(grid: SlabGrid, heights: np.ndarray) -> tuple[SlabGrid | None, np.ndarray | None]:
    """The next coarser grid and its heights, if it has something to say.  Collective."""
    if min(grid.shape) <= COARSEST:
        return None, None
    coarse = grid.coarse()
    coarse_heights = restrict(grid, coarse, heights, np.float32)
    if coarse.reduction.dot(coarse_heights, coarse_heights) < FLAT**2 * coarse.size:
        return None, None
    return coarse, coarse_heights


def _prolong(coarse, found: State, coarse_heights, grid: SlabGrid, heights, load, scaled: _Scaled) -> State:
    """Start on the finer grid: contact is where the coarse pressure, over one coarse pixel, would close the
    interpolated gap.

    So the fine heights decide near the edge of a patch, which comes out to a fraction of a coarse pixel.  Inside,
    linear interpolation would miss up to 8 % of a wave of eight coarse pixels.
    """
    displacement = found.gap  # whose memory is not needed any more
    displacement += coarse_heights
    displacement -= found.level
    interpolation = Interpolation(coarse, grid, [displacement, found.pressure])
    reach = max(coarse.spacing) * scaled.factor / scaled.elasticity.contact_modulus
    pressure, gap = np.empty(grid.local_shape), np.empty(grid.local_shape)
    gaps_matter = found.contact > MOSTLY * coarse.size

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
    return State(pressure, gap, energy=found.energy * grid.size / coarse.size if gaps_matter else 0.0)
