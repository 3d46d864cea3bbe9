"""The exponential wall σ = σ_ref exp(−gap/ζ) at imposed load: Newton's method on a cascade of grids.

`solve_exponential_wall` makes heights and pressures dimensionless (rms height, mean pressure), solves coarse grids
first, the coarsest with ζ reduced step by step, and gives physical quantities back.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import numpy as np

from pgfmd.errors import InputError, SolverError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.transfer import Interpolation, restrict
from pgfmd.physics.elasticity import Elasticity
from pgfmd.solvers.exponential_wall import kernels
from pgfmd.solvers.exponential_wall.newton import WallRelaxation, WallState
from pgfmd.solvers.nondimensional import dimensionless
from pgfmd.solvers.solution import ContactSolution

COARSEST = 32  # points of the shorter side below which coarser grids bring nothing
COARSE_TOLERANCE = 1e-2  # certified error at which a coarse grid has served: discretisation errors are larger
FLAT = 1e-2  # rms height of a coarse grid, over that of the surface, below which it has nothing to say
LOOSE, REDUCTION = 0.1, 4  # certified error and factor between the steps of a ζ continuation
UNIFORM = 1e15  # ζ over the rms height from which on the pressure is uniform to a double's rounding


def solve_exponential_wall(
    grid: SlabGrid,
    heights: np.ndarray,
    mean_pressure: float,
    elasticity: Elasticity,
    zeta: float,
    sigma_ref: float | None = None,
    tolerance: float = 1e-6,
    start: np.ndarray | None = None,
    monitor: Callable[[SlabGrid, WallState], None] | None = None,
) -> ContactSolution:
    """Contact under σ = σ_ref exp(−gap/ζ) at the mean pressure, to a certified relative energy error.  Collective.

    heights (nx_local, ny) and zeta: lengths.  sigma_ref: a pressure, the contact modulus if None; it shifts gaps by
    ζ ln σ_ref and nothing else.  start: a pressure (nx_local, ny) from a neighbouring load to begin with, instead of
    coarse grids.  certified_error is ζ⟨p ln(p/σ)⟩/⟨p u⟩ (see `newton`); max_violation the largest |gap − gap(p)| over
    the rms height where p exceeds its mean.  Raises InputError for a load or ζ that is not positive, SolverError if the
    tolerance cannot be reached.
    """
    began, transforms, reduce = time.perf_counter(), grid.transforms, grid.reduction
    for name, value in (("mean pressure", mean_pressure), ("zeta", zeta)):
        if not 0 < value < math.inf:
            raise InputError(f"exponential wall: {name} = {value!r}: must be positive and finite")
    heights, height = dimensionless(grid, heights, mean_pressure, elasticity)
    from_mean = zeta * math.log((sigma_ref or elasticity.contact_modulus) / mean_pressure)  # gap where p = p̄
    if height * UNIFORM <= zeta:
        uniform = np.full(grid.local_shape, float(mean_pressure))
        heights *= height
        np.subtract(from_mean, heights, out=heights)
        seconds = time.perf_counter() - began
        return ContactSolution(uniform, heights, mean_pressure, from_mean, 0.0, 0.0, 0.0, 0, 0.0, seconds)
    problem = _Problem(elasticity, mean_pressure / height, zeta / height, tolerance, monitor)
    if start is None:
        state, extra = problem.cascade(grid, heights, tolerance)
    else:
        state, extra = problem.relax(grid, heights, problem.feasible(grid, start), tolerance), 0.0
    pressure, gap = state.pressure, state.gap
    parts = grid.threads.collect(
        lambda a, b: kernels.largest_deviation(pressure, gap, problem.zeta, state.level, a, b), len(gap)
    )
    pressure *= mean_pressure
    gap -= state.level
    gap *= height
    gap += from_mean
    return ContactSolution(
        pressure=pressure,
        gap=gap,
        mean_pressure=mean_pressure,
        mean_gap=from_mean - state.level * height,
        elastic_energy=state.work / 2 * mean_pressure * height,
        certified_error=state.error,
        max_violation=reduce.max(parts),
        iterations=state.iterations,
        transforms=grid.transforms - transforms + extra,
        seconds=time.perf_counter() - began,
    )


class _Problem:
    """What is the same on all grids: solid, load and wall in units of the rms height and the mean pressure."""

    def __init__(self, elasticity, compliance_unit: float, zeta: float, tolerance: float, monitor):
        self.elasticity, self.compliance_unit = elasticity, compliance_unit
        self.zeta, self.tolerance, self.monitor = zeta, tolerance, monitor

    def relax(self, grid: SlabGrid, heights: np.ndarray, state: WallState, tolerance: float) -> WallState:
        """Newton from that state; should it fail, by continuation in ζ from a uniform pressure.  Collective."""
        solver = WallRelaxation(grid, heights, self.elasticity, self.compliance_unit)
        monitor = None if self.monitor is None else lambda state: self.monitor(grid, state)
        try:
            return solver.relax(state, self.zeta, tolerance, monitor)
        except SolverError:
            if state.error <= LOOSE:
                raise
        state.pressure[...] = 1.0
        return self.continuation(grid, heights, state, tolerance)

    def continuation(self, grid: SlabGrid, heights: np.ndarray, state: WallState, tolerance: float) -> WallState:
        """From ζ = rms height, where a few steps suffice from any start, down to the wall's own.  Collective."""
        solver = WallRelaxation(grid, heights, self.elasticity, self.compliance_unit)
        steps = max(0, math.ceil(math.log(1 / self.zeta, REDUCTION)))
        for power in range(steps, 0, -1):
            solver.relax(state, self.zeta * REDUCTION**power, LOOSE)
        monitor = None if self.monitor is None else lambda state: self.monitor(grid, state)
        return solver.relax(state, self.zeta, tolerance, monitor)

    def cascade(self, grid: SlabGrid, heights: np.ndarray, tolerance: float) -> tuple[WallState, float]:
        """Solve this grid from the next coarser one.  Returns also the transforms of those, by size.  Collective."""
        if min(grid.shape) <= COARSEST:
            state = WallState(np.ones(grid.local_shape), np.empty(grid.local_shape))
            return self.continuation(grid, heights, state, tolerance), 0.0
        coarse = grid.coarse()
        coarse_heights = restrict(grid, coarse, heights)
        if coarse.reduction.dot(coarse_heights, coarse_heights) < FLAT**2 * coarse.size:
            state = WallState(np.ones(grid.local_shape), np.empty(grid.local_shape))
            return self.continuation(grid, heights, state, tolerance), 0.0
        found, extra = self.cascade(coarse, coarse_heights, max(tolerance, COARSE_TOLERANCE))
        state = self.prolong(coarse, found, coarse_heights, grid, heights)
        extra = (extra + coarse.transforms) * coarse.size / grid.size
        coarse.free()
        return self.relax(grid, heights, state, tolerance), extra

    def prolong(self, coarse: SlabGrid, found: WallState, coarse_heights, grid: SlabGrid, heights) -> WallState:
        """Start on the finer grid: its wall answers to the interpolated displacement and pressure.  Collective."""
        interpolation = Interpolation(coarse, grid, [found.gap + coarse_heights, found.pressure])
        target = np.empty(grid.local_shape)
        solver = WallRelaxation(grid, heights, self.elasticity, self.compliance_unit)

        def part(thread: int, first: int, stop: int):
            rows = (interpolation.rows(which, first, stop, thread) for which in (1, 0))
            kernels.start_rows(*rows, heights[first:stop], solver.reach, target[first:stop])

        grid.threads.share(part, grid.local_shape[0], grid.band)
        state = WallState(np.empty(grid.local_shape), np.empty(grid.local_shape), level=found.level)
        state.iterations = found.iterations
        solver.respond(state, target, self.zeta)
        return state

    def feasible(self, grid: SlabGrid, pressure: np.ndarray) -> WallState:
        """The state of a given pressure, scaled to the load.  Collective."""
        start = np.maximum(pressure, 0.0)
        total = grid.reduction.sum(start)
        if not 0 < total < math.inf:
            start[...], total = 1.0, grid.size
        start *= grid.size / total
        return WallState(start, np.empty(grid.local_shape))
