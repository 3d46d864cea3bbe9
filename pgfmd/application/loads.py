"""The loads of a run, one after another: solving, with progress, checkpoints and stops between steps, and writing.

A checkpoint, fields/checkpoint.h5, holds the latest pressure (nx, ny) of a load that is not solved yet, its index and
the effective job.  Any number of ranks reads it.  A damaged one only costs time: every solver certifies its result.
"""

import dataclasses
import logging
import math
import os
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import h5py
import numpy as np

from pgfmd.application import hdf5_slabs
from pgfmd.application.files import CHECKPOINT_FILE, Form, temporary
from pgfmd.application.job import Job, Run, as_toml
from pgfmd.application.progress import Progress
from pgfmd.application.stop import Interruptions
from pgfmd.application.writer import ResultWriter
from pgfmd.errors import InputError, SolverError, Unreachable
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables.contact import Contact
from pgfmd.observables.percolation import gap_percolates
from pgfmd.observables.schema import TABLE, Groups
from pgfmd.options.text import with_error
from pgfmd.parallel.collectives import Reduction, from_root, raise_together, shared
from pgfmd.parallel.mpi import MPI
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.adhesive_branch import Branch
from pgfmd.solvers.dispatch import solve_contact
from pgfmd.solvers.load_control import load_control
from pgfmd.solvers.solution import ContactSolution, SolverState, pressure_in_place

log = logging.getLogger("pgfmd")
ROUNDING = 1e-9  # relative; sums over 2⁵⁰ points on different rank counts differ by far less


class Checkpoints:
    """The checkpoint in a folder of fields.  Every method is collective.

    job: a text that identifies the job, as checkpoints of others are ignored.
    """

    def __init__(self, comm: MPI.Comm, folder: str | os.PathLike, form: Form, job: str) -> None:
        self.comm, self.form, self.job = comm, form, job
        self.path = Path(folder) / CHECKPOINT_FILE

    def save(self, index: int, pressure: np.ndarray) -> None:
        """Write the pressure (nx_local, ny), in any unit, of the unfinished load `index`.  Collective.

        The last checkpoint stays until this one is whole and on the disk.  Raises OSError on all ranks.
        """
        total = self._total(pressure)

        def create(file: h5py.File, name: str) -> h5py.Dataset:
            file.attrs.update(software="pgfmd", load=index, job=self.job, total=total)
            return hdf5_slabs.create_dataset(file, name, self.form.shape, pressure.dtype)

        fields = {"pressure": hdf5_slabs.Field(pressure, pressure.dtype)}
        hdf5_slabs.replace_by(self.comm, self.form, self.path, fields, create)

    def load(self, index: int) -> np.ndarray | None:
        """Pressure (nx_local, ny) of load `index`, in any unit; None if there is none or it is damaged.  Collective."""
        total = from_root(self.comm, self._total_of, index)
        if total is None:
            return None
        try:
            with raise_together(self.comm), h5py.File(self.path, "r", locking=False) as file:
                pressure = file["pressure"][self.form.rows]
                if pressure.shape[1] != self.form.shape[1]:
                    raise OSError("another shape")
        except Exception as error:  # raised on all ranks
            log.warning("%s: %s; it is not used", self.path, error)
            return None
        if not math.isclose(self._total(pressure), total, rel_tol=ROUNDING):
            log.warning("%s: damaged: its pressure is not the one that was written; it is not used", self.path)
            return None
        log.info("load %d continues from its checkpoint", index + 1)
        return pressure

    def remove(self) -> None:
        """Remove the checkpoint.  Collective."""
        for path in (self.path, temporary(self.path)):
            from_root(self.comm, path.unlink, True)

    def _total(self, pressure: np.ndarray) -> float:
        """Σ |p| over all points to twelve digits, which hardly depend on the number of ranks.  Collective."""
        return float(f"{Reduction(self.comm).sum(np.abs(pressure)):.11e}")

    def _total_of(self, index: int) -> float | None:
        """Σ |p| as the checkpoint gives it; None unless it is of that load of this job.  Rank 0."""
        if not self.path.exists():
            return None
        try:
            with h5py.File(self.path, "r", locking=False) as file:
                same = file.attrs["load"] == index and file.attrs["job"] == self.job
                return float(file.attrs["total"]) if same else None
        except Exception as error:  # whatever HDF5 makes of a damaged file
            log.warning("%s: %s; it is not used", self.path, error)
            return None


