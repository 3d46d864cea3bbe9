"""Green's function molecular dynamics: damped dynamics of the displacement's Fourier modes against a wall.

After Campañá and Müser 2006 (doi:10.1103/PhysRevB.74.075420).  Mode by mode the displacement moves with its force,
m(q) du(q)/dt = f(q) − K(q) u(q), in a mass m(q) = K(q) + κ that gives all modes one time scale, the time step.

A bare hard wall, pushing points out of itself, would be consistent with the forces only if all modes had one mass.
Here the wall has a spring κ and a memory of its force f, which moves to the solution of

    f/κ = max(f_old/κ − gap + c, 0)        (hard: a projection onto the forces that push and carry the load)
    f/κ + ζ ln f = f_old/κ − gap + c       (exponential)

so that at rest the gap is exactly the wall's, whatever κ is; c carries the load.  With the displacement extrapolated by
one step this is a primal–dual iteration that converges for every κ (Condat 2013, doi:10.1007/s10957-012-0245-9).  The
geometric mean of the softest and the stiffest mode is the fastest; steps 1.8 times as long (below 2 they converge) play
the part of inertia.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import numpy as np

from pgfmd.errors import InputError, SolverError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.physics.elasticity import Elasticity
from pgfmd.solvers.exponential_wall.nested_iteration import UNIFORM
from pgfmd.solvers.exponential_wall.newton import WallRelaxation, WallState
from pgfmd.solvers.nondimensional import dimensionless
from pgfmd.solvers.solution import ContactSolution

INERTIA = 1.8  # of the full step: relaxation factor
INTERVAL = 10  # steps between certificates, which take a convolution each


def solve_gfmd(
    grid: SlabGrid,
    heights: np.ndarray,
    mean_pressure: float,
    elasticity: Elasticity,
    zeta: float = 0.0,
    sigma_ref: float | None = None,
    tolerance: float = 1e-6,
    max_steps: int = 10000,
    start: np.ndarray | None = None,
    monitor: Callable[[SlabGrid, WallState], None] | None = None,
) -> ContactSolution:
    """Hard wall (zeta = 0) or σ_ref exp(−gap/ζ) by dynamics, to a certified relative energy error.  Collective.

    heights (nx_local, ny).  start: a pressure (nx_local, ny) to begin with.  The certificate is that of the other
    solvers.  Raises InputError for a load that is not positive, SolverError if `max_steps` do not reach the tolerance.
    """
    began, transforms, reduce = time.perf_counter(), grid.transforms, grid.reduction
    if not 0 < mean_pressure < math.inf:
        raise InputError(f"GFMD: mean pressure = {mean_pressure!r}: must be positive and finite")
    heights, height = dimensionless(grid, heights, mean_pressure, elasticity)
    from_mean = zeta * math.log((sigma_ref or elasticity.contact_modulus) / mean_pressure)  # gap where p = p̄
    if height == 0 or height * UNIFORM <= zeta:
        uniform = np.full(grid.local_shape, float(mean_pressure))
        seconds = time.perf_counter() - began
        return ContactSolution(
            uniform, from_mean - heights * height, mean_pressure, from_mean, 0.0, 0.0, 0.0, 0, 0.0, seconds
        )
    dynamics = Dynamics(grid, heights, elasticity, mean_pressure / height, zeta / height)
    if start is not None and 0 < reduce.sum(start) < math.inf:
        dynamics.force[...] = start * (grid.size / reduce.sum(start))
    state = dynamics.run(tolerance, max_steps, monitor)
    pressure, gap = state.pressure, state.gap
    gap -= state.level
    violation = reduce.max(np.abs(gap + zeta / height * np.log(np.maximum(pressure, 1)))[pressure >= 1])
    if zeta == 0:
        violation = max(violation, -reduce.min(gap))
        np.maximum(gap, 0, out=gap)
        gap[pressure > 0] = 0
    gap *= height
    gap += from_mean
    pressure *= mean_pressure
    return ContactSolution(
        pressure=pressure,
        gap=gap,
        mean_pressure=mean_pressure,
        mean_gap=from_mean - state.level * height,
        elastic_energy=state.work / 2 * mean_pressure * height,
        certified_error=state.error,
        max_violation=violation,
        iterations=state.iterations,
        transforms=grid.transforms - transforms,
        seconds=time.perf_counter() - began,
    )


class Dynamics:
    """Displacement (nx_local, ny), its modes (nky_local, nx), and the wall's force over p̄.  Collective to make."""

    def __init__(self, grid: SlabGrid, heights: np.ndarray, elasticity: Elasticity, compliance_unit: float, zeta):
        self.grid, self.heights, self.zeta = grid, heights, zeta
        self.certifier = WallRelaxation(grid, heights, elasticity, compliance_unit)
        stiffness = elasticity.stiffness(np.sqrt(grid.q_squared())) / compliance_unit
        softest = grid.reduction.min(stiffness[stiffness > 0])
        self.spring = math.sqrt(softest * grid.reduction.max(stiffness))
        self.mobility = np.where(stiffness > 0, 1 / (stiffness + self.spring), 0)
        self.modes = np.zeros(grid.spectral_shape, np.complex128)
        self.displacement, self.force = np.zeros(grid.local_shape), np.ones(grid.local_shape)
        self.certifier.reach = 1 / self.spring

    def run(self, tolerance: float, max_steps: int, monitor=None) -> WallState:
        """Steps until the certified error of the wall's force is at most `tolerance`; else SolverError.  Collective."""
        state = WallState(np.empty(self.grid.local_shape), np.empty(self.grid.local_shape))
        level, best = 0.0, math.inf
        for step in range(1, max_steps + 1):
            state.level = level
            self.step(state)
            level = state.level
            if step % INTERVAL and step < max_steps:
                continue
            state.iterations = step
            self.certifier.compute_gap(state)
            self.certifier.certify(state, self.zeta)
            best = min(best, state.error)
            if monitor is not None:
                monitor(self.grid, state)
            if state.error <= tolerance:
                return state
        raise SolverError(
            f"GFMD: the certified error is {best:.1e} after {max_steps} steps, above the tolerance {tolerance:.1e}; "
            "allow more iterations, or ask for less"
        )

    def step(self, state: WallState) -> None:
        """One time step; `state.pressure` becomes the wall's answer.  Collective."""
        displacement, force, target = self.displacement, self.force, state.gap

        def fill(first: int, stop: int, rows: np.ndarray):
            rows[...] = force[first:stop]

        def move(block: np.ndarray, first: int, stop: int):
            modes = self.modes[first:stop]
            block += self.spring * modes
            block *= self.mobility[first:stop]
            modes += INERTIA * (block - modes)
            block *= 1 / self.grid.size

        def drain(first: int, stop: int, rows: np.ndarray):
            part = displacement[first:stop]
            change = rows - part
            target[first:stop] = force[first:stop] / self.spring + self.heights[first:stop] - rows - change
            part += INERTIA * change

        self.grid.convolve(fill, move, drain)
        self.certifier.respond(state, target, self.zeta)
        force += INERTIA * (state.pressure - force)
