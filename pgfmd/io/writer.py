"""Result files, written in parallel.  The only module that opens HDF5 files in parallel.

At every instant the folder holds complete files only, of all loads completed so far:

    observables.h5          small: one row per load, groups of curves and tables, provenance
    fields.h5               links to the big fields: height, load_0000/pressure, …; open this one to read them
    fields/height.h5, fields/load_0000.h5, …

Every one of them ends in a seal (module `seal`): a file that is damaged is recognised before a run is continued.
"""

from __future__ import annotations

import io
import logging
import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cached_property
from pathlib import Path

import h5py
import numpy as np
from mpi4py import MPI

from pgfmd.errors import InputError, Stopped
from pgfmd.io import atomic, hdf5_slabs, provenance
from pgfmd.io import restart as former
from pgfmd.io.formats import modern
from pgfmd.io.schema import (
    FIELDS,
    FIELDS_FILE,
    FIELDS_FOLDER,
    FORMAT_VERSION,
    LOADS,
    OBSERVABLES_FILE,
    SI,
    Groups,
    Layout,
    load_name,
)  # fmt: skip
from pgfmd.parallel.collectives import from_root, raise_together

log = logging.getLogger("pgfmd")


class ResultWriter:
    """Writes one run's folder; a context manager.  Every method is collective.

    comm : communicator; directory : the folder, made if missing
    shape (nx, ny), lengths (lx, ly) : of the global grid; rows : slice of global rows that this rank holds
    config_text, effective_toml, command, loads : kept as provenance (`loads`: how many are to be written)
    overwrite : replace results that are there; restart : continue them; otherwise they are refused
    precision : "float64" or "float32", of real fields in the file;  layout : of the groups of a load

    Making one checks and locks the folder, and writes nothing: old results live until `begin` (or the first write).
    Raises InputError on all ranks if the folder cannot be written, is in use, or holds results not to be replaced.

    completed : loads written so far;  former : what is to be continued
    """

    def __init__(
        self,
        comm: MPI.Comm,
        directory: str | os.PathLike,
        config_text: str = "",
        effective_toml: str = "",
        command: str | None = None,
        *,
        shape: tuple[int, int],
        lengths: tuple[float, float],
        rows: slice,
        loads: int = 0,
        overwrite: bool = False,
        restart: bool = False,
        precision: str = "float64",
        length_unit: str = "length",
        pressure_unit: str = "pressure",
        layout: Layout | None = None,
    ):
        self.comm, self.directory = comm, Path(directory)
        self.shape, self.lengths, self.rows = tuple(shape), tuple(lengths), rows
        self.precision, self.unit_names = np.dtype(precision), {"length": length_unit, "pressure": pressure_unit}
        self.layout = layout or {}
        self.collective = hdf5_slabs.is_collective(comm)
        self._job, self._overwrite, self._restart = (config_text, effective_toml, command, loads), overwrite, restart
        self._begun = False
        self._folder = None
        self.former = from_root(comm, self._enter)
        self.completed = self.former.completed
        try:
            with raise_together(comm):  # a folder that only rank 0 sees is of no use to a collective write
                if self.collective and not (self.directory / atomic.LOCK_NAME).exists():
                    raise InputError(f"{self.directory}: rank {comm.rank} does not see the folder that rank 0 made")
            former.find_damage(comm, self.directory, self.former)
        except BaseException as error:
            self.__exit__(type(error), error, None)
            raise
        if comm.size > 1:
            how = "by all ranks together" if self.collective else "through rank 0 (h5py has no MPI)"
            log.info("fields are written %s", how)

    def _enter(self) -> former.FormerRun:
        """Lock the folder; what is to be continued.  Rank 0."""
        folder = atomic.OutputFolder(self.directory)
        try:
            found = [
                name for name in (OBSERVABLES_FILE, FIELDS_FILE, FIELDS_FOLDER) if (self.directory / name).exists()
            ]
            if found and not (self._overwrite or self._restart):
                raise InputError(
                    f"{self.directory}: holds results already ({', '.join(found)}); replace them with "
                    "--overwrite, continue them with --restart, or choose another folder"
                )
            if not self._restart or OBSERVABLES_FILE not in found:
                self._restart = False
            answer = former.read(self.directory) if self._restart else former.FormerRun()
            self._folder = folder
            return answer
        finally:
            if self._folder is None:
                folder.release()
                folder.discard()

    @property
    def pending(self) -> list[int]:
        """The loads that are still to be solved: not completed, or their fields damaged."""
        damaged = self.former.damaged
        return [index for index in range(self._job[3]) if index >= self.completed or load_name(index) in damaged]

    def begin(self):
        """Remove old results (unless they are continued) and write observables.h5 without loads.  Collective."""
        if not self._begun:
            from_root(self.comm, self._clear)
            from_root(self.comm, self._revise_observables, self._describe)
            self._begun = True

    def write_field(self, name: str, local: np.ndarray, description: str | None = None, units: str | None = None):
        """Write a field that belongs to no load, e.g. the heights.  Collective.

        local : this rank's slab (nx_local, ny)
        Raises OSError on all ranks if it cannot be written.
        """
        self.begin()
        self._write_slabs(f"{name}.h5", {name: local}, description, units)
        from_root(self.comm, self._link, {name: (f"{name}.h5", name)})

    def write_load(
        self,
        index: int,
        row: dict[str, float],
        groups: Groups | None = None,
        fields: dict[str, np.ndarray] | None = None,
    ):
        """Write one completed load: fields first, then, at once, its row and groups.  Collective.

        row : values of `schema.LOADS` (missing: NaN); groups : arrays that `layout` describes; both of rank 0 count
        fields : this rank's slabs (nx_local, ny), same names on all ranks
        Raises OSError on all ranks if it cannot be written.
        """
        self.begin()
        name = load_name(index)
        if fields:
            self._write_slabs(f"{name}.h5", fields)
            from_root(self.comm, self._link, {f"{name}/{field}": (f"{name}.h5", field) for field in fields})

        def add(file: h5py.File):
            self._add_row(file["loads"], index, row)
            if name in file:
                del file[name]
            group = file.create_group(name)
            for title, table in (groups or {}).items():
                self._add_group(group, title, table)
            group.attrs["fields"] = np.array(sorted(fields or {}), h5py.string_dtype())

        from_root(self.comm, self._revise_observables, add)
        self.completed = max(self.completed, index + 1)
        self.former.damaged.discard(name)

    def finish(self, phases: dict[str, float] | None = None):
        """Mark the run as complete; `phases` are seconds by name, of rank 0.  Collective."""
        self.begin()

        def mark(file: h5py.File):
            file.attrs.update(status="complete", finished=provenance.now())
            file.require_group("phases").attrs.update({name: float(value) for name, value in (phases or {}).items()})

        from_root(self.comm, self._revise_observables, mark)

    def __enter__(self) -> ResultWriter:
        return self

    def __exit__(self, kind, error, trace):
        """Give the folder free.  Not collective: it also runs where one rank alone has failed."""
        if self._folder is None:
            return
        if self._begun and error is not None:
            message = (str(error) or kind.__name__)[:1000]
            with suppress(OSError):  # the disk may be what has failed; the first error is the one to report
                status = "stopped" if isinstance(error, Stopped) else "failed"
                self._revise_observables(lambda file: file.attrs.update(status=status, error=message))
        self._folder.release()
        if not self._begun:
            self._folder.discard()
        self._folder = None

    # Rank 0: small files, each replaced as a whole.

    def _clear(self):
        path, folder = self.directory / OBSERVABLES_FILE, self.directory / FIELDS_FOLDER
        drafts = [*self.directory.glob(".*.h5.tmp"), *folder.glob(".*.h5.tmp")]
        old = [] if self._restart else [path, atomic.previous(path), self.directory / FIELDS_FILE, *folder.glob("*.h5")]
        for path in (*old, *drafts):
            path.unlink(missing_ok=True)
        folder.mkdir(exist_ok=True)
        if self._restart:
            self.former.settle()
            (self.directory / FIELDS_FILE).unlink(missing_ok=True)  # made anew: whole or not, it is not needed
            if self.former.links():
                self._link(self.former.links())

    def _revise_observables(self, change: Callable[[h5py.File], None]):
        _revise(self.directory / OBSERVABLES_FILE, change, keep=True)

    def _link(self, targets: dict[str, tuple[str, str]]):
        def add(file: h5py.File):
            file.attrs.update(self._provenance)
            for name, (target, dataset) in targets.items():
                if name in file:
                    del file[name]
                file[name] = h5py.ExternalLink(f"{FIELDS_FOLDER}/{target}", dataset)

        _revise(self.directory / FIELDS_FILE, add)

    def _describe(self, file: h5py.File):
        if not self._restart:
            file.attrs.update(self._provenance)
            group = file.create_group("loads")
            for name, (units, description) in LOADS.items():
                fill = (
                    {"dtype": np.int64, "fillvalue": -1}
                    if name == "iterations"
                    else {"dtype": float, "fillvalue": np.nan}
                )
                self._annotate(
                    group.create_dataset(name, (0,), maxshape=(None,), chunks=(64,), **fill), description, units
                )
        else:
            self._modernise(file)
        file.attrs.pop("error", None)
        file.attrs.update(status="running", loads_requested=self._job[3])

    @cached_property
    def _provenance(self) -> dict:
        text, effective, command, _ = self._job
        mpi = MPI.Get_library_version().split("\n")[0].split(",")[0].strip("\0 ")
        libraries = {"HDF5": h5py.version.hdf5_version, "MPI": mpi}
        found = provenance.gather(self.comm.size, libraries, text, effective, command)
        return found | {"shape": self.shape, "lengths": self.lengths}

    def _add_row(self, group: h5py.Group, index: int, row: dict[str, float]):
        unknown = row.keys() - LOADS.keys()
        if unknown:
            raise ValueError(f"not in schema.LOADS: {', '.join(sorted(unknown))}")
        for name in LOADS:
            group[name].resize((max(index + 1, len(group[name])),))
            if name in row:
                group[name][index] = row[name]

    def _add_group(self, load: h5py.Group, title: str, table: Mapping[str, np.ndarray]):
        for key, values in table.items():
            form = self.layout[title][key]
            self._annotate(load.create_dataset(f"{title}/{key}", data=values), form.description, form.unit)

    def _modernise(self, file: h5py.File):
        """Bring the loads of an earlier format, which a run continues, to the present one."""
        for name in (name for name in file if name.startswith("load_")):
            for title in list(file[name]):
                table = {key: dataset[()] for key, dataset in file[name][title].items()}
                changed = modern(title, table, file.attrs["format_version"], self.shape)
                if changed is not table:
                    del file[name][title]
                    self._add_group(file[name], title, changed)
        file.attrs["format_version"] = FORMAT_VERSION

    def _annotate(self, dataset: h5py.Dataset, description: str, units: str):
        dataset.attrs.update(description=description, units=units.format(**self.unit_names))

    # All ranks: the big fields, each in a file of its own, in one piece on the disk.

    def _write_slabs(
        self, name: str, fields: dict[str, np.ndarray], description: str | None = None, units: str | None = None
    ):
        """Write fields/`name` under a temporary name and put it in its place.  Collective."""
        path = self.directory / FIELDS_FOLDER / name
        draft = atomic.temporary(path)
        slabs = {}
        for key, local in fields.items():
            real = np.issubdtype(local.dtype, np.floating)
            slabs[key] = hdf5_slabs.Field(local, self.precision if real else local.dtype)
        with raise_together(self.comm):
            expected = (self.rows.stop - self.rows.start, self.shape[1])
            for key, local in fields.items():
                if local.shape != expected:
                    raise ValueError(f"field {key}: slab of shape {local.shape}, expected {expected}")

        def create(file: h5py.File, key: str) -> h5py.Dataset:
            dataset = hdf5_slabs.create_dataset(file, key, self.shape, slabs[key].dtype)
            schema_units, schema_text = FIELDS.get(key, ("1", key))
            self._annotate(dataset, description or schema_text, units or schema_units)
            unit = self.unit_names.get((units or schema_units).strip("{}"), "")
            dataset.attrs.update(
                axisLabels=np.array(["x", "y"], h5py.string_dtype()),
                dataOrder="C",
                geometry="cartesian",
                gridSpacing=np.divide(self.lengths, self.shape),
                gridGlobalOffset=np.zeros(2),
                position=np.zeros(2),
                gridUnitSI=SI.get(self.unit_names["length"], 1.0),
                unitSI=SI.get(unit, 1.0),
            )
            return dataset

        try:
            hdf5_slabs.write(self.comm, draft, self.rows, slabs, create)
            hdf5_slabs.add_seal(self.comm, draft)
            from_root(self.comm, atomic.commit, path)
        except BaseException:
            if self.comm.rank == 0:
                with suppress(OSError):
                    draft.unlink(missing_ok=True)
            raise


def _revise(path: Path, change: Callable[[h5py.File], None], **options):
    def modify(content: io.BytesIO):
        with h5py.File(content, "r+" if content.getbuffer().nbytes else "w", libver=hdf5_slabs.LIBVER) as file:
            change(file)

    atomic.revise(path, modify, **options)
