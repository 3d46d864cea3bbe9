"""What a result folder holds of a run that is to be continued, and whether it is whole."""

from __future__ import annotations

import io
import logging
import os
from dataclasses import dataclass, field
from pathlib import Path

import h5py
from mpi4py import MPI

from pgfmd.errors import InputError
from pgfmd.io import atomic, hdf5_slabs
from pgfmd.io.checksum import unsealed
from pgfmd.io.schema import FIELDS_FOLDER, OBSERVABLES_FILE, load_name
from pgfmd.parallel.collectives import from_root

log = logging.getLogger("pgfmd")


@dataclass
class FormerRun:
    """Results so far: completed loads, effective job (None: nothing to continue), fields by load, files that are
    damaged or missing, by name (`load_0002`, `height`); state: the file that says so.
    """

    completed: int = 0
    job: str | None = None
    fields: dict[str, list[str]] = field(default_factory=dict)
    damaged: set[str] = field(default_factory=set)
    state: Path | None = None

    @property
    def has_height(self) -> bool:
        """Whether the heights are there."""
        return self.job is not None and "height" not in self.damaged

    def links(self) -> dict[str, tuple[str, str]]:
        """What fields.h5 is to show: name → (file, dataset)."""
        found = {"height": ("height.h5", "height")} if self.has_height else {}
        for name, keys in self.fields.items():
            if name not in self.damaged:
                found |= {f"{name}/{key}": (f"{name}.h5", key) for key in keys}
        return found

    def settle(self):
        """Make the version of observables.h5 that was read the present one."""
        if self.state is not None and self.state.name != OBSERVABLES_FILE:
            os.replace(self.state, self.state.with_name(OBSERVABLES_FILE))


def read(directory: Path) -> FormerRun:
    """The run in a folder, from observables.h5 or, if that is damaged, from the version before.

    Raises InputError if neither can be used.
    """
    path, reason = directory / OBSERVABLES_FILE, ""
    for state in (path, atomic.previous(path)):
        try:
            with h5py.File(io.BytesIO(unsealed(state.read_bytes())), "r") as file:
                count, job = len(file["loads/mean_pressure"]), str(file.attrs["effective_toml"])
                names = [load_name(index) for index in range(count)]
                fields = {name: list(file[name].attrs["fields"]) for name in names}
        except (OSError, KeyError) as error:
            reason = reason or str(error)
            continue
        if reason:
            log.warning("%s: %s; the version before it is used", path, reason)
        return FormerRun(count, job, fields, state=state)
    raise InputError(f"{path}: cannot be continued: {reason}; start afresh with --overwrite")


def find_damage(comm: MPI.Comm, directory: Path, former: FormerRun):
    """Add to `former.damaged` the files of fields that are not as they were written.  Collective."""
    if former.job is None:
        return
    for name, fields in ({"height": ["height"]} | former.fields).items():
        path = directory / FIELDS_FOLDER / f"{name}.h5"
        there = from_root(comm, path.exists)
        fault = hdf5_slabs.damage(comm, path) if there else "it is missing"
        if fields and fault is not None:
            former.damaged.add(name)
            if there or name != "height":
                log.warning("%s: %s; it will be made again", path, fault)
