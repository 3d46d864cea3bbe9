"""The layout of the result files: names, types that describe datasets, and the tables that every run writes.

What an observable writes is described in its own file (`observables/NAME.py`).  Units are written with {length} and
{pressure}, which stand for the unit names that the job gives.
"""

from __future__ import annotations

from collections.abc import Container, Mapping
from dataclasses import dataclass, field

import numpy as np

FORMAT_VERSION = 3  # how earlier ones differ: see `formats`
# Attributes beyond 64 KiB (a long job text) need this file format; every HDF5 since 2008 reads it.
LIBVER = ("v108", "v110")

OBSERVABLES_FILE, FIELDS_FILE, FIELDS_FOLDER = "observables.h5", "fields.h5", "fields"
VTK_FILE = "fields.vtkhdf"  # fields.h5 for ParaView; see `views`
CHECKPOINT_FILE = "checkpoint.h5"  # of an unfinished load; see `checkpoint`
ENSEMBLE_FILE = "ensemble.h5"  # of a folder that holds a result folder for each of several seeds; see `ensemble`


@dataclass(frozen=True)
class Dataset:
    """One dataset of a group: its unit, what it is, and the datasets that hold the coordinates along its axes."""

    unit: str
    description: str
    axes: tuple[str, ...] = ()


GroupLayout = Mapping[str, Mapping[str, Dataset]]
"""What the groups of one load may hold: group → dataset → description."""
Groups = Mapping[str, Mapping[str, np.ndarray]]
"""The groups of one load: group → dataset → values."""

TABLE = "loads"
"""The table of loads, one row per load: a group of its own in observables.h5.  An observable that has this group in its
layout adds columns to the table: one number per load.  NAME_error is the error of NAME."""


@dataclass(frozen=True)
class Form:
    """What the files of one run depend on: shape (nx, ny) and lengths (lx, ly) of the global grid, the slice of rows
    that this rank holds, the precision of real fields in the file, names of units, the groups of a load, and hints
    for MPI-IO.
    """

    shape: tuple[int, int]
    lengths: tuple[float, float]
    rows: slice
    precision: str = "float64"
    length_unit: str = "length"
    pressure_unit: str = "pressure"
    groups: GroupLayout = field(default_factory=dict)
    hints: tuple[str, ...] = ()

    @property
    def units(self) -> dict[str, str]:
        """Names of units by what they measure, for the units of datasets."""
        return {"length": self.length_unit, "pressure": self.pressure_unit}

    @property
    def columns(self) -> dict[str, Dataset]:
        """The columns of the table of loads: those that every run has, and those of its observables."""
        return {**LOADS, **self.groups.get(TABLE, {})}


def is_error(name: str, columns: Container[str]) -> bool:
    """Whether a column holds the errors of another one."""
    return name.endswith("_error") and name.removesuffix("_error") in columns


MISSING = -1  # a whole number of LOADS that is not known; a real one is NaN

# The columns of the table of loads that every run has, in this order.
LOADS: dict[str, Dataset] = {
    "target": Dataset("as asked", "what was asked for: the entry of the list in [load], in its unit"),
    "mean_pressure": Dataset("{pressure}", "mean pressure p̄"),
    "contact_area": Dataset(
        "1", "relative contact area f_c: share of points in contact, as the law defines it (hard: p > 0)"
    ),
    "contact_area_corrected": Dataset("1", "area inside the contact line; without one, of pixels less their staircase"),
    "contact_perimeter": Dataset(
        "1/({length})", "length of the contact line, or of the pixels' edges, per area of the cell"
    ),
    "contact_line": Dataset(
        "1", "1: there is a contact line; 0: none, as roughness reaches the pixel or all is touched"
    ),
    "kappa": Dataset("1", "f_c E' g_rms / p̄, with g_rms the rms slope"),
    "mean_gap": Dataset("{length}", "mean gap"),
    "mean_plastic_depth": Dataset(
        "{length}", "volume by which a wall of limited hardness has yielded, per area of the cell"
    ),
    "displacement": Dataset(
        "{length}", "approach of the solid's far side from where the flat solid touches the summit"
    ),
    "elastic_energy": Dataset("{pressure}*{length}", "elastic energy per area of the cell"),
    "certified_error": Dataset("1", "upper bound of the energy error over 2 E_el"),
    "pressure_error": Dataset("1", "estimated rms error of the pressure over its rms value; NaN: none is known"),
    "max_violation": Dataset("1", "largest of |gap| in contact and penetration outside, over the rms height"),
    "iterations": Dataset("1", "iterations of the solver"),
    "transforms": Dataset("1", "work, in forward + backward transforms of the full grid in double precision"),
    "seconds": Dataset("s", "wall time of the solution"),
}

FIELDS = {
    "height": Dataset("{length}", "heights of the rigid surface, peaks positive"),
    "pressure": Dataset("{pressure}", "contact pressure"),
    "gap": Dataset("{length}", "gap between solid and surface"),
    "plastic_depth": Dataset("{length}", "depth by which the surface has yielded, under limited hardness"),
    "displacement": Dataset("{length}", "displacement of the solid's surface"),
    "labels": Dataset("1", "number of the contact patch, counted from 1; 0: no contact"),
}


def load_name(index: int) -> str:
    """Name of a load's group: load_0000, load_0001, …"""
    return f"load_{index:04d}"


def member_name(seed: int) -> str:
    """Name of the result folder of one seed of an ensemble: seed_0001, seed_0002, …"""
    return f"seed_{seed:04d}"
