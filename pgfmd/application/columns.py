"""The columns of a table of loads in HDF5, by calls of HDF5 itself: h5py's selections take three times as long, which
many small runs feel.
"""

from __future__ import annotations

from collections.abc import Mapping

import h5py
import numpy as np

from pgfmd.application.files import MISSING
from pgfmd.observables.schema import LOADS


def put(group: h5py.Group, index: int, row: Mapping[str, float | None]) -> None:
    """Write entry `index` of the columns that `row` names, which become as long as that; None leaves the fill value."""
    one = h5py.h5s.create_simple((1,))
    for name, value in row.items():
        column = h5py.h5d.open(group.id, name.encode())
        column.set_extent((max(index + 1, column.shape[0]),))
        if value is not None:
            place = column.get_space()
            place.select_hyperslab((index,), (1,))
            column.write(one, place, np.array([value]))


def get(group: h5py.Group) -> dict[str, np.ndarray]:
    """The columns of a table of loads, whole: those of `LOADS` first, then those of observables by name.

    Whole numbers that are missing, those of loads that were not solved, are NaN, too.
    """
    found = {}
    for name in (*LOADS, *sorted(set(group) - LOADS.keys() - {"load"})):
        if group.id.links.exists(name.encode()):
            column = h5py.h5d.open(group.id, name.encode())
            values = np.empty(column.shape, column.dtype)
            column.read(h5py.h5s.ALL, h5py.h5s.ALL, values)
            missing = values == MISSING
            found[name] = np.where(missing, np.nan, values) if values.dtype.kind == "i" and missing.any() else values
    return found
