"""Names of the axes of datasets, and coordinates along them, as HDF5 dimension scales: xarray and netCDF show them."""

from __future__ import annotations

from collections.abc import Sequence

import h5py
import numpy as np


def name_axes(group: h5py.Group, key: str, axes: Sequence[str]) -> None:
    """Name the axes of the dataset `key` of a group: the coordinates along each are the dataset of that name there.

    That dataset must exist; its own axis needs no name.
    """
    for number, name in enumerate(axes):
        if not group[name].is_scale:
            group[name].make_scale(name)
        if name != key:
            group[key].dims[number].attach_scale(group[name])


def add_grid_axes(file: h5py.File, shape: tuple[int, int], lengths: tuple[float, float], unit: str) -> None:
    """The coordinates x and y of the points of a grid, from 0 on, as datasets of a file; lengths: of the cell."""
    for name, count, length in zip("xy", shape, lengths, strict=True):
        if name not in file:
            axis = file.create_dataset(name, data=np.arange(count) * (length / count))
            axis.attrs.update(description=f"position of the grid points along {name}", units=unit)
            axis.make_scale(name)
