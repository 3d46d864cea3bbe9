"""Names and versions of the files of a result folder, and what they need to know of the run."""

from __future__ import annotations

from dataclasses import dataclass, field

from pgfmd.observables.schema import LOADS, TABLE, Dataset, GroupLayout

FORMAT_VERSION = 3  # how earlier ones differ: see `formats`
# Attributes beyond 64 KiB (a long job text) need this file format; every HDF5 since 2008 reads it.
LIBVER = ("v108", "v110")

OBSERVABLES_FILE, FIELDS_FILE, FIELDS_FOLDER = "observables.h5", "fields.h5", "fields"
VTK_FILE = "fields.vtkhdf"  # fields.h5 for ParaView; see `views`
CHECKPOINT_FILE = "checkpoint.h5"  # of an unfinished load; see `checkpoint`
ENSEMBLE_FILE = "ensemble.h5"  # of a folder that holds a result folder for each of several seeds; see `ensemble`
MISSING = -1  # a whole number of the table of loads that is not known; a real one is NaN


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


def load_name(index: int) -> str:
    """Name of a load's group: load_0000, load_0001, …"""
    return f"load_{index:04d}"


def member_name(seed: int) -> str:
    """Name of the result folder of one seed of an ensemble: seed_0001, seed_0002, …"""
    return f"seed_{seed:04d}"