class Loads:
    """The loads of a job on one surface.  Every method is collective.

    targets: values of the imposed quantity; pending: indices of the loads that are still to be solved; unreachable:
    index of a load without a solution → the error that says why.
    """

    def __init__(self, job: Job, problem: ContactProblem, writer: ResultWriter, interruptions: Interruptions) -> None:
        self.job, self.grid, self.writer, self.interruptions = job, problem.grid, writer, interruptions
        comm, grid = problem.grid.comm, problem.grid
        self.targets, self.pending = job.imposed.targets, writer.pending
        self.unreachable: dict[int, Exception] = {}
        self.progress = Progress(comm.rank, len(self.pending), grid.shape, job.solver.tolerance)
        # A checkpoint belongs to jobs that agree in all but [run] and the loads after the first.
        same = dataclasses.replace(job, run=Run(), load=job.load.imposing(job.load.targets[:1]))
        self.checkpoints = Checkpoints(comm, writer.fields_folder, writer.form, as_toml(same))
        self.control = load_control(job.imposed, problem, job.solver.tolerance)
        if isinstance(self.control, Branch):
            self.control.monitor = self._follow
        else:
            self.control.solver, self.control.percolates = self._solve_at, gap_percolates
        self._index, self._transforms = 0, 0.0

    def refuse_impossible(self, alone: bool) -> None:
        """Find targets that are wrong input on this surface.

        Raises InputError if the run is `alone`, or no other target is left.  A seed of an ensemble solves the others,
        so that each load's mean has all seeds that can reach it.
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
                self._transforms = control.contact.grid.transforms
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
        """Write the measurements of a load and its fields, and log a line."""
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

    def release(self) -> None:
        """Drops the control, to be called last: it holds `_solve_at`, a reference cycle that would keep the fields."""
        del self.control

    def _solve_at(self, problem: ContactProblem, start: np.ndarray | None, tolerance: float) -> ContactSolution:
        """One contact by the job's method."""
        options = dataclasses.replace(self.job.solver, tolerance=tolerance)
        return solve_contact(problem, options, start, partial(self._see, problem))

    def _see(self, problem: ContactProblem, grid: SlabGrid, state: SolverState) -> None:
        """Monitor of a solver: after each step, on the job's grid or a coarser one.  Collective on `grid`."""
        transforms = grid.transforms - (self._transforms if grid is self.grid else 0.0)
        self.progress.step(grid.shape, state.error, state.contact / grid.size, transforms)
        if grid is self.grid:
            self.interruptions.between_steps(partial(self._save, problem, state))
        elif grid.comm is self.grid.comm:
            self.interruptions.between_steps()

    def _follow(self, grid: SlabGrid, state: SolverState) -> None:
        """Monitor along a branch, which restarts from its last load: no checkpoints within a load."""
        assert isinstance(self.control, Branch)
        # Those of the torus, if boundaries are open; without those of probes.
        transforms = self.control.contact.grid.transforms - self._transforms
        self.progress.step(grid.shape, state.error, state.contact / grid.size, transforms)
        self.interruptions.between_steps()

    def _save(self, problem: ContactProblem | None, state: SolverState | ContactSolution) -> None:
        """Write a checkpoint of the pressure: of a solution, or (problem given) of a state in the solver's units."""
        unit = 1.0
        if problem is not None:
            unit = problem.mean_pressure
            if problem.imposed is None:
                unit *= self.grid.size / (self.grid.reduction.sum(state.pressure) or 1.0)
        pressure = state.pressure if isinstance(state, ContactSolution) else pressure_in_place(self.grid, state)
        self.checkpoints.save(self._index, np.multiply(pressure, unit, dtype=self.grid.storage))
