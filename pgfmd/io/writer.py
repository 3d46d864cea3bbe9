"""The files of a run, each complete at every instant.

    observables.h5          small: one row per load, groups of curves and tables, provenance
    fields.h5               shows the big fields together: height, load_0000/pressure, …; open this one to read them
    fields.vtkhdf           shows them to ParaView
    fields/height.h5, fields/load_0000.h5, …        where they are

Every one of them ends in a seal (module `checksum`), so that a damaged file can be recognised.

With `overwrite`, the new fields go to fields-2/ if the old ones are in fields/, and the other way round.  The old
results stay whole until the first new load is complete.  Then fields.h5 and fields.vtkhdf are removed, observables.h5
is replaced by one rename, the old fields are removed, and the two are written anew.  So they never show fields that are
not those of observables.h5.
"""

from __future__ import annotations

import io
import logging
import os
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Literal

import h5py
import numpy as np

from pgfmd.errors import InputError, Stopped
from pgfmd.io import atomic, hdf5_slabs, provenance, restart, views
from pgfmd.io.dimensions import add_grid_axes, name_axes
from pgfmd.io.provenance import Origin
from pgfmd.io.restart import EarlierResults
from pgfmd.io.schema import (
    CHECKPOINT_FILE,
    ENSEMBLE_FILE,
    FIELDS,
    FIELDS_FILE,
    FIELDS_FOLDER,
    LOADS,
    OBSERVABLES_FILE,
    VTK_FILE,
    Groups,
    Layout,
    load_name,
)  # fmt: skip
from pgfmd.parallel.collectives import Reduction, from_root, raise_together
from pgfmd.parallel.mpi import MPI, library

log = logging.getLogger("pgfmd")

Mode = Literal["new", "overwrite", "restart"]


@dataclass(frozen=True)
class Form:
    """The form of the files: shape (nx, ny) and lengths (lx, ly) of the global grid, the slice of its rows that this
    rank holds, the precision of real fields in the file, names of units, and the layout of the groups of a load.
    """

    shape: tuple[int, int]
    lengths: tuple[float, float]
    rows: slice
    precision: str = "float64"
    length_unit: str = "length"
    pressure_unit: str = "pressure"
    groups: Layout = field(default_factory=dict)

    @property
    def units(self) -> dict[str, str]:
        """Names of units by what they measure, for `schema`."""
        return {"length": self.length_unit, "pressure": self.pressure_unit}


