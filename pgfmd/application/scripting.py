"""For scripts and notebooks: `run` runs a job and opens its results, `surface` makes the surface of a job."""

from __future__ import annotations

import os
import shutil
import tempfile
import weakref
from collections.abc import Mapping
from typing import Any

import numpy as np

from pgfmd.application.ensemble import Ensemble
from pgfmd.application.job import Job, load, parse, tables_as_toml
from pgfmd.application.results import Results
from pgfmd.application.simulate import run_job
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.parallel.collectives import from_root, raise_together
from pgfmd.parallel.mpi import ALONE, MPI, launched
from pgfmd.surfaces.rigid_surface import refined_heights

Tables = Mapping[str, Mapping[str, Any]]
"""A job as nested tables: {"grid": {"n": 512}, …}."""


def surface(job: Job | Tables | str | os.PathLike, comm: MPI.Comm | None = None) -> np.ndarray:
    """The heights of the surface in a run of `job`.  Collective over `comm`.

    job: a `Job`, the path of a TOML file, or its tables, of which only "grid" and "surface" are needed.  Without `comm`
    all heights (nx, ny), made by this process alone; with it this rank's rows (nx_local, ny).  The surface does not
    depend on the number of ranks.  In units of the job.  Raises InputError on all ranks.

    >>> import pgfmd
    >>> rough = {"kind": "self-affine", "hurst": 0.8, "lambda_s": 8.0, "rms_slope": 0.1, "seed": 3}
    >>> pgfmd.surface({"grid": {"n": [64, 32]}, "surface": rough}).shape
    (64, 32)
    """
    comm = ALONE if comm is None else comm
    if isinstance(job, Mapping):
        job = {"solid": {"contact_modulus": 1.0}, "load": {"pressure": 1.0}} | dict(job)
    job = job if isinstance(job, Job) else from_root(comm, _job, job)
    grid = SlabGrid(comm, job.cell.shape, job.cell.lengths, transform=job.solver.transform, domain=job.cell.domain)
    with grid.freed():
        return refined_heights(job.surface, job.grid, grid, job.output.length_unit)


def run(
    job: Job | Tables | str | os.PathLike,
    output: str | os.PathLike | None = None,
    *,
    comm: MPI.Comm | None = None,
    overwrite: bool = False,
    restart: bool = False,
) -> Results | Ensemble:
    """Run a job, as `pgfmd run` does, and open its results.  Collective over `comm`, all ranks if None.

    job: a `Job`, the path of a TOML file, or its tables.  output: folder of the results; None: a temporary one, removed
    when rank 0 drops its last reference to the results, or if the run fails.  overwrite: replaces results; restart:
    continues them.  Raises InputError (nothing is written), SolverError (completed loads are written), Stopped.

    >>> import pgfmd
    >>> wave = {"kind": "sinusoid", "amplitude": 1.0}
    >>> solid = {"contact_modulus": 1.0}
    >>> pgfmd.run({"grid": {"n": 32}, "surface": wave, "solid": solid, "load": {"mean_gap": 0.2}})[0]
    load 0 of ...: mean_pressure 0.04315, contact_area 0.4688, mean_gap 0.2
    """
    comm = launched() if comm is None else comm
    job = job if isinstance(job, Job) else from_root(comm, _job, job)
    folder = from_root(comm, tempfile.mkdtemp, None, "pgfmd-") if output is None else output
    try:
        run_job(job, comm, folder, overwrite=overwrite, restart=restart)
        with raise_together(comm):  # all have opened them before rank 0 may remove a temporary folder
            results = Ensemble(folder) if job.surface.seeds else Results(folder)
    except BaseException:
        if output is None and comm.rank == 0:
            shutil.rmtree(folder, ignore_errors=True)
        raise
    if output is None and comm.rank == 0:
        weakref.finalize(results, shutil.rmtree, folder, True)
    return results


def _job(source: Tables | str | os.PathLike) -> Job:
    """The job in a file, or in tables, where relative paths count from the working directory.  Raises InputError."""
    return parse(tables_as_toml(source), folder=os.getcwd()) if isinstance(source, Mapping) else load(source)
