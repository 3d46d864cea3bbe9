"""Solids, problems and solutions of the tests, in short."""

import math

import numpy as np

from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.physics.laws.hard import HardWall
from pgfmd.physics.problem import ContactProblem
from pgfmd.physics.solids.homogeneous import Homogeneous
from pgfmd.physics.solids.solid import Solid
from pgfmd.solvers.solution import Certificate, ContactSolution
from pgfmd.surfaces.self_affine import self_affine


def elastic(
    contact_modulus: float, thickness: float = math.inf, base: str = "bonded", poisson: float = 0.25
) -> Homogeneous:
    """A half-space, or a slab, of that contact modulus."""
    return Homogeneous(contact_modulus=contact_modulus, thickness=thickness, base=base, poisson=poisson)


HALF_SPACE = elastic(1.0)


def rough_on(comm, shape: tuple[int, int], *numbers: float, **more) -> tuple[SlabGrid, np.ndarray]:
    """A grid, and its self-affine surface of (H, λ_s, rms slope, seed, …).  Collective."""
    grid = SlabGrid(comm, shape)
    return grid, self_affine(grid, *numbers, **more)


def under_hard_wall(grid: SlabGrid, heights: np.ndarray, load=0.0, solid: Solid = HALF_SPACE) -> ContactProblem:
    """Heights (nx_local, ny) under a hard wall at a mean pressure."""
    return ContactProblem(grid, heights, solid, HardWall(), load)


def solution_of(pressure: np.ndarray, gap: np.ndarray | None = None, mean_pressure=1.0) -> ContactSolution:
    """A solution of which only the fields matter; a gap of 1 beside contact if none is given."""
    gap = np.where(pressure > 0, 0.0, 1.0) if gap is None else gap
    return ContactSolution(pressure, gap, mean_pressure, 0.0, 0.0, Certificate(0.0), 0.0, 0, 0.0, 0.0)
