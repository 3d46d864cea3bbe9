"""observables.h5: one row per load, and a group of curves and tables for each; names of axes, for xarray.  No MPI.

Of groups of `LARGE_TABLE` bytes or more it holds a link to a file beside the fields.

Columns are read and written by h5py's low-level API: selections take three times as long, which counts in small runs.
"""

import io
import time
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

import h5py
import numpy as np

from pgfmd.application import files
from pgfmd.application.files import LIBVER, MISSING, OBSERVABLES_FILE, Change, Form, create, load_name, revise
from pgfmd.observables.schema import LOADS, TABLE, Dataset, Groups


class ObservablesFile:
    """The file of one run, replaced as a whole at each change.

    patience: seconds for which changes are gathered, to be made together; if not 0, the caller must sync the file.
    """

    def __init__(self, directory: Path, form: Form, patience: float) -> None:
        self.path, self.form, self.patience = directory / OBSERVABLES_FILE, form, patience
        self._changes: list[Change] = []
        self._begun = False  # whether this run has written the file
        self._last_change = time.monotonic()

    def change(self, change: Change, now: bool = False) -> None:
        """Add a change; make all gathered changes if `now`, or if the last ones are longer ago than `patience`."""
        self._changes.append(change)
        if now or time.monotonic() - self._last_change >= self.patience:
            changes, self._changes = self._changes, []

            def apply(file: h5py.File) -> None:
                for each in changes:
                    each(file)

            if self._begun or self.path.exists():  # if the folder of a run was lost, raise
                revise(self.path, apply, sync=not self.patience)
            else:
                create(self.path, apply, _without_loads(*self.form.units.values()), sync=not self.patience)
            self._begun, self._last_change = True, time.monotonic()

    def replace(self, fill: Change) -> None:
        """Write the file anew; nothing of an earlier version stays."""
        create(self.path, fill)
        self._begun = True


def add_columns(group: h5py.Group, completed: int, wanted: Mapping[str, Dataset], units: Mapping[str, str]) -> None:
    """Make the missing columns of the table of loads: results of an earlier version may lack some."""
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
    """Write the row of a load; columns grow to that length.  Raises ValueError for a name that is no column."""
    unknown = row.keys() - form.columns.keys()
    if unknown:
        raise ValueError(f"no columns of the table of loads: {', '.join(sorted(unknown))}")
    one = h5py.h5s.create_simple((1,))
    for name, value in {"load": index, **dict.fromkeys(form.columns), **row}.items():
        column = h5py.h5d.open(group.id, name.encode())
        column.set_extent((max(index + 1, column.shape[0]),))
        if value is not None:  # else the fill value
            place = column.get_space()
            place.select_hyperslab((index,), (1,))
            column.write(one, place, np.array([value]))


def add_groups(file: h5py.File, index: int, groups: Groups, form: Form, links: Mapping[str, str]) -> h5py.Group:
    """Write, or replace, the group of a load; returns it.

    links: title of a group with a file of its own → path of that file, from the folder of `file`
    """
    name = load_name(index)
    if name in file:
        del file[name]
    load = file.create_group(name)
    for title, table in groups.items():
        if title in links:
            load[title] = h5py.ExternalLink(links[title], "/")
        else:
            fill_group(load.create_group(title), table, form.groups[title], form.units)
    return load


def fill_group(
    group: h5py.Group, table: Mapping[str, np.ndarray], layout: Mapping[str, Dataset], units: Mapping[str, str]
) -> None:
    """Write the datasets of a group, with what they are and their axes."""
    for key, values in table.items():
        annotate(group.create_dataset(key, data=values), layout[key], units)
    for key in table:
        name_axes(group, key, layout[key].axes)


def is_large(table: Mapping[str, np.ndarray]) -> bool:
    """Whether a group is to have a file of its own."""
    return sum(np.asarray(values).nbytes for values in table.values()) >= files.LARGE_TABLE


def linked(load: h5py.Group) -> dict[str, str]:
    """The groups of a load that have a file of their own, and its path from that of observables.h5."""
    links = {title: load.get(title, getlink=True) for title in load}
    return {title: link.filename for title, link in links.items() if isinstance(link, h5py.ExternalLink)}


def annotate(dataset: h5py.Dataset, about: Dataset, units: Mapping[str, str]) -> None:
    """Write the description of a dataset, and its unit by the names of the job."""
    dataset.attrs.update(description=about.description, units=about.unit.format(**units))


@cache
def _without_loads(length_unit: str, pressure_unit: str) -> bytes:
    """The beginning of an observables.h5, kept: making its columns takes as long as solving 256² points."""
    content = io.BytesIO()
    with h5py.File(content, "w", libver=LIBVER) as file:
        add_columns(file.create_group(TABLE), 0, LOADS, {"length": length_unit, "pressure": pressure_unit})
    return content.getvalue()


def read_columns(group: h5py.Group) -> dict[str, np.ndarray]:
    """The columns of a table of loads: those of `LOADS`, then others by name.  Missing ones are NaN, integers too."""
    columns = {}
    for name in (*LOADS, *sorted(set(group) - LOADS.keys() - {"load"})):
        if group.id.links.exists(name.encode()):
            column = h5py.h5d.open(group.id, name.encode())
            values = np.empty(column.shape, column.dtype)
            column.read(h5py.h5s.ALL, h5py.h5s.ALL, values)
            missing = values == MISSING
            columns[name] = np.where(missing, np.nan, values) if values.dtype.kind == "i" and missing.any() else values
    return columns


def name_axes(group: h5py.Group, key: str, axes: Sequence[str]) -> None:
    """Attach coordinates to each axis of the dataset `key`: datasets of these names, which the group must have."""
    for number, name in enumerate(axes):
        if not group[name].is_scale:
            group[name].make_scale(name)
        if name != key:
            group[key].dims[number].attach_scale(group[name])


def add_grid_axes(file: h5py.File, shape: tuple[int, int], lengths: tuple[float, float], unit: str) -> None:
    """Add the coordinates x and y of grid points, from 0 on, as datasets of a file; lengths: of the cell."""
    for name, count, length in zip("xy", shape, lengths, strict=True):
        if name not in file:
            axis = file.create_dataset(name, data=np.arange(count) * (length / count))
            axis.attrs.update(description=f"position of the grid points along {name}", units=unit)
            axis.make_scale(name)
