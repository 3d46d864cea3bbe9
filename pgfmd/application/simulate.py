"""The run, top to bottom: job → grid → surface → for each load: solve, measure, write."""

from __future__ import annotations

import dataclasses
import logging
import math
import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path

import numpy as np

from pgfmd.application import machine
from pgfmd.application.checkpoint import Checkpoints
from pgfmd.application.ensemble_run import run_ensemble
from pgfmd.application.estimate import estimate
from pgfmd.application.files import Form
from pgfmd.application.job import Job, Run, as_toml
from pgfmd.application.log_file import LogFile
from pgfmd.application.progress import Progress
from pgfmd.application.provenance import Origin, command_line
from pgfmd.application.restart import refuse_changes
from pgfmd.application.stop import Interruptions
from pgfmd.application.writer import Mode, ResultWriter
from pgfmd.errors import InputError, SolverError, Unreachable
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables.contact import Contact
from pgfmd.observables.observable import layout_of
from pgfmd.observables.rough_surface import RoughSurface
from pgfmd.observables.schema import TABLE
from pgfmd.options.section import in_words
from pgfmd.options.text import counted
from pgfmd.parallel.collectives import from_root, shared
from pgfmd.parallel.mpi import MPI
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.adhesive_branch import Branch
from pgfmd.solvers.dispatch import solve_contact
from pgfmd.solvers.load_control import LoadControl, load_control
from pgfmd.solvers.solution import ContactSolution, SolverState
from pgfmd.surfaces.heights_file import digest
from pgfmd.surfaces.surface import refined_heights