class ResultWriter:
    """Writes one run's folder; a context manager.  Every method is collective.

    comm : communicator; directory : the folder, made if missing; origin : what is written about the run;  form : the
    form of its files
    mode : "overwrite" replaces results that are there, "restart" continues them; "new" refuses them
    patience : seconds within which changes of observables.h5 are put together, so that runs of moments write it once;
    then it is left to the caller to sync it to the disk

    Making one checks and locks the folder, and writes nothing.  Raises InputError on all ranks if the folder cannot be
    written, is in use, or holds results or files that are not to be replaced.

    completed : number of loads up to the last one written (earlier ones may be `pending`)
    earlier : the results that are continued
    replacing : whether old results are still there, which the first load will replace
    """

    def __init__(
        self,
        comm: MPI.Comm,
        directory: str | os.PathLike,
        origin: Origin,
        form: Form,
        mode: Mode = "new",
        patience: float = 0.0,
    ):
        self.comm, self.directory, self.origin, self.form, self._mode = comm, Path(directory), origin, form, mode
        self._begun = False
        self._changes: list[Callable[[h5py.File], None]] = []
        self._patience, self._last_change = patience, time.monotonic()
        self._folder: atomic.OutputFolder | None = None
        self.earlier, self.replacing, self._fields = from_root(comm, self._open_folder)
        self.completed = self.earlier.completed
        self._links = self.earlier.links()
        self._shown: dict[str, views.Shown] = {}
        self._written = self.earlier.fields.keys() - self.earlier.damaged
        try:
            with raise_together(comm):  # a folder that only rank 0 sees is of no use
                if not (self.directory / atomic.LOCK_NAME).exists():
                    raise InputError(f"{self.directory}: rank {comm.rank} does not see the folder that rank 0 made")
        except BaseException as error:
            self.__exit__(type(error), error, None)
            raise
        if comm.size > 1:
            how = "through HDF5" if hdf5_slabs.is_collective(comm) else "each at its place (h5py has no MPI)"
            log.info("fields are written by all ranks, %s", how)

    def _open_folder(self) -> tuple[EarlierResults, bool, str]:
        """Lock the folder.  Returns the results to continue, whether others are replaced, and the
        folder of fields.  Rank 0.
        """
        folder = atomic.OutputFolder(self.directory)
        try:
            if (self.directory / ENSEMBLE_FILE).exists():
                raise InputError(f"{self.directory}: holds an ensemble; choose another folder for one surface")
            found = [
                name
                for name in (OBSERVABLES_FILE, FIELDS_FILE, VTK_FILE, FIELDS_FOLDER)
                if (self.directory / name).exists()
            ]
            if found and self._mode == "new":
                raise InputError(
                    f"{self.directory}: holds results already ({', '.join(found)}); replace them with "
                    "--overwrite, continue them with --restart, or choose another folder"
                )
            earlier, fields = EarlierResults(), FIELDS_FOLDER
            replacing = self._mode == "overwrite" and OBSERVABLES_FILE in found
            if self._mode == "restart" and OBSERVABLES_FILE in found:
                earlier = restart.read(self.directory)
                fields = earlier.folder
            elif replacing:
                fields = restart.other_folder(self.directory)
            restart.refuse_foreign(self.directory, fields)
            self._folder = folder
            return earlier, replacing, fields
        finally:
            if self._folder is None:
                folder.release()
                folder.discard()

    @property
    def pending(self) -> list[int]:
        """The loads that are still to be solved: not completed, or their fields damaged."""
        return [index for index in range(self.origin.loads) if load_name(index) not in self._written]

    def begin(self) -> None:
        """Remove what interrupted runs left behind; then, unless old results are still to be replaced, start or
        continue observables.h5.  Called again, it does nothing.  Collective.
        """
        if not self._begun:
            from_root(self.comm, self._remove_leftovers)
            if not self.replacing:
                from_root(self.comm, self._revise_observables, partial(self._prepare_observables, self.completed))
            self._begun = True

    def write_field(
        self, name: str, local: np.ndarray, description: str | None = None, units: str | None = None
    ) -> None:
        """Write a field that belongs to no load, e.g. the heights.  Collective.

        local : this rank's slab (nx_local, ny)
        Raises OSError on all ranks if it cannot be written.
        """
        self.begin()
        self._write_slabs(f"{name}.h5", {name: local}, description, units)
        self._link({name: (f"{name}.h5", name)})

    def write_load(
        self,
        index: int,
        row: dict[str, float],
        groups: Groups | None = None,
        fields: dict[str, np.ndarray] | None = None,
    ) -> None:
        """Write one completed load: first its fields, then its row and groups in one step.  Collective.

        row : values of `schema.LOADS` (missing: NaN); groups : arrays that `form.groups` describes, written as rank 0
        has them
        fields : this rank's slabs (nx_local, ny), same names on all ranks
        Raises OSError on all ranks if it cannot be written.
        """
        self.begin()
        name = load_name(index)
        if fields:
            self._write_slabs(f"{name}.h5", fields)
            self._link({f"{name}/{key}": (f"{name}.h5", key) for key in fields})

        def add(file: h5py.File) -> None:
            self._add_row(file["loads"], index, row)
            if name in file:
                del file[name]
            group = file.create_group(name)
            for title, table in (groups or {}).items():
                self._add_group(group, title, table)
            group.attrs["fields"] = np.array(sorted(fields or {}), h5py.string_dtype())

        from_root(self.comm, self._replace if self.replacing else self._revise_observables, add)
        self.replacing = False
        self.completed = max(self.completed, index + 1)
        self._written.add(name)

    def finish(self, phases: dict[str, float] | None = None) -> None:
        """Mark the run as complete; `phases` are seconds by name, of rank 0.  Collective."""
        self.begin()

        def mark(file: h5py.File) -> None:
            file.attrs.update(status="complete", finished=provenance.now())
            file.require_group("phases").attrs.update({name: float(value) for name, value in (phases or {}).items()})

        from_root(self.comm, self._revise_observables, mark, True)

    def __enter__(self) -> ResultWriter:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        """Release the folder.  Not collective: it also runs where one rank alone has failed."""
        if self._folder is None:
            return
        if self._begun and error is not None:
            with suppress(OSError):  # the disk may be what has failed; the first error is the one to report
                self._note_failure(error)
        self._folder.release()
        if not self._begun:
            self._folder.discard()
        self._folder = None

    # Rank 0: small files, each replaced as a whole.

    def _note_failure(self, error: BaseException) -> None:
        """Write into observables.h5 how the run ended.  If that still holds the old results, remove the new
        files instead.
        """
        if self.replacing:
            self._remove_fields(self._fields)
            if not isinstance(error, Stopped):
                atomic.beside(self.directory / CHECKPOINT_FILE).unlink(missing_ok=True)
            return
        status = "stopped" if isinstance(error, Stopped) else "failed"
        message = (str(error) or type(error).__name__)[:1000]
        self._revise_observables(lambda file: file.attrs.update(status=status, error=message), now=True)

    def _remove_leftovers(self) -> None:
        """Remove what interrupted runs left behind, and fields that belong to no results in observables.h5."""
        drafts = [*self.directory.glob(".*.h5.tmp"), *(self.directory / self._fields).glob(".*.h5.tmp")]
        for draft in (*drafts, atomic.temporary(self.directory / VTK_FILE)):
            draft.unlink(missing_ok=True)
        if not self._links:
            self._remove_fields(self._fields)
        (self.directory / self._fields).mkdir(exist_ok=True)
        if not self.replacing:
            self._remove_replaced()
            self.earlier.settle()
            self._write_views()

    def _remove_replaced(self) -> None:
        """Remove the fields of the replaced results, and what shows them."""
        self._remove_views()
        for folder in set(restart.FIELDS_FOLDERS) - {self._fields}:
            self._remove_fields(folder)

    def _remove_fields(self, folder: str) -> None:
        """Remove the files of fields that this program wrote, and the folder if nothing else is in it."""
        for path in restart.own_field_files(self.directory / folder):
            path.unlink(missing_ok=True)
        with suppress(OSError):
            (self.directory / folder).rmdir()

    def _replace(self, change: Callable[[h5py.File], None]) -> None:
        """Put the results of this run in the place of the old ones."""
        path = self.directory / OBSERVABLES_FILE

        def describe(file: h5py.File) -> None:
            self._prepare_observables(self.completed, file)
            change(file)

        self._remove_views()
        atomic.previous(path).unlink(missing_ok=True)
        _revise(path, describe, anew=True)
        self._remove_replaced()
        self._write_views()

    def _revise_observables(self, change: Callable[[h5py.File], None], now: bool = False) -> None:
        """Change observables.h5: at once if asked to, or if the last change is longer ago than the patience."""
        self._changes.append(change)
        if now or time.monotonic() - self._last_change >= self._patience:
            changes, self._changes = self._changes, []

            def apply(file: h5py.File) -> None:
                for each in changes:
                    each(file)

            path, units = self.directory / OBSERVABLES_FILE, self.form.units
            _revise(path, apply, _without_loads(*units.values()), keep=True, sync=not self._patience)
            self._last_change = time.monotonic()

    def _link(self, targets: dict[str, tuple[str, str]]) -> None:
        """Show more fields, name → (file, dataset), once fields.h5 is this run's.  Collective."""
        self._links |= targets
        for name in targets:
            self._shown.pop(name, None)
        if not self.replacing:
            from_root(self.comm, self._write_views)

    def _remove_views(self) -> None:
        for name in (FIELDS_FILE, VTK_FILE):
            (self.directory / name).unlink(missing_ok=True)

    def _write_views(self) -> None:
        """Write fields.h5 and fields.vtkhdf anew, if there are fields."""
        if not self._links:
            return
        for name, (target, dataset) in self._links.items():
            if name not in self._shown:
                self._shown[name] = views.described(self.directory, f"{self._fields}/{target}", dataset)
        view = views.View(self.form.shape, self.form.lengths, self.form.length_unit, self._shown)
        for file_name, fill in ((FIELDS_FILE, view.write_netcdf), (VTK_FILE, view.write_vtk)):
            self._write_view(file_name, fill)

    def _write_view(self, name: str, fill: Callable[[h5py.File], None]) -> None:
        def describe(file: h5py.File) -> None:
            file.attrs.update(self._provenance)
            fill(file)

        _revise(self.directory / name, describe, anew=True)

    def _prepare_observables(self, completed: int, file: h5py.File) -> None:
        if self.earlier.job is None:
            file.attrs.update(self._provenance)
        else:
            line = f"from load {completed} on: " + " ".join(
                f"{name} {self._provenance[name]}" for name in ("date", "commit", "host", "ranks", "threads")
            )
            file.attrs["continued"] = "\n".join(filter(None, [str(file.attrs.get("continued", "")), line]))
            file.attrs.update({name: self._provenance[name] for name in ("job_toml", "effective_toml")})
        _add_columns(file.require_group("loads"), completed, self.form.units)
        file.attrs.pop("error", None)
        file.attrs.update(status="running", loads_requested=self.origin.loads)

    @cached_property
    def _provenance(self) -> dict:
        libraries = {"HDF5": hdf5_slabs.version(), "MPI": library()}
        found = provenance.gather(self.comm.size, libraries, self.origin)
        return found | {"shape": self.form.shape, "lengths": self.form.lengths, "fields_folder": self._fields}

    def _add_row(self, group: h5py.Group, index: int, row: dict[str, float]) -> None:
        unknown = row.keys() - LOADS.keys()
        if unknown:
            raise ValueError(f"not in schema.LOADS: {', '.join(sorted(unknown))}")
        for name, value in {"load": index, **dict.fromkeys(LOADS), **row}.items():
            column = group[name]
            column.resize((max(index + 1, len(column)),))
            if value is not None:
                column[index] = value

    def _add_group(self, load: h5py.Group, title: str, table: Mapping[str, np.ndarray]) -> None:
        for key, values in table.items():
            about = self.form.groups[title][key]
            self._annotate(load.create_dataset(f"{title}/{key}", data=values), about.description, about.unit)
        for key in table:
            name_axes(load[title], key, self.form.groups[title][key].axes)

    def _annotate(self, dataset: h5py.Dataset, description: str, units: str) -> None:
        dataset.attrs.update(description=description, units=units.format(**self.form.units))

    # All ranks: the big fields, each in a file of its own, in one piece on the disk.

    def _write_slabs(
        self, name: str, fields: dict[str, np.ndarray], description: str | None = None, units: str | None = None
    ) -> None:
        """Write `fields` under a temporary name, then rename the file to `name`.  Collective."""
        form, slabs = self.form, {}
        for key, local in fields.items():
            slabs[key] = hdf5_slabs.Field(local, self._stored(key, local))
        with raise_together(self.comm):
            expected = (form.rows.stop - form.rows.start, form.shape[1])
            for key, local in fields.items():
                if local.shape != expected:
                    raise ValueError(f"field {key}: slab of shape {local.shape}, expected {expected}")

        def create(file: h5py.File, key: str) -> h5py.Dataset:
            # No date: the same numbers make the same bytes.
            known = ("software", "softwareVersion", "commit", "format_version")
            file.attrs.update({attribute: self._provenance[attribute] for attribute in known})
            dataset = hdf5_slabs.create_dataset(file, key, form.shape, slabs[key].dtype)
            schema_units, schema_text = FIELDS.get(key, ("1", key))
            self._annotate(dataset, description or schema_text, units or schema_units)
            add_grid_axes(file, form.shape, form.lengths, form.length_unit)
            name_axes(file, key, ("x", "y"))
            return dataset

        path = self.directory / self._fields / name
        hdf5_slabs.replace_by(self.comm, path, form.rows, slabs, create, False)


    def _stored(self, name: str, local: np.ndarray) -> np.dtype:
        """The type of a field in the file: the job's precision for real ones, or double where the field would overflow
        in that, or be lost below its smallest numbers.  Collective.
        """
        if not np.issubdtype(local.dtype, np.floating):
            return local.dtype
        asked, reduction = np.dtype(self.form.precision), Reduction(self.comm)
        largest, limits = max(reduction.max(local), -reduction.min(local)), np.finfo(asked)
        if largest == 0 or float(limits.tiny) / float(limits.eps) <= largest <= float(limits.max):
            return asked
        if self.comm.rank == 0 and asked != np.float64:
            log.info("%s is written in float64: %s does not hold values of %.1e", name, asked, largest)
        return np.dtype(np.float64)


