"""The run, top to bottom: job → grid → surface → for each load: solve, measure, write."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path

import numpy as np

from pgfmd.application import machine
from pgfmd.application.ensemble_run import run_ensemble
from pgfmd.application.files import Form
from pgfmd.application.job import Job, as_toml
from pgfmd.application.loads import Loads
from pgfmd.application.machine import Origin, command_line
from pgfmd.application.progress import LogFile
from pgfmd.application.restart import refuse_changes
from pgfmd.application.stop import Interruptions
from pgfmd.application.writer import Mode, ResultWriter
from pgfmd.errors import SolverError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables.contact import Contact
from pgfmd.observables.observable import layout_of
from pgfmd.observables.rough_surface import RoughSurface
from pgfmd.options.section import in_words
from pgfmd.options.text import counted
from pgfmd.parallel.collectives import from_root
from pgfmd.parallel.mpi import MPI
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.nondimensional import in_storage
from pgfmd.surfaces.file import digest
from pgfmd.surfaces.rigid_surface import refined_heights

log = logging.getLogger("pgfmd")
HELD_BACK = 5.0  # seconds for which a seed of an ensemble may hold back finished loads, to write them together


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
    phases, alone, mode = _Phases(), interruptions is None, _mode(overwrite, restart)
    memory, available = machine.memory_per_rank(job, comm), machine.available_memory()
    if alone:
        machine.refuse_too_large(comm, memory)
    grid = SlabGrid(comm, job.cell.shape, job.cell.lengths, transform=job.solver.transform, domain=job.cell.domain)
    grid.storage = np.dtype(job.solver.storage).type
    inputs = {path: digest(comm, (path, dataset)) for path, dataset in job.sources.values()}
    origin = Origin(job.text, as_toml(job), len(job.load.targets), inputs)
    limits, output = (job.run.checkpoint_interval, job.run.time_limit), job.output
    units, layout = (output.length_unit, output.pressure_unit), layout_of(output.asked)
    form = Form(grid.shape, grid.lengths, grid.rows, output.precision, *units, layout, job.run.io_hints)
    with (
        LogFile(comm.rank) as log_file,
        ResultWriter(comm, directory, origin, form, mode, 0.0 if alone else HELD_BACK) as writer,
        nullcontext(interruptions) if interruptions else Interruptions(comm, directory, *limits) as asked,
        grid.freed(),
        ExitStack() as at_end,
    ):
        refuse_changes(job, origin, writer.earlier, writer.directory)
        with phases("surface"):
            heights = refined_heights(job.surface, job.grid, grid, job.output.length_unit)
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
        with phases("write"):
            loads.begin()
            log_file.open(writer.directory, f"{command_line()}, on {counted(comm.size, 'rank')}")
            if "height" in job.output.fields and not writer.earlier.has_height:
                writer.write_heights(heights)
        for index in loads.pending:
            with phases("solve"):
                solution = loads.solve(index)
            if solution is None:
                continue
            with phases("observe"):
                contact = Contact.of(surface, solution, loads.control.displacement(solution))
                row, groups = contact.numbers, contact.measure()
            with phases("write"):
                loads.write(index, contact, row, groups)
            del solution, contact  # before the next load is solved
        loads.finish(phases.seconds | {f"observe {name}": value for name, value in surface.seconds.items()})
    if loads.unreachable:
        raise SolverError(f"{'; '.join(map(str, loads.unreachable.values()))}; the other loads are written")


class _Phases:
    """Wall seconds by name."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        began = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - began
