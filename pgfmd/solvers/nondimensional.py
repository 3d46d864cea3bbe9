"""Contact problems in units of their own, so that solvers never meet overflow, and the way back."""

from __future__ import annotations

import math
import time

import numpy as np

from pgfmd.errors import InputError
from pgfmd.grid import kernels
from pgfmd.physics.laws.law import Units
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.solution import ContactSolution

LARGEST = 1e120  # of heights over the grid spacing, of pressures over the contact modulus; the inverse is the smallest
UNIFORM = 1e15  # range of a law over the rms height from which on the pressure is uniform to a double's rounding


class Dimensionless:
    """A contact problem with heights about their mean and over their rms value.  Collective to make.

    problem: the dimensionless one, or None where `uniform`, the solution, needs no solver: without a load, without
    roughness, or under a law that hardly feels it.  Wave numbers, and so lengths in the plane, keep their unit.
    """

    def __init__(self, physical: ContactProblem, by_load: bool = False, overwrite_heights: bool = False):
        """by_load: the unit of pressure is the mean pressure instead of contact modulus × rms height / spacing.
        overwrite_heights: use their memory.  Raises InputError for what cannot be solved.
        """
        physical.check()
        self.physical, self._began = physical, time.perf_counter()
        grid, solid, law = physical.grid, physical.solid, physical.law
        self._transforms = grid.transforms
        heights, height = dimensionless(physical, overwrite_heights)
        self.problem = self.uniform = None
        if physical.mean_pressure == 0 or height * UNIFORM <= law.range:
            self.uniform = self._uniform(heights, height)
            return
        unit = physical.mean_pressure if by_load else solid.contact_modulus * height / min(grid.spacing)
        self.units = Units(height, unit, law.gap(unit, solid))
        self.problem = ContactProblem(
            grid, heights, solid.in_units(height, unit), law.in_units(self.units), physical.mean_pressure / unit
        )

    def _uniform(self, heights: np.ndarray, height: float) -> ContactSolution:
        """A pressure that is the same everywhere; without a load the highest point touches.  Collective."""
        mean, law = float(self.physical.mean_pressure), self.physical.law
        top = law.gap(mean, self.physical.solid) if mean > 0 else self.physical.grid.reduction.max(heights) * height
        heights *= height
        seconds = time.perf_counter() - self._began
        gap = np.subtract(top, heights, out=heights)
        return ContactSolution(np.full(gap.shape, mean), gap, mean, top, 0.0, 0.0, 0.0, 0, 0.0, seconds)

    def solution(self, state, energy: float, coarse_transforms: float = 0.0) -> ContactSolution:
        """The physical solution of a dimensionless state, whose fields become its own.  Collective.

        state: pressure, gap, level, error and iterations of the solver; energy: ½⟨p̂ û⟩ per point.
        """
        pressure, gap, units, grid = state.pressure, state.gap, self.units, self.physical.grid
        law, level = self.problem.law, state.level

        def finish(first: int, stop: int) -> float:
            return law.finish(pressure[first:stop], gap[first:stop], level, units)

        violation = grid.reduction.max(grid.threads.collect(finish, len(gap)))
        return ContactSolution(
            pressure=pressure,
            gap=gap,
            mean_pressure=self.physical.mean_pressure,
            mean_gap=units.offset - level * units.height,
            elastic_energy=energy * units.pressure * units.height,
            certified_error=state.error,
            max_violation=violation,
            iterations=state.iterations,
            transforms=grid.transforms - self._transforms + coarse_transforms,
            seconds=time.perf_counter() - self._began,
        )


def dimensionless(problem: ContactProblem, overwrite: bool = False) -> tuple[np.ndarray, float]:
    """(heights − ⟨heights⟩)/rms (nx_local, ny), as a new array or in the place of the heights, and their rms; zeros
    and 0 for a plane.  Collective.

    Raises InputError, saying what is out of range, for a surface that is not flat, or a pressure, beyond `LARGEST`.
    """
    grid, heights = problem.grid, problem.heights
    reduce, threads, rows = grid.reduction, grid.threads, grid.local_shape[0]
    origin = grid.comm.bcast(float(heights[0, 0]) if grid.comm.rank == 0 else None)  # heights may lie far from zero

    def measure(first: int, stop: int) -> tuple[float, ...]:
        part = heights[first:stop]
        return part.min(), part.max(), *kernels.sums_about(origin, part)

    lows, highs, sums, squares = zip(*threads.collect(measure, rows, grid.band), strict=True)
    low, high = reduce.min(lows), reduce.max(highs)
    limits = (
        ("range of heights / grid spacing", high / 2 - low / 2, min(grid.spacing)),
        ("mean pressure / contact modulus", problem.mean_pressure, problem.solid.contact_modulus),
    )
    for name, value, unit in limits:
        if value != 0 and not 1 / LARGEST <= value / unit <= LARGEST:
            raise InputError(f"{name} = {value / unit:.1e}: must lie between {1 / LARGEST:g} and {LARGEST:g}")
    if low == high:
        return np.zeros(grid.local_shape), 0.0
    above, square = reduce.sums(math.fsum(sums), math.fsum(squares)) / grid.size
    mean, rms = np.float64(origin + above), math.sqrt(square - above**2)
    out = heights if overwrite else np.empty(grid.local_shape)

    def divide(_: int, first: int, stop: int):
        part = np.subtract(heights[first:stop], mean, out=out[first:stop])
        part /= rms

    threads.share(divide, rows, grid.band)
    return out, rms