log = logging.getLogger("pgfmd")
HELD_BACK = 5.0  # seconds for which a run of an ensemble may hold back finished loads, to write them together


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
    Raises InputError (wrong input, nothing written), SolverError (completed loads stay written) or Stopped (asked to
    stop; what was done is kept for `restart`) on all ranks together.
    """
    phases, alone = _Phases(), interruptions is None
    here = machine.ranks_per_node(comm)
    memory = from_root(comm, estimate, job, comm.size, math.inf, here).node / here  # may read the surface's table
    if alone:
        machine.refuse_too_large(comm, memory)
    grid = SlabGrid(comm, job.cell.shape, job.cell.lengths, transform=job.solver.transform, domain=job.cell.domain)
    output = job.output
    inputs = {source[0]: digest(comm, source) for source in job.sources.values()}
    origin = Origin(job.text, as_toml(job), len(job.load.targets), inputs)
    form = Form(
        grid.shape, grid.lengths, grid.rows, output.precision, output.length_unit, output.pressure_unit,
        layout_of(output.asked), job.run.io_hints,
    )  # fmt: skip
    with (
        LogFile(comm.rank) as log_file,
        ResultWriter(
            comm, directory, origin, form, _mode(overwrite, restart), 0.0 if alone else HELD_BACK
        ) as writer,
        nullcontext(interruptions)
        if interruptions
        else Interruptions(comm, directory, job.run.checkpoint_interval, job.run.time_limit) as interruptions,
        grid.freed(),
    ):
        refuse_changes(job, origin, writer.earlier, writer.directory)
        with phases("surface"):
            heights = refined_heights(job.surface, job.grid, grid, job.output.length_unit)
            job.solid.prepare(grid)
        machine.report(comm, memory)  # only now: after a wrong input the error is the only line
        log.info("solid: %s; %s", job.solid.kind, in_words(job.solid))
        problem = ContactProblem(grid, heights, job.solid, job.wall)
        cutoff = from_root(comm, job.surface.cutoff, job.grid)  # a table may have to be read
        surface = RoughSurface(problem, job.output.asked, cutoff, fields=job.output.fields)
        imposed = job.imposed
        control = load_control(imposed, problem, job.solver.tolerance)
        impossible = _impossible(control, imposed.targets, alone)
        first = of_first_load(job)
        checkpoints = Checkpoints(comm, writer.fields_folder, grid.shape, grid.rows, first, job.run.io_hints)
        with phases("write"):
            if writer.replacing:  # earlier results stay until the first load is written;
                # until then a stopped run must start again with --overwrite
                interruptions.resumption = "--overwrite"
            elif writer.earlier.job is None:
                checkpoints.remove()
            writer.begin()
            log_file.open(writer.directory, f"{command_line()}, on {counted(comm.size, 'rank')}")
            if "height" in job.output.fields and not writer.earlier.has_height:
                writer.write_heights(heights)
        pending, count = writer.pending, len(job.load.targets)
        unreachable: dict[int, Exception] = {index: impossible[index] for index in pending if index in impossible}
        progress = Progress(comm.rank, len(pending), grid.shape, job.solver.tolerance)
        steps = _Steps(grid, interruptions, checkpoints, progress)
        if isinstance(control, Branch):
            control.monitor = steps.follow
        else:
            control.solver = partial(solve, job, steps)
        for index in [index for index in pending if index not in impossible]:
            target = imposed.targets[index]
            try:
                progress.begin(f"load {index + 1}/{count}")
                with phases("solve"), steps.of_load(index):
                    start = None if isinstance(control, Branch) and control.last else checkpoints.load(index)
                    interruptions.load_begins(resumed=start is not None)
                    if isinstance(control, Branch):
                        control.resume(start, imposed.targets[index - 1])
                    else:
                        control.resume(start)
                    solution = control.solution(target)
                    if not isinstance(control, Branch):
                        steps.solved(solution)
            except Unreachable as failure:
                if not shared(comm, failure):
                    raise
                unreachable[index] = failure
                progress.end()
                continue
            with phases("observe"):
                contact = Contact.of(surface, solution, control.displacement(solution))
                row = {"target": job.load.targets[index]} | contact.numbers
                groups = contact.measure()
                _warn_at_border(job, grid, solution)
                row |= {name: float(value) for name, value in groups.pop(TABLE, {}).items()}
            with phases("write"):
                writer.write_load(index, row, groups, contact.fields(job.output.fields, job.output.connectivity))
                checkpoints.remove()
                if isinstance(control, Branch) and index + 1 < count:
                    checkpoints.save(index + 1, solution.gap)  # from which the next load continues
            interruptions.load_done()
            interruptions.resumption = "--restart"
            progress.end()
            _report(progress, row, f"{contact.correction} {contact.area.corrected:.5f} ± {contact.area_error:.5f}")
            del solution, contact  # before the next load is solved
        if unreachable and len(unreachable) == len(pending):  # nothing was solved: earlier results stay
            raise SolverError("; ".join(map(str, unreachable.values())))
        for index in unreachable:
            writer.write_load(index, {"target": job.load.targets[index]})
        writer.finish(phases.seconds | {f"observe {name}": value for name, value in surface.seconds.items()})
    if unreachable:
        raise SolverError(f"{'; '.join(map(str, unreachable.values()))}; the other loads are written")


def _impossible(control: LoadControl | Branch, targets: Sequence[float], alone: bool) -> dict[int, InputError]:
    """The targets that are wrong input on this surface, by index; for a surface that is `alone`, or without another
    target, InputError is raised.  A seed of an ensemble solves the others, so that no load's mean lacks a seed that can
    reach it.  Collective.
    """
    found: dict[int, InputError] = {}
    for index, target in enumerate(targets):
        try:
            control.check_targets([target])
        except InputError as error:
            if not shared(control.grid.comm, error):
                raise
            found[index] = error
    if found and (alone or len(found) == len(targets)):
        raise next(iter(found.values()))
    return found


def _warn_at_border(job: Job, grid: SlabGrid, solution: ContactSolution) -> None:
    """Log a warning if pressure reaches the border of a patch that was cut out of a larger surface.  Collective."""
    if grid.domain.wraps or not job.surface.cut_out:
        return
    rows = [row - grid.rows.start for row in (0, grid.shape[0] - 1) if grid.rows.start <= row < grid.rows.stop]
    edges = [*(solution.pressure[row] for row in rows), solution.pressure[:, 0], solution.pressure[:, -1]]
    count = int(grid.reduction.sum(sum(np.count_nonzero(edge > solution.threshold) for edge in edges)))
    if count and grid.comm.rank == 0:
        log.warning(
            "%s at the border of the patch touch: what lies beyond it would take a part of their load; near the border "
            "pressures are too high", counted(count, "point"),
        )  # fmt: skip


def of_first_load(job: Job) -> str:
    """The part of a job that a checkpoint must agree with, as TOML: all but [run] and the loads after the first."""
    return as_toml(dataclasses.replace(job, run=Run(), load=job.load.imposing(job.load.targets[:1])))


def solve(
    job: Job, steps: _Steps, problem: ContactProblem, start: np.ndarray | None, tolerance: float
) -> ContactSolution:
    """One contact by the job's method.  Collective."""
    options = dataclasses.replace(job.solver, tolerance=tolerance)
    return solve_contact(problem, options, start, partial(steps.see, problem))