def _add_columns(group: h5py.Group, completed: int, units: Mapping[str, str]) -> None:
    """Make the columns of the table of loads that are not there: an earlier version may not have written all."""
    columns = {"load": ("1", "number of the load, counted from 0")} | LOADS
    for name, (unit, description) in columns.items():
        if name not in group:
            kind, missing = (np.int64, -1) if name in ("load", "iterations") else (np.float64, np.nan)
            column = group.create_dataset(name, (completed,), kind, maxshape=(None,), chunks=(64,), fillvalue=missing)
            if name == "load":
                column[:] = np.arange(completed)
            column.attrs.update(description=description, units=unit.format(**units))
            name_axes(group, name, ("load",) if name != "load" else ())


@cache
def _without_loads(length_unit: str, pressure_unit: str) -> bytes:
    """The beginning of an observables.h5, kept: making its columns takes as long as solving 256² points."""
    content = io.BytesIO()
    with h5py.File(content, "w", libver=hdf5_slabs.LIBVER) as file:
        _add_columns(file.create_group("loads"), 0, {"length": length_unit, "pressure": pressure_unit})
    return content.getvalue()


def _revise(path: Path, change: Callable[[h5py.File], None], blank: bytes = b"", **options: bool) -> None:
    """Change a small HDF5 file; blank: what a new one begins with."""

    def modify(content: io.BytesIO) -> None:
        if not content.getbuffer().nbytes:
            content.write(blank)
        with h5py.File(content, "r+" if content.getbuffer().nbytes else "w", libver=hdf5_slabs.LIBVER) as file:
            change(file)

    atomic.revise(path, modify, **options)
