"""The files of a run, each complete at every instant.

    observables.h5          small: one row per load, groups of curves and tables, provenance (`tables`)
    fields.h5, fields.vtkhdf, fields/       views of all fields; fields and large groups (`field_files`)
    fields/checkpoint.h5    of an unfinished load (`loads`)
    SHA256SUMS              checksums of all but the checkpoint and large fields, which hold checksums of their rows

With `overwrite`, the new fields go to fields-2/ if the old ones are in fields/, and the other way round.  The old
results stay whole until the first new load is complete.  Then the two views are removed, observables.h5 is replaced by
one rename, the old fields are removed, and the views are written anew.  So they show fields of its results alone.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np

from pgfmd.application import files, hdf5_slabs, machine, restart, tables
from pgfmd.application.field_files import FieldFiles
from pgfmd.application.files import SMALL, Change, Form, OutputFolder, Sums, load_name
from pgfmd.application.machine import Origin
from pgfmd.application.restart import EarlierResults
from pgfmd.errors import InputError, Stopped
from pgfmd.observables.schema import TABLE, Groups
from pgfmd.options.text import reason
from pgfmd.parallel.collectives import from_root, raise_together
from pgfmd.parallel.mpi import MPI, library

log = logging.getLogger("pgfmd")

Mode = Literal["new", "overwrite", "restart"]


class ResultWriter:
    """Writes one run's folder; a context manager.  Every method is collective.

    directory : made if missing; origin : of the provenance; form : layout of the files
    mode : "overwrite" replaces results that are there, "restart" continues them; "new" refuses them

    The constructor checks and locks the folder, and writes nothing.  It raises InputError on all ranks if the folder
    cannot be written, is in use, or holds results or files that must not be replaced.

    completed : number of loads up to the last one written (earlier ones may be `pending`)
    earlier : the results that are continued; replacing : whether there are old results, which the first load replaces
    """

    def __init__(
        self, comm: MPI.Comm, directory: str | os.PathLike, origin: Origin, form: Form, mode: Mode = "new"
    ) -> None:
        self.comm, self.directory, self.origin, self.form, self._mode = comm, Path(directory), origin, form, mode
        self._begun = False
        self._lock: OutputFolder | None = None
        self.earlier, self.replacing = from_root(comm, self._open_folder)
        self.completed = self.earlier.completed
        self._written = self.earlier.fields.keys() - self.earlier.damaged  # loads whose files are undamaged
        self._provenance = cache(self._gather)
        self._observables = self.directory / files.OBSERVABLES_FILE
        self._fields = FieldFiles(comm, self.directory, self.earlier.folder, form, self._provenance)
        self._fields.links.update(self.earlier.links())
        self.fields_folder = self.directory / self.earlier.folder
        self._sums = Sums(self.directory)
        try:
            with raise_together(comm):  # all ranks must see the folder
                if not (self.directory / files.LOCK_NAME).exists():
                    raise InputError(f"{self.directory}: rank {comm.rank} does not see the folder that rank 0 made")
        except BaseException as error:
            self.__exit__(type(error), error, None)
            raise
        if comm.size > 1:
            how = "through HDF5" if hdf5_slabs.is_collective(comm) else "each at its place (h5py has no MPI)"
            log.info("fields are written by all ranks, %s", how)

    def _open_folder(self) -> tuple[EarlierResults, bool]:
        """Lock the folder; what to continue, with the folder of fields, and whether results are replaced.  Rank 0."""
        folder = OutputFolder(self.directory)
        try:
            if (self.directory / files.ENSEMBLE_FILE).exists():
                raise InputError(f"{self.directory}: holds an ensemble; choose another folder for one surface")
            there = [name for name in (*SMALL, files.FIELDS_FOLDER) if (self.directory / name).exists()]
            if there and self._mode == "new":
                raise InputError(
                    f"{self.directory}: holds results already ({', '.join(there)}); replace them with "
                    "--overwrite, continue them with --restart, or choose another folder"
                )
            earlier, results = EarlierResults(), files.OBSERVABLES_FILE in there
            if results and self._mode == "restart":
                earlier = restart.read(self.directory)
            elif results:
                earlier.folder = restart.other_folder(self.directory)
            restart.refuse_foreign(self.directory, earlier.folder)
            self._lock = folder
            return earlier, results and self._mode == "overwrite"
        finally:
            if self._lock is None:
                folder.release()

    @property
    def pending(self) -> list[int]:
        """The loads that are still to be solved: not completed, or their fields damaged."""
        return [index for index in range(self.origin.loads) if load_name(index) not in self._written]

    def begin(self) -> None:
        """Removes leftovers of interrupted runs; starts or continues observables.h5, unless it is to be replaced later.
        A second call does nothing.  Collective.
        """
        if not self._begun:
            with self._changing(*[] if self.replacing else SMALL):
                from_root(self.comm, self._remove_leftovers)
                if not self.replacing:
                    write = files.create if self.earlier.job is None else files.revise
                    from_root(self.comm, write, self._observables, self._describe)
            self._begun = True

    @contextmanager
    def _changing(self, *names: str) -> Iterator[None]:
        """Removes the lines of these files from SHA256SUMS, and writes them after the block.  Collective."""
        from_root(self.comm, self._sums.forget, *names)
        yield
        from_root(self.comm, self._sums.note, *names)

    def write_heights(self, heights: np.ndarray) -> None:
        """Write the heights, this rank's rows (nx_local, ny).  OSError on all ranks if it fails.  Collective."""
        self.begin()
        small = [] if self.replacing else [files.FIELDS_FILE, files.VTK_FILE]
        with self._changing(f"{self._fields.folder}/height.h5", *small):
            self._fields.write("height", {"height": heights}, show=not self.replacing)

    def write_load(
        self,
        index: int,
        row: dict[str, float],
        groups: Groups | None = None,
        fields: dict[str, np.ndarray] | None = None,
    ) -> None:
        """Write one completed load: first its fields and large groups, then its row and the others in one step.
        Collective.

        row : values of `form.columns` (missing: NaN); groups : arrays that `form.groups` describes, those of rank 0
        fields : this rank's slabs (nx_local, ny), same names on all ranks
        Raises OSError on all ranks if it cannot be written.
        """
        self.begin()
        name, groups = load_name(index), groups or {}
        large = [title for title, each in groups.items() if tables.is_large(each)]
        own_files = {title: f"{self._fields.folder}/{name}_{title}.h5" for title in large}

        def write_large() -> None:
            for title, path in own_files.items():
                self._fields.write_table(path, title, groups[title])

        def add(file: h5py.File) -> None:
            tables.add_row(file[TABLE], index, row, self.form)
            group = tables.add_groups(file, index, groups, self.form, own_files)
            group.attrs["fields"] = np.array(sorted(fields or {}), h5py.string_dtype())

        with self._changing(f"{self._fields.folder}/{name}.h5", *own_files.values(), *SMALL):
            from_root(self.comm, write_large)
            if fields:
                self._fields.write(name, fields, show=not self.replacing)
            from_root(self.comm, self._replace if self.replacing else self._revise, add)
            if index < self.completed:  # solved again: what was large may be small
                from_root(self.comm, self._fields.remove_tables, name, own_files.values())
        self.replacing = False
        self.completed = max(self.completed, index + 1)
        self._written.add(name)

    def finish(self, phases: dict[str, float] | None = None) -> None:
        """Mark the run as complete; `phases` are seconds by name, of rank 0.  Collective."""
        self.begin()

        def mark(file: h5py.File) -> None:
            file.attrs.update(status="complete", finished=machine.now())
            file.require_group("phases").attrs.update({name: float(value) for name, value in (phases or {}).items()})

        with self._changing(files.OBSERVABLES_FILE):
            from_root(self.comm, self._revise, mark)

    def __enter__(self) -> ResultWriter:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        """Release the folder.  Not collective: it also runs where one rank alone has failed."""
        if self._lock is None:
            return
        if self._begun and error is not None:
            with suppress(Exception):  # the disk may have failed: report the first error
                self._note_failure(error)
        self._lock.release()
        self._lock = None

    # Rank 0.

    def _note_failure(self, error: BaseException) -> None:
        """Write status and error into observables.h5; if that still holds old results, remove the new files instead."""
        if self.replacing:
            self._fields.remove(self._fields.folder, and_checkpoint=not isinstance(error, Stopped))
            self._sums.note()
            return
        status = "stopped" if isinstance(error, Stopped) else "failed"
        message = reason(error)[:1000]
        self._sums.forget(files.OBSERVABLES_FILE)
        self._revise(lambda file: file.attrs.update(status=status, error=message))
        self._sums.note(*SMALL)

    def _remove_leftovers(self) -> None:
        """Remove what interrupted runs left behind, and fields that belong to no results in observables.h5."""
        for name in (*SMALL, files.SUMS_FILE):
            files.temporary(self.directory / name).unlink(missing_ok=True)
        self._fields.begin(bool(self.earlier.fields) or bool(self._fields.links))
        if not self.replacing:
            self._fields.remove_replaced()
            self._fields.write_views()

    def _revise(self, change: Change) -> None:
        files.revise(self._observables, change)

    def _replace(self, change: Change) -> None:
        """Replace the old results by those of this run, to which `change` adds the first load."""

        def fill(file: h5py.File) -> None:
            self._describe(file)
            change(file)

        self._fields.remove_views()
        files.create(self._observables, fill)
        self._fields.remove_replaced()
        self._fields.write_views()

    def _describe(self, file: h5py.File) -> None:
        """Write the provenance and the status "running" into observables.h5."""
        about = self._provenance()
        if self.earlier.job is None:
            file.attrs.update(about)
        else:
            line = f"from load {self.earlier.completed} on: " + " ".join(
                f"{name} {about[name]}" for name in ("date", "commit", "host", "ranks", "threads")
            )
            file.attrs["continued"] = "\n".join(filter(None, [str(file.attrs.get("continued", "")), line]))
            file.attrs.update({name: about[name] for name in ("job_toml", "effective_toml")})
        columns, units = self.form.columns, self.form.units
        tables.add_columns(file.require_group(TABLE), self.earlier.completed, columns, units)
        file.attrs.pop("error", None)
        file.attrs.update(status="running", loads_requested=self.origin.loads)

    def _gather(self) -> dict[str, Any]:
        libraries = {"HDF5": hdf5_slabs.version(), "MPI": library()}
        about = machine.gather(self.comm.size, libraries, self.origin)
        return about | {"shape": self.form.shape, "lengths": self.form.lengths, "fields_folder": self._fields.folder}
