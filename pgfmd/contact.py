"""`pgfmd.solve`: one surface, one load, from a script or notebook."""

from __future__ import annotations

import math

import numpy as np
from mpi4py import MPI

from .elasticity import Elasticity
from .errors import InputError
from .grid import SlabGrid
from .parallel import raise_together
from .solvers.cascade import solve_hard_wall
from .solvers.solution import ContactSolution


def solve(
    heights: np.ndarray,
    pressure: float,
    *,
    contact_modulus: float = 1.0,
    spacing: float | tuple[float, float] = 1.0,
    tolerance: float = 1e-6,
    comm: MPI.Comm | None = None,
    threads: int | None = None,
) -> ContactSolution:
    """Hard-wall contact of one surface at one mean pressure, for a script or notebook.  Collective over `comm`.

    heights: without `comm` the whole surface (nx, ny), solved by this process alone; with it this rank's rows
    (nx_local, ny), split as `parallel.slab` does.  Any consistent units.  The fields of the answer are split like the
    heights. Raises InputError for heights that are not finite or wrongly split, SolverError if the tolerance cannot
    be reached.
    """
    comm = MPI.COMM_SELF if comm is None else comm
    with raise_together(comm):
        heights = np.ascontiguousarray(heights, dtype=np.float64)
        if heights.ndim != 2 or heights.size == 0:
            raise InputError(f"heights of shape {heights.shape}: must be two-dimensional and not empty")
        if not np.isfinite(heights).all():
            raise InputError("heights: all must be finite")
        if not (pressure >= 0 and math.isfinite(pressure)):
            raise InputError(f"pressure = {pressure!r}: must be finite and not negative")
    ax, ay = (spacing, spacing) if np.isscalar(spacing) else spacing
    rows, ny = comm.allgather(len(heights)), heights.shape[1]
    grid = SlabGrid(comm, (sum(rows), ny), (sum(rows) * ax, ny * ay), threads)
    if rows != list(np.diff(grid.starts)) or len(set(comm.allgather(ny))) > 1:
        raise InputError(f"heights: the ranks hold {rows} rows; expected {list(map(int, np.diff(grid.starts)))}")
    try:
        return solve_hard_wall(grid, heights, float(pressure), Elasticity(contact_modulus), tolerance)
    finally:
        grid.free()
