"""`pgfmd.solve`: one surface, one load, from a script or notebook; `pgfmd.surface`: the surface of a job."""

from __future__ import annotations

import math
import os
from typing import Any

import numpy as np

from pgfmd.errors import InputError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.job.job import Job, load
from pgfmd.options.rules import POSITIVE, Rule, choice, integer, number, pair
from pgfmd.options.text import printable, show
from pgfmd.parallel.collectives import from_root, raise_together
from pgfmd.parallel.mpi import ALONE, MPI
from pgfmd.physics.elasticity import BASES, Elasticity
from pgfmd.physics.laws.exponential import ExponentialWall
from pgfmd.physics.laws.hard import HardWall
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.dispatch import solve_contact
from pgfmd.solvers.options import Solver
from pgfmd.solvers.solution import ContactSolution


def solve(
    heights: np.ndarray,
    pressure: float,
    *,
    contact_modulus: float = 1.0,
    spacing: float | tuple[float, float] = 1.0,
    tolerance: float = 1e-8,
    zeta: float | None = None,
    thickness: float = math.inf,
    base: str | None = None,
    poisson: float = 0.25,
    method: str = "auto",
    start: np.ndarray | None = None,
    comm: MPI.Comm | None = None,
    threads: int | None = None,
) -> ContactSolution:
    """Contact of one surface at one mean pressure, for a script or notebook.  Collective over `comm`.

    heights: without `comm` the whole surface (nx, ny), solved by this process alone; with it this rank's rows
    (nx_local, ny), split as `parallel.slab` does.  Any consistent units.  The fields of the answer are split like them.
    zeta: range of an exponential wall, with σ_ref = contact_modulus; None: a hard wall.  thickness, base ("bonded" if
    None), poisson: a slab instead of a half-space.  method: see `solvers.options`.  start: a pressure like the heights
    to begin with.  tolerance: certified relative energy error (1e-8: pressures to some 1e-3 … 1e-4 of their rms
    value).  threads: of this process; OMP_NUM_THREADS or the free cores if None.  Raises InputError for heights that
    are masked, not finite or wrongly split, values out of range and ranks that do not ask for the same, SolverError if
    the tolerance cannot be reached.
    """
    comm = ALONE if comm is None else comm
    with raise_together(comm):
        heights = _real("heights", heights)
        if heights.ndim != 2 or heights.size == 0:
            raise InputError(f"heights of shape {heights.shape}: must be two-dimensional and not empty")
        if not np.isfinite(heights).all():
            raise InputError("heights: all must be finite")
        pressure, steps = _checked("pressure", pressure, number(low=0)), _checked("spacing", spacing, SPACING)
        threads = None if threads is None else _checked("threads", threads, integer(1))
        thickness = _checked("thickness", thickness, number(above=0, infinite=True))
        base = None if base is None else _checked("base", base, choice(*BASES))
        if math.isinf(thickness) and base is not None:
            raise InputError(f"base = {show(base)}: needs a thickness; a half-space has no base")
        modulus, poisson = (
            _checked("contact_modulus", contact_modulus, POSITIVE),
            _checked("poisson", poisson, number()),
        )
        solid = Elasticity(modulus, thickness, base or "bonded", poisson)
        law = HardWall() if zeta is None else ExponentialWall(zeta=zeta)
        options = Solver(method=method, tolerance=_checked("tolerance", tolerance, number(above=0, below=1)))
        if start is not None and (start := _real("start", start)).shape != heights.shape:
            raise InputError(f"start of shape {start.shape}: must be that of the heights, {heights.shape}")
    asked = comm.allgather((pressure, steps, solid, law, options, start is None))
    if any(other != asked[0] for other in asked):
        raise InputError("the ranks ask for different contacts: all arguments but heights and start must be the same")
    (ax, ay), rows, ny = steps, comm.allgather(len(heights)), heights.shape[1]
    grid = SlabGrid(comm, (sum(rows), ny), (sum(rows) * ax, ny * ay), threads)
    if rows != list(np.diff(grid.starts)) or len(set(comm.allgather(ny))) > 1:
        raise InputError(f"heights: the ranks hold {rows} rows; expected {list(map(int, np.diff(grid.starts)))}")
    try:
        return solve_contact(ContactProblem(grid, heights, solid, law, pressure), options, start)
    finally:
        grid.free()


def surface(job: Job | str | os.PathLike, comm: MPI.Comm | None = None) -> np.ndarray:
    """The heights of the surface in a run of `job`.  Collective over `comm`.

    job: a `Job` or the path of a TOML file.  Without `comm` all of them (nx, ny), made by this process alone; with it
    this rank's rows (nx_local, ny), the same surface.  In units of the job.  Raises InputError on all ranks.
    """
    comm = ALONE if comm is None else comm
    job = job if isinstance(job, Job) else from_root(comm, load, job)
    grid = SlabGrid(comm, job.grid.shape, job.grid.lengths, transform=job.solver.transform)
    try:
        return job.surface.heights(grid, job.output.length_unit)
    finally:
        grid.free()


SPACING = pair(number(low=1e-150, high=1e150))  # so that their squares neither overflow nor underflow


def _real(name: str, values: Any) -> np.ndarray:
    """An array of real numbers in float64, row by row; raises InputError for anything else."""
    if np.ma.is_masked(values):
        raise InputError(f"{name}: {np.ma.count_masked(values)} are masked; fill them, all must be known")
    try:
        array = np.asarray(values)
        if array.dtype.kind not in "fiu":
            raise ValueError(f"not {array.dtype}")
        return np.ascontiguousarray(array, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{name}: must be an array of real numbers: {printable(str(error), 100)}") from None


def _checked(name: str, value: object, rule: Rule) -> Any:
    """The value of an argument as its rule converts it; raises InputError."""
    try:
        return rule.convert(value)
    except ValueError:
        raise InputError(f"{name} = {show(value)}: must be {rule.allowed}") from None