class _Steps:
    """Between two steps of a solver: shows progress, writes checkpoints, stops the run if asked to."""

    index: int

    def __init__(
        self, grid: SlabGrid, interruptions: Interruptions, checkpoints: Checkpoints, progress: Progress
    ) -> None:
        self.grid, self.interruptions, self.checkpoints, self.progress = grid, interruptions, checkpoints, progress
        self.transforms = 0.0

    @contextmanager
    def of_load(self, index: int) -> Iterator[None]:
        """While load number `index` is solved.  Collective."""
        self.index, self.transforms = index, self.grid.transforms
        self.interruptions.between_steps()
        try:
            yield
        finally:
            self.progress.hide()

    def see(self, problem: ContactProblem, grid: SlabGrid, state: SolverState) -> None:
        """The monitor of a solver: called after each step, on the job's grid or a coarser one.  Collective over the
        ranks that hold `grid`.
        """
        transforms = grid.transforms - (self.transforms if grid is self.grid else 0.0)
        self.progress.step(grid.shape, state.error, state.contact / grid.size, transforms)
        if grid is self.grid:
            self.interruptions.between_steps(partial(self._save, problem, state))
        elif grid.comm is self.grid.comm:
            self.interruptions.between_steps()

    def follow(self, grid: SlabGrid, state: SolverState) -> None:
        """The monitor along a branch, which restarts from its last load.  Collective."""
        self.progress.step(grid.shape, state.error, state.contact / grid.size, grid.transforms - self.transforms)
        self.interruptions.between_steps()

    def solved(self, solution: ContactSolution) -> None:
        """Called when a load is solved, before it is written.  Collective."""
        self.interruptions.between_steps(partial(self._save, None, solution))

    def _save(self, problem: ContactProblem | None, found: SolverState | ContactSolution) -> None:
        """Write a checkpoint of the pressure of a solution, or of a state in the solver's units.  Collective."""
        unit = 1.0
        if problem is not None:
            unit = problem.mean_pressure
            if problem.imposed is None:
                unit *= self.grid.size / (self.grid.reduction.sum(found.pressure) or 1.0)
        self.checkpoints.save(self.index, np.multiply(found.pressure, unit, dtype=np.float64))


def _report(progress: Progress, row: dict, corrected: str) -> None:
    if progress.active:
        log.info(
            "%s  pressure %.6g  area %.5f (%s)  kappa %.4f  error %.1e  %.1f transforms  %.2f s%s",
            progress.label, row["mean_pressure"], row["contact_area"], corrected, row["kappa"], row["certified_error"],
            row["transforms"], row["seconds"], progress.left(),
        )  # fmt: skip


class _Phases:
    """Wall seconds by name."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        began = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - began
