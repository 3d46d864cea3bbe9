"""Files of heights: the choice of a reader, and the reader of NumPy and HDF5 arrays.  No MPI here."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np

from pgfmd.errors import InputError
from pgfmd.options.text import printable
from pgfmd.surfaces import instruments, text, tiff
from pgfmd.surfaces.measurement import Measurement, damage_reported, named

if TYPE_CHECKING:
    import h5py

HDF5_SUFFIXES = (".h5", ".hdf5")
NO_UNIT = ("", "1", "length")  # "length" is written by jobs without a unit


def is_array(path: str, dataset: str | None) -> bool:
    """Whether the file is .npy or HDF5 with a two-dimensional dataset, of which each rank can read its own part.

    True also for a missing or damaged file: `opened` then raises InputError.
    """
    if dataset is not None or path.endswith((".npy", *HDF5_SUFFIXES)) or not os.path.isfile(path):
        return True
    import h5py

    try:
        if not h5py.is_hdf5(path):
            return False
        with h5py.File(path, "r", locking=False) as file:
            return bool(_two_dimensional(file))
    except Exception:  # damaged HDF5: the reader says so
        return True


@contextmanager
def opened(path: str, dataset: str | None) -> Iterator[Measurement]:
    """The heights in a file, read as far as they are used inside the block.

    dataset may be None if an HDF5 file holds just one two-dimensional dataset (or one named "height" or "heights").
    Raises InputError, with the path: file missing, unreadable, truncated, not two-dimensional, or the package for its
    format is not installed; also for any error inside the block but MemoryError.
    """
    with named(path), damage_reported("cannot be read as heights (.npy or HDF5), perhaps truncated"):
        try:
            if path.lower().endswith(tiff.SUFFIXES):
                yield tiff.read(path)
            elif not is_array(path, dataset):
                yield text.read(path) or instruments.read(path)
            elif path.endswith(".npy"):
                if dataset is not None:
                    raise InputError(f"holds no dataset {printable(dataset)!r}: .npy files are one array")
                yield _checked(Measurement(np.load(path, mmap_mode="r", allow_pickle=False), "NumPy array"))
            else:
                import h5py

                with h5py.File(path, "r", locking=False) as file:
                    yield _checked(_described(_dataset(file, dataset)))
        except FileNotFoundError:
            raise InputError("no such file") from None


def _checked(found: Measurement) -> Measurement:
    if found.array.dtype.kind not in "fiu":
        raise InputError(f"heights must be real numbers, not {found.array.dtype}")
    if len(found.array.shape) != 2 or not found.array.size:
        raise InputError(f"array of shape {tuple(found.array.shape)}: must be two-dimensional and not empty")
    return found


def _described(dataset: h5py.Dataset) -> Measurement:
    """A dataset with its attributes `units` (or `unit`), scale_factor, add_offset and _FillValue (netCDF)."""
    unit = dataset.attrs.get("units", dataset.attrs.get("unit"))
    if isinstance(unit, bytes):
        unit = unit.decode(errors="replace")
    unit = unit.strip() if isinstance(unit, str) else ""
    numbers = {}
    for name in ("scale_factor", "add_offset", "_FillValue"):
        value = np.asarray(dataset.attrs.get(name, np.nan))
        numbers[name] = value.item() if value.size == 1 and value.dtype.kind in "fiu" else np.nan
    return Measurement(
        dataset,
        f"HDF5 dataset {printable(dataset.name)}",
        unit=None if unit in NO_UNIT else unit,
        factor=1.0 if np.isnan(numbers["scale_factor"]) else numbers["scale_factor"],
        offset=0.0 if np.isnan(numbers["add_offset"]) else numbers["add_offset"],
        fill=None if np.isnan(numbers["_FillValue"]) else numbers["_FillValue"],
    )


def _two_dimensional(file: h5py.File) -> list[str]:
    """Names of the two-dimensional datasets."""
    found = []
    file.visititems(lambda key, item: found.append(key) if getattr(item, "ndim", 0) == 2 else None)
    return found


def _dataset(file: h5py.File, name: str | None) -> h5py.Dataset:
    if name is not None:
        if not hasattr(file.get(name), "dtype"):
            raise InputError(f"holds no dataset {printable(name)!r}")
        return file[name]
    found = _two_dimensional(file)
    usual = [key for key in found if key in ("height", "heights")]
    choice = usual or found
    if len(choice) != 1:
        listed = printable(", ".join(found[:5]), 200) or "none"
        raise InputError(f'say which dataset holds the heights (path = "file.h5:dataset"); found: {listed}')
    return file[choice[0]]
