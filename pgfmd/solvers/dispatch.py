"""One call for every wall and method."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pgfmd.errors import InputError, SolverError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.physics.elasticity import Elasticity
from pgfmd.solvers.active_set.nested_iteration import solve_hard_wall
from pgfmd.solvers.exponential_wall.nested_iteration import solve_exponential_wall
from pgfmd.solvers.gfmd import solve_gfmd
from pgfmd.solvers.solution import ContactSolution

RESCUE = 4000  # steps of dynamics after another method has failed
log = logging.getLogger("pgfmd")
METHODS = {"hard": ("auto", "active-set", "gfmd"), "exponential": ("auto", "newton", "gfmd")}


@dataclass(frozen=True)
class Wall:
    """Hard ("hard"), or exponential ("exponential"): σ = σ_ref exp(−gap/ζ), with σ_ref the contact modulus if None."""

    kind: str = "hard"
    zeta: float | None = None
    sigma_ref: float | None = None


def solve_contact(
    grid: SlabGrid,
    heights: np.ndarray,
    mean_pressure: float,
    elasticity: Elasticity,
    wall: Wall,
    method: str = "auto",
    tolerance: float = 1e-6,
    max_iterations: int = 10000,
    start: np.ndarray | None = None,
    monitor: Callable | None = None,
) -> ContactSolution:
    """Contact of heights (nx_local, ny) with that wall at the mean pressure, by that method.  Collective.

    "auto" takes the fastest method, and dynamics should that fail.  `max_iterations` limits the steps of "gfmd"; the
    other methods stop by themselves.  `start`, a pressure (nx_local, ny), replaces coarse grids.  Raises InputError for
    a method that the wall does not know, SolverError.
    """
    if method not in METHODS[wall.kind]:
        raise InputError(f"method {method!r}: must be one of {', '.join(METHODS[wall.kind])} for a wall of this kind")
    common = grid, heights, mean_pressure, elasticity
    if method == "gfmd" and (mean_pressure > 0 or wall.kind != "hard"):
        law = wall.zeta or 0.0, wall.sigma_ref
        return solve_gfmd(*common, *law, tolerance, max_iterations, start=start, monitor=monitor)
    try:
        if wall.kind == "exponential":
            return solve_exponential_wall(*common, wall.zeta, wall.sigma_ref, tolerance, start, monitor)
        return solve_hard_wall(*common, tolerance, start, monitor)
    except SolverError as failure:
        if method != "auto" or mean_pressure == 0:
            raise
        if grid.comm.rank == 0:
            log.info("%s; trying dynamics, which are slower but always converge", failure)
    law = wall.zeta or 0.0, wall.sigma_ref
    return solve_gfmd(*common, *law, tolerance, min(max_iterations, RESCUE), monitor=monitor)
