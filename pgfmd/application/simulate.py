"""The run, top to bottom: job → grid → surface → for each load: solve, measure, write."""

import logging
import os
import shutil
import tempfile
import time
import weakref
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np

from pgfmd.application import machine
from pgfmd.application.ensemble import Ensemble
from pgfmd.application.ensemble_run import run_ensemble
from pgfmd.application.files import Form
from pgfmd.application.job import Job, as_toml, load, parse, tables_as_toml
from pgfmd.application.loads import Loads
from pgfmd.application.machine import Origin, command_line
from pgfmd.application.progress import LogFile
from pgfmd.application.restart import refuse_changes
from pgfmd.application.results import Results
from pgfmd.application.stop import Interruptions
from pgfmd.application.writer import Mode, ResultWriter
from pgfmd.errors import SolverError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables.contact import Contact
from pgfmd.observables.observable import layout_of
from pgfmd.observables.rough_surface import RoughSurface
from pgfmd.options.section import in_words
from pgfmd.options.text import counted
from pgfmd.parallel.collectives import from_root, raise_together
from pgfmd.parallel.mpi import ALONE, MPI, launched
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.nondimensional import in_storage
from pgfmd.surfaces.file import digest
from pgfmd.surfaces.rigid_surface import refined_heights

log = logging.getLogger("pgfmd")


def run_job(
    job: Job, comm: MPI.Comm, directory: str | os.PathLike, *, overwrite: bool = False, restart: bool = False
) -> None:
    """Run a job of one surface (`simulate`) or of an ensemble (`run_ensemble`).  Collective."""
    if job.surface.seeds:
        run_ensemble(simulate, job, comm, Path(directory), _mode(overwrite, restart))
    else:
        simulate(job, comm, directory, overwrite=overwrite, restart=restart)


def _mode(overwrite: bool, restart: bool) -> Mode:
    return "overwrite" if overwrite else "restart" if restart else "new"


def simulate(
    job: Job,
    comm: MPI.Comm,
    directory: str | os.PathLike,
    *,
    overwrite: bool = False,
    restart: bool = False,
    interruptions: Interruptions | None = None,
) -> None:
    """Solve all loads of a job, of one surface, and write its result folder.  Collective.

    interruptions: those of the ensemble that this run belongs to; None: the run makes its own.
    Raises on all ranks together InputError (nothing is written), SolverError (completed loads are written) or Stopped
    (asked to stop; `restart` continues).
    """
    seconds, alone, mode = dict[str, float](), interruptions is None, _mode(overwrite, restart)
    memory, available = machine.memory_per_rank(job, comm), machine.available_memory()
    if alone:
        machine.refuse_too_large(comm, memory)
    grid = SlabGrid(comm, job.cell.shape, job.cell.lengths, transform=job.solver.transform, domain=job.cell.domain)
    inputs = {path: digest(comm, (path, dataset)) for path, dataset in job.sources.values()}
    origin = Origin(job.text, as_toml(job), len(job.load.targets), inputs)
    limits, output = (job.run.checkpoint_interval, job.run.time_limit), job.output
    units, layout = (output.length_unit, output.pressure_unit), layout_of(output.asked)
    form = Form(grid.shape, grid.lengths, grid.rows, output.precision, *units, layout, job.run.io_hints)
    with (
        LogFile(comm.rank) as log_file,
        ResultWriter(comm, directory, origin, form, mode) as writer,
        nullcontext(interruptions) if interruptions else Interruptions(comm, directory, *limits) as asked,
        grid.freed(),
        ExitStack() as at_end,
    ):
        refuse_changes(job, origin, writer.earlier, writer.directory)
        with _timed(seconds, "surface"):
            heights = refined_heights(job.surface, job.grid, grid, job.output.length_unit)
            grid.storage = np.dtype(job.solver.storage).type  # only now: whether it holds the heights is to be seen
            heights = in_storage(grid, heights)
            job.solid.prepare(grid)
        machine.report(comm, memory, available)  # only now: for wrong input the error is the only line
        log.info("solid: %s; %s", job.solid.kind, in_words(job.solid))
        for line in job.doubts if comm.rank == 0 else ():
            log.warning("%s", line)
        problem = ContactProblem(grid, heights, job.solid, job.wall)
        cutoff = from_root(comm, job.surface.whole.cutoff, job.grid)  # may read a table from a file
        surface = RoughSurface(problem, job.output.asked, cutoff, fields=job.output.fields)
        loads = Loads(job, problem, writer, asked)
        at_end.callback(loads.release)
        loads.refuse_impossible(alone)
        with _timed(seconds, "write"):
            loads.begin()
            log_file.open(writer.directory, f"{command_line()}, on {counted(comm.size, 'rank')}")
            if "height" in job.output.fields and not writer.earlier.has_height:
                writer.write_heights(heights)
        for index in loads.pending:
            with _timed(seconds, "solve"):
                solution = loads.solve(index)
            if solution is None:
                continue
            with _timed(seconds, "observe"):
                contact = Contact.of(surface, solution, loads.control.displacement(solution))
                row, groups = contact.numbers, contact.measure()
            with _timed(seconds, "write"):
                loads.write(index, contact, row, groups)
            del solution, contact  # before the next load is solved
        loads.finish(seconds | {f"observe {name}": value for name, value in surface.seconds.items()})
    if loads.unreachable:
        raise SolverError(f"{'; '.join(map(str, loads.unreachable.values()))}; the other loads are written")


@contextmanager
def _timed(seconds: dict[str, float], phase: str) -> Iterator[None]:
    """Adds the wall time of the block to that of the phase."""
    began = time.perf_counter()
    yield
    seconds[phase] = seconds.get(phase, 0.0) + time.perf_counter() - began


Tables = Mapping[str, Mapping[str, Any]]
"""A job as nested tables: {"grid": {"n": 512}, …}."""


def surface(job: Job | Tables | str | os.PathLike, comm: MPI.Comm | None = None) -> np.ndarray:
    """The heights of the surface in a run of `job`, before solver.storage rounds them.  Collective over `comm`.

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
