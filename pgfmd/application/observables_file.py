"""observables.h5: one row per load, and a group of curves and tables for each.  On rank 0 only."""

from __future__ import annotations

import io
import time
from collections.abc import Mapping
from functools import cache
from pathlib import Path

import h5py
import numpy as np

from pgfmd.application import atomic, columns
from pgfmd.application.dimensions import name_axes
from pgfmd.application.files import LIBVER, MISSING, OBSERVABLES_FILE, Form, load_name
from pgfmd.application.small_hdf5 import Change, revise
from pgfmd.observables.schema import LOADS, TABLE, Dataset, Groups


class ObservablesFile:
    """The file of one run, replaced as a whole at each change.

    patience: seconds for which changes are gathered and made together; it is then left to the caller to sync the file
    """

    def __init__(self, directory: Path, form: Form, patience: float) -> None:
        self.path, self.form, self.patience = directory / OBSERVABLES_FILE, form, patience
        self._changes: list[Change] = []
        self._last_change = time.monotonic()

    def change(self, change: Change, now: bool = False) -> None:
        """Change the file: at once if asked to, or if the last time is longer ago than the patience."""
        self._changes.append(change)
        if now or time.monotonic() - self._last_change >= self.patience:
            changes, self._changes = self._changes, []

            def apply(file: h5py.File) -> None:
                for each in changes:
                    each(file)

            revise(self.path, apply, _without_loads(*self.form.units.values()), keep=True, sync=not self.patience)
            self._last_change = time.monotonic()

    def replace(self, fill: Change) -> None:
        """Write the file anew; nothing of an earlier version stays."""
        atomic.previous(self.path).unlink(missing_ok=True)
        revise(self.path, fill, anew=True)


def add_columns(
    group: h5py.Group, completed: int, wanted: Mapping[str, Dataset], units: Mapping[str, str]
) -> None:
    """Make the columns of the table of loads that are not there: an earlier version may not have written all."""
    wanted = {"load": Dataset("1", "number of the load, counted from 0"), **wanted}
    for name, about in wanted.items():
        if name not in group:
            kind, missing = (np.int64, MISSING) if name in ("load", "iterations") else (np.float64, np.nan)
            column = group.create_dataset(name, (completed,), kind, maxshape=(None,), chunks=(64,), fillvalue=missing)
            if name == "load":
                column[:] = np.arange(completed)
            annotate(column, about, units)
            name_axes(group, name, ("load",) if name != "load" else ())


def add_row(group: h5py.Group, index: int, row: Mapping[str, float], form: Form) -> None:
    """Write the row of a load; raises ValueError for a name that is no column."""
    unknown = row.keys() - form.columns.keys()
    if unknown:
        raise ValueError(f"no columns of the table of loads: {', '.join(sorted(unknown))}")
    columns.put(group, index, {"load": index, **dict.fromkeys(form.columns), **row})


def add_groups(file: h5py.File, index: int, groups: Groups, form: Form) -> h5py.Group:
    """Write, or replace, the group of a load with what was measured on it; returns it."""
    name = load_name(index)
    if name in file:
        del file[name]
    load = file.create_group(name)
    for title, table in groups.items():
        for key, values in table.items():
            annotate(load.create_dataset(f"{title}/{key}", data=values), form.groups[title][key], form.units)
        for key in table:
            name_axes(load[title], key, form.groups[title][key].axes)
    return load


def annotate(dataset: h5py.Dataset, about: Dataset, units: Mapping[str, str]) -> None:
    """Write what a dataset is, and its unit in the names that the job gives."""
    dataset.attrs.update(description=about.description, units=about.unit.format(**units))


@cache
def _without_loads(length_unit: str, pressure_unit: str) -> bytes:
    """The beginning of an observables.h5, kept: making its columns takes as long as solving 256² points."""
    content = io.BytesIO()
    with h5py.File(content, "w", libver=LIBVER) as file:
        add_columns(file.create_group(TABLE), 0, LOADS, {"length": length_unit, "pressure": pressure_unit})
    return content.getvalue()
