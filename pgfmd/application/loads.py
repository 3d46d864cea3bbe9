"""The loads of a run, one after another: solved, with progress, checkpoints and stops between steps, and written."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Mapping
from functools import partial

import numpy as np

from pgfmd.application.checkpoint import Checkpoints
from pgfmd.application.job import Job, Run, as_toml
from pgfmd.application.progress import Progress
from pgfmd.application.stop import Interruptions
from pgfmd.application.writer import ResultWriter
from pgfmd.errors import InputError, SolverError, Unreachable
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables.bottleneck import gap_percolates
from pgfmd.observables.contact import Contact
from pgfmd.observables.schema import TABLE, Groups
from pgfmd.options.text import with_error
from pgfmd.parallel.collectives import shared
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.adhesive_branch import Branch
from pgfmd.solvers.dispatch import solve_contact
from pgfmd.solvers.load_control import load_control
from pgfmd.solvers.solution import ContactSolution, SolverState

log = logging.getLogger("pgfmd")


class Loads:
    """The loads of a job on one surface.  Every method is collective.

    targets: in the units that are imposed.  pending: numbers of the loads that are still to be solved.
    unreachable: why loads have no solution, by number.
    """

    def __init__(
        self, job: Job, problem: ContactProblem, writer: ResultWriter, interruptions: Interruptions
    ) -> None:
        self.job, self.grid, self.writer, self.interruptions = job, problem.grid, writer, interruptions
        comm, grid = problem.grid.comm, problem.grid
        self.targets, self.pending = job.imposed.targets, writer.pending
        self.unreachable: dict[int, Exception] = {}
        self.progress = Progress(comm.rank, len(self.pending), grid.shape, job.solver.tolerance)
        same, hints = of_first_load(job), job.run.io_hints
        self.checkpoints = Checkpoints(comm, writer.fields_folder, grid.shape, grid.rows, same, hints)
        self.control = load_control(job.imposed, problem, job.solver.tolerance)
        if isinstance(self.control, Branch):
            self.control.monitor = self._follow
        else:
            self.control.solver, self.control.percolates = self._solve_at, gap_percolates
        self._index, self._transforms = 0, 0.0

    def refuse_impossible(self, alone: bool) -> None:
        """Find targets that are wrong input on this surface.

        For a surface that is `alone`, or without another target, raises InputError.  A seed of an ensemble solves the
        others, so that no load's mean lacks a seed that can reach it.
        """
        refused: dict[int, Exception] = {}
        for index, target in enumerate(self.targets):
            try:
                self.control.check_targets([target])
            except InputError as error:
                if not shared(self.grid.comm, error):
                    raise
                refused[index] = error
        if refused and (alone or len(refused) == len(self.targets)):
            raise next(iter(refused.values()))
        self.unreachable = {index: refused[index] for index in self.pending if index in refused}
        self.pending = [index for index in self.pending if index not in refused]

    def begin(self) -> None:
        """Make the folder ready."""
        if self.writer.replacing:  # the old results stay until the first load is written
            self.interruptions.resumption = "--overwrite"
        elif self.writer.earlier.job is None:
            self.checkpoints.remove()
        self.writer.begin()

    def solve(self, index: int) -> ContactSolution | None:
        """The contact at a load; None if no load gives it.  Raises SolverError, Stopped."""
        control, self._index, self._transforms = self.control, index, self.grid.transforms
        self.progress.begin(f"load {index + 1}/{len(self.targets)}")
        try:
            self.interruptions.between_steps()
            start = None if isinstance(control, Branch) and control.last else self.checkpoints.load(index)
            self.interruptions.load_begins(resumed=start is not None)
            if isinstance(control, Branch):
                control.resume(start, self.targets[index - 1])
                return control.solution(self.targets[index])
            control.resume(start)
            solution = control.solution(self.targets[index])
            self.interruptions.between_steps(partial(self._save, None, solution))
            return solution
        except Unreachable as failure:
            if not shared(self.grid.comm, failure):
                raise
            self.unreachable[index] = failure
            self.progress.end()
            return None
        finally:
            self.progress.hide()

    def write(self, index: int, contact: Contact, row: Mapping[str, float], groups: Groups) -> None:
        """Write what was measured on a load, and say so."""
        output = self.job.output
        if self.job.surface.whole.cut_out:
            contact.warn_at_border()
        columns = {name: float(value) for name, value in groups.get(TABLE, {}).items()}
        curves = {title: table for title, table in groups.items() if title != TABLE}
        fields = contact.fields(output.fields, output.connectivity)
        self.writer.write_load(index, {"target": self.job.load.targets[index], **row, **columns}, curves, fields)
        self.checkpoints.remove()
        if isinstance(self.control, Branch) and index + 1 < len(self.targets):
            self.checkpoints.save(index + 1, contact.gap)  # from which the next load continues
        self.interruptions.load_done()
        self.interruptions.resumption = "--restart"
        self.progress.end()
        correction, area, area_error = contact.correction, contact.area.corrected, contact.area_error  # collective
        if self.progress.active:
            log.info(
                "%s  pressure %.6g  area %.5f (%s %s)  kappa %.4f  error %.1e  %.1f transforms  %.2f s%s",
                self.progress.label, row["mean_pressure"], row["contact_area"], correction,
                with_error(area, area_error), row["kappa"], row["certified_error"], row["transforms"],
                row["seconds"], self.progress.left(),
            )  # fmt: skip

    def finish(self, phases: dict[str, float]) -> None:
        """Mark the run as complete.  If nothing was solved, raises SolverError, and earlier results stay."""
        if self.unreachable and all(index in self.unreachable for index in self.pending):
            raise SolverError("; ".join(map(str, self.unreachable.values())))
        for index in self.unreachable:
            self.writer.write_load(index, {"target": self.job.load.targets[index]})
        self.writer.finish(phases)

    def raise_unreachable(self) -> None:
        """Raise SolverError if some loads have no solution."""
        if self.unreachable:
            reasons = "; ".join(map(str, self.unreachable.values()))
            raise SolverError(f"{reasons}; the other loads are written")

    def _solve_at(self, problem: ContactProblem, start: np.ndarray | None, tolerance: float) -> ContactSolution:
        """One contact by the job's method."""
        options = dataclasses.replace(self.job.solver, tolerance=tolerance)
        return solve_contact(problem, options, start, partial(self._see, problem))

    def _see(self, problem: ContactProblem, grid: SlabGrid, state: SolverState) -> None:
        """The monitor of a solver: called after each step, on the job's grid or a coarser one.  Collective over the
        ranks that hold `grid`.
        """
        transforms = grid.transforms - (self._transforms if grid is self.grid else 0.0)
        self.progress.step(grid.shape, state.error, state.contact / grid.size, transforms)
        if grid is self.grid:
            self.interruptions.between_steps(partial(self._save, problem, state))
        elif grid.comm is self.grid.comm:
            self.interruptions.between_steps()

    def _follow(self, grid: SlabGrid, state: SolverState) -> None:
        """The monitor along a branch, which restarts from its last load."""
        self.progress.step(grid.shape, state.error, state.contact / grid.size, grid.transforms - self._transforms)
        self.interruptions.between_steps()

    def _save(self, problem: ContactProblem | None, state: SolverState | ContactSolution) -> None:
        """Write a checkpoint of the pressure of a solution, or of a state in the solver's units."""
        unit = 1.0
        if problem is not None:
            unit = problem.mean_pressure
            if problem.imposed is None:
                unit *= self.grid.size / (self.grid.reduction.sum(state.pressure) or 1.0)
        self.checkpoints.save(self._index, np.multiply(state.pressure, unit, dtype=np.float64))


def of_first_load(job: Job) -> str:
    """The part of a job that a checkpoint must agree with, as TOML: all but [run] and the loads after the first."""
    return as_toml(dataclasses.replace(job, run=Run(), load=job.load.imposing(job.load.targets[:1])))
