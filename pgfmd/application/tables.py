"""observables.h5: one row per load, and a group of curves and tables for each; names of axes, for xarray.  No MPI.

Of groups of `LARGE_TABLE` bytes or more it holds a link to a file beside the fields.
"""

from collections.abc import Mapping, Sequence

import h5py
import numpy as np

from pgfmd.application import files
from pgfmd.application.files import MISSING, Form, load_name
from pgfmd.observables.schema import LOADS, Dataset, Groups


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
    for name, value in {"load": index, **dict.fromkeys(form.columns), **row}.items():
        group[name].resize(max(index + 1, len(group[name])), axis=0)
        if value is not None:  # else the fill value
            group[name][index] = value


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


def read_columns(group: h5py.Group) -> dict[str, np.ndarray]:
    """The columns of a table of loads: those of `LOADS`, then others by name.  Missing ones are NaN, integers too."""
    columns = {}
    for name in (*LOADS, *sorted(set(group) - LOADS.keys() - {"load"})):
        if name in group:
            values = group[name][()]
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
