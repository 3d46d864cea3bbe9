"""Files of heights, each read by what suits it: NumPy, HDF5, text, TIFF, instruments' formats; packed or not.

No MPI here.  SurfaceTopography, which knows the instruments' formats, and Pillow, for TIFF, are optional packages.
"""

from __future__ import annotations

import gzip
import io
import os
import shutil
import tempfile
import warnings
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from pgfmd.errors import InputError
from pgfmd.options.text import printable
from pgfmd.surfaces import plain_text
from pgfmd.surfaces.measurement import Measurement, damage_reported, named

if TYPE_CHECKING:
    import h5py

HDF5_SUFFIXES, TIFF_SUFFIXES, PACKED_SUFFIXES = (".h5", ".hdf5"), (".tif", ".tiff"), (".gz", ".zip")
NO_UNIT = ("", "1", "length")  # "length" is written by jobs without a unit
PARK_SYSTEMS = 50432  # tag of a TIFF in which Park Systems' microscopes keep heights
MISSING = (
    "is neither .npy nor HDF5 with a two-dimensional dataset; instruments' formats are read by SurfaceTopography, "
    "which is not installed here: run tools/setup.sh surfaces (or pip install SurfaceTopography)"
)


def is_array(path: str, dataset: str | None) -> bool:
    """Whether the file is .npy or HDF5 with a two-dimensional dataset, of which each rank can read its own part.

    True also for a missing or damaged file: `opened` then raises InputError.
    """
    if path.lower().endswith(PACKED_SUFFIXES):
        return False
    if path.endswith((".npy", *HDF5_SUFFIXES)) or not os.path.isfile(path):
        return True
    import h5py

    try:
        if not h5py.is_hdf5(path):
            return False
        with h5py.File(path, "r", locking=False) as file:
            return dataset is not None or bool(_two_dimensional(file))
    except Exception:  # damaged HDF5: the reader says so
        return True


@contextmanager
def opened(path: str, dataset: str | None) -> Iterator[Measurement]:
    """The heights in a file, read as far as they are used inside the block.

    dataset: of an HDF5 file, channel of an instrument's, or member of a .zip; None if there is just one (of HDF5, one
    that is two-dimensional or is named "height" or "heights"; of an instrument's file, its default channel).
    Raises InputError, with the path: file missing, unreadable, truncated, not two-dimensional, or the package for its
    format is not installed; also for any error inside the block but MemoryError.
    """
    with named(path), damage_reported("cannot be read as heights (.npy or HDF5), perhaps truncated"):
        try:
            if path.lower().endswith(PACKED_SUFFIXES):
                with _unpacked(path, dataset) as (inner, of_inner), _read(inner, of_inner) as found:
                    yield found
            else:
                with _read(path, dataset) as found:
                    yield found
        except FileNotFoundError:
            raise InputError("no such file") from None


@contextmanager
def _read(path: str, dataset: str | None) -> Iterator[Measurement]:
    """The heights in a file that is not packed."""
    if path.lower().endswith(TIFF_SUFFIXES):
        yield _tiff(path)
    elif not is_array(path, dataset):
        yield (plain_text.read(path) if dataset is None else None) or _instrument(path, dataset)
    elif path.endswith(".npy"):
        if dataset is not None:
            raise InputError(f"holds no dataset {printable(dataset)!r}: .npy files are one array")
        yield _checked(Measurement(np.load(path, mmap_mode="r", allow_pickle=False), "NumPy array"))
    else:
        import h5py

        with h5py.File(path, "r", locking=False) as file:
            yield _checked(_described(_dataset(file, dataset)))


@contextmanager
def _unpacked(path: str, dataset: str | None) -> Iterator[tuple[str, str | None]]:
    """A file with the content of a .gz, or of one member of a .zip, that lasts for the block, and the dataset in it."""
    with tempfile.TemporaryDirectory(prefix="pgfmd-") as folder, damage_reported("cannot be unpacked"):
        if path.lower().endswith(".gz"):
            source: Any = gzip.open(path)
            name = os.path.basename(path)[:-3]
        else:
            archive = zipfile.ZipFile(path)
            names = [each for each in archive.namelist() if not each.endswith("/") and not each.startswith("__MACOSX")]
            name = names[0] if len(names) == 1 else dataset or ""
            if name not in names:
                listed = printable(", ".join(names), 300) or "none"
                raise InputError(f'say which of its files holds the heights (path = "file.zip:name"); found: {listed}')
            source, dataset = archive.open(name), None if name == dataset else dataset
        inner = os.path.join(folder, os.path.basename(name))
        with source, open(inner, "wb") as target:
            shutil.copyfileobj(source, target)
        yield inner, dataset


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


def _tiff(path: str) -> Measurement:
    """The values of the pixels, [line, column]; of a Park Systems file its heights, with size and unit."""
    try:
        from PIL import Image
    except ImportError:
        raise InputError("TIFF images are read by Pillow, which is not installed here: pip install pillow") from None
    with damage_reported("cannot be read as a TIFF image"), warnings.catch_warnings(action="ignore"):
        with Image.open(path) as image:
            if PARK_SYSTEMS in getattr(image, "tag_v2", ()):
                return _instrument(path, None)
            bands, count, values = image.getbands(), getattr(image, "n_frames", 1), np.array(image)
    if len(bands) > 1 or image.mode == "P" or values.ndim != 2:
        raise InputError(f"is an image of colours ({image.mode}), not of heights")
    if count > 1:
        raise InputError(f"holds {count} images; one of heights is needed")
    return Measurement(values, "TIFF image, values of pixels")


def _instrument(path: str, channel: str | None) -> Measurement:
    """A channel of the file, the default one if its name is None, by SurfaceTopography, which detects the format."""
    try:
        import SurfaceTopography
    except ImportError:
        raise InputError(MISSING) from None
    with damage_reported("cannot be read by SurfaceTopography"), warnings.catch_warnings(action="ignore"):
        with SurfaceTopography.open_topography(_source(path)) as reader:
            names = {each.name: each for each in reader.channels if each.dim == 2}
            if channel is not None and channel not in names:
                raise InputError(f"holds no channel {printable(channel)!r}; found: {printable(', '.join(names), 300)}")
            chosen = reader.default_channel if channel is None else names[channel]
            lengths, dim = chosen.physical_sizes, chosen.dim
            # That package makes no topography without sizes: a file that gives none gets sides of 1, ignored below.
            unknown = {} if lengths else {"physical_sizes": (1.0,) * dim}
            surface = reader.topography(channel_index=chosen.index, **unknown)
            name, unit = f"{reader.name()}, by SurfaceTopography", surface.unit
            matrix = reader.format() == "asc" and not lengths
            heights = surface.heights() if dim == 2 else None
    if heights is None:
        raise InputError("holds a line scan, not the heights of a surface")
    if matrix and 3 in heights.shape:
        raise InputError("three columns are x, y and height, but with points missing or units given they are not read")
    # That package takes the lines of a bare matrix as lines of an image, y; here they are x, as in .npy.
    if matrix:
        return Measurement(heights.T, name, None, unit)
    return Measurement(heights, name, lengths and (float(lengths[0]), float(lengths[1])), unit)


def _source(path: str) -> str | io.BytesIO:
    """The file; SDF of EUR 15178 (BCR) gets the magic word of ISO 25178-71, the one that the package knows."""
    with open(path, "rb") as file:
        if file.read(8) not in (b"aBCR-1.0", b"bBCR-1.0"):
            return path
        file.seek(0)
        content = file.read()
    return io.BytesIO(content[:1] + b"ISO" + content[4:])
