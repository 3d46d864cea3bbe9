"""Readers of files of heights: NumPy, HDF5, text, TIFF, instruments' formats; packed or not.  No MPI here.

Two packages are optional: SurfaceTopography, for instruments' formats, and Pillow, for TIFF.  Texts that say sizes or
units go to SurfaceTopography, all others are read here: of 280 random matrices in the styles below it reads 92 right
and 14 wrong without an error, of 299 lists of points 254 and 32.
"""

from __future__ import annotations

import gzip
import io
import os
import re
import shutil
import tempfile
import warnings
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pgfmd.errors import InputError
from pgfmd.options.text import printable
from pgfmd.surfaces.measurement import Measurement, conversion, damage_reported, named

if TYPE_CHECKING:
    import h5py

# Ways to write a line of numbers: what separates them (None: blanks), and the decimal mark.
STYLES = ((",", "."), ("\t", "."), (None, "."), (";", "."), (";", ","), ("\t", ","), (None, ","))
NOTHING = {"", "nan", "bad", "na", "n/a", "null", "none", "---", "--", "***"}  # fields of points not measured
UNIT = re.compile(r"(Lateral|Value) units:\s*(\S+)")  # of coordinates and heights, as Gwyddion exports points
FOREIGN = re.compile(r"(?i)\bunit|[:=]\s*\S*\d")  # in comments with sizes or units, which SurfaceTopography reads
HEADER = 200  # lines of a .csv in which the first line of numbers is looked for
MOST_COMMENTS = 10**6  # lines of another text before its first line of numbers
LATTICE = 0.05  # distance from the lattice, over its spacing, at which a point still belongs to it
SAME = 1e-6  # coordinates closer than that, over their range, are equal
HDF5_SUFFIXES, TIFF_SUFFIXES, PACKED_SUFFIXES = (".h5", ".hdf5"), (".tif", ".tiff"), (".gz", ".zip")
NO_UNIT = ("", "1", "length")  # "length" is written by jobs without a unit
PARK_SYSTEMS = 50432  # tag of a TIFF in which Park Systems' microscopes keep heights
NO_TABLE = "in a text all lines must be numbers, but those that begin with #"
MISSING = (
    f"is neither .npy nor HDF5 with a two-dimensional dataset; {NO_TABLE}; instruments' formats are read by "
    "SurfaceTopography, which is not installed here: run tools/setup.sh surfaces (or pip install SurfaceTopography)"
)


def read_text(path: str) -> Measurement | None:
    """The heights of a text file; None if it is no table of numbers, or if comments give sizes or units that only
    SurfaceTopography understands (`_instrument`).

    A table of more than three columns is a matrix: number j of line i is heights[i, j], at x = i aₓ, y = j a_y, as
    `numpy.savetxt` writes it.  Three columns are x, y and height, in any order of lines; lattice points without a line
    are NaN.  Raises InputError, without the path: fewer columns, lines of different length, points off a lattice.
    """
    comments, _, passed = _opening(path, 3)
    after = f", after {passed} lines of words, which are not read" * (passed > 0)
    units = {match[1]: match[2] for match in map(UNIT.search, comments) if match}
    if any(FOREIGN.search(line) for line in comments if not UNIT.search(line)):
        return None
    numbers = read_table(path)
    if numbers is None or numbers.shape[1] > 3:
        return None if numbers is None or units else Measurement(numbers, f"text, a matrix{after}")
    if numbers.shape[1] < 3:
        raise InputError("holds a line scan, not the heights of a surface")
    measured = _on_lattice(numbers, units.get("Lateral"), units.get("Value"))
    return replace(measured, format=measured.format + after)


def read_table(path: str, least: int = 3) -> np.ndarray | None:
    """Numbers of a text file (lines, columns) in float64, NaN where there is none; None if line 1 is not of numbers.

    Columns are separated by blanks, tabs, commas or semicolons.  The decimal mark is a point, or a comma if commas do
    not separate columns.  # begins a comment.  A .csv may begin with lines of words, which are passed over up to the
    first line of `least` numbers.  Raises InputError, without the path, if lines differ in length.
    """
    _, style, passed = _opening(path, least)
    if style is None:
        return None
    if style[1] == ".":
        try:
            return np.loadtxt(path, delimiter=style[0], ndmin=2, encoding="utf-8-sig", skiprows=passed)
        except ValueError:  # fields without a number, or not a table: slowly, to say where
            pass
    rows: list[list[float]] = []
    with open(path, encoding="utf-8-sig", errors="replace") as file:
        for number, line in enumerate(file, 1):
            line = line.partition("#")[0]
            if number <= passed or not line.strip():
                continue
            fields = _fields(line, style)
            if fields is None or len(fields) != len(rows[0] if rows else fields):
                fault = "is not a line of numbers" if fields is None else f"has {len(fields)} numbers"
                raise InputError(f"line {number} {fault}, unlike the first, which has {len(rows[0]) if rows else 0}")
            rows.append(fields)
    table = np.array(rows)
    return table[:, :-1] if np.isnan(table[:, -1]).all() else table  # each line ends in a separator


def read_curve(path: str, name: str) -> tuple[np.ndarray, np.ndarray]:
    """q and a function of it, each (m,): two columns of a text or of an .npy file; `name`: of the function, for
    messages.  Raises InputError, with the path: not such a table, not all positive, or q not increasing.
    """
    with named(path), damage_reported("cannot be read as a table"):
        is_array = path.endswith(".npy")
        table = np.load(path, allow_pickle=False) if is_array else read_table(path, 2)
        if table is None or table.dtype.kind not in "fiu" or table.shape[1:] != (2,) or len(table) < 2:
            raise InputError(f"must hold two columns of numbers, q and {name}, and at least two lines")
        q, values = table.T.astype(np.float64)
        if not (np.isfinite(table).all() and (q > 0).all() and (np.diff(q) > 0).all() and (values > 0).all()):
            raise InputError(f"all q and {name} must be > 0 and finite, each q larger than the one before")
    return q, values


def _opening(path: str, least: int) -> tuple[list[str], tuple[str | None, str] | None, int]:
    """(comments, style, passed): the comments at the beginning of the file, and how the first other line writes its
    numbers, None if it has words.  If a .csv has a line of `least` numbers among the first HEADER ones, that line
    counts, and `passed` is the number of lines before it; 0 where these are no words.
    """
    comments: list[str] = []
    styles: list[tuple[str | None, str] | None] = []  # of lines that are no comments
    table = os.fspath(path).lower().endswith(".csv")
    with open(path, encoding="utf-8-sig", errors="replace") as file:
        for passed in range(HEADER if table else MOST_COMMENTS):
            line = file.readline(2**22)  # a file with longer lines is no text
            if line.startswith("#"):
                comments.append(line)
            elif not line:
                break
            elif (line := line.partition("#")[0]).strip():
                style = _style(line)
                if not table or style and len(_fields(line, style) or []) >= least:
                    return comments, style, passed if styles else 0
                styles.append(style)
    return comments, styles[0] if styles else None, 0


def _style(line: str) -> tuple[str | None, str] | None:
    """How the numbers of a line are written; None if it does not consist of numbers."""
    return next((style for style in STYLES if _fields(line, style) is not None), None)


def _fields(line: str, style: tuple[str | None, str]) -> list[float] | None:
    """The numbers of a line, NaN for those that are missing; None if the line is not written in that style."""
    separator, mark = style
    fields = [field.strip().strip('"') for field in line.rstrip("\r\n").split(separator)]
    if mark != "." and any("." in field for field in fields) or not line.strip():
        return None
    try:
        return [np.nan if field.lower() in NOTHING else float(field.replace(mark, ".")) for field in fields]
    except ValueError:
        return None


def _on_lattice(points: np.ndarray, lateral: str | None, value: str | None) -> Measurement:
    """The heights of points (count, 3) as an array over the lattice that their coordinates form."""
    points = points[~np.isnan(points[:, 2])]
    if not len(points) or not np.isfinite(points[:, :2]).all():
        raise InputError("three columns are x, y and height, but not all of them are finite numbers")
    (i, step_x), (j, step_y) = (_lattice(points[:, axis]) for axis in (0, 1))
    shape = int(i.max()) + 1, int(j.max()) + 1
    if min(shape) < 2:
        raise InputError("holds a line scan, not the heights of a surface")
    if 2 * len(points) < shape[0] * shape[1]:
        raise InputError(
            f"three columns are x, y and height: {len(points)} points do not fill the lattice of {shape[0]} x "
            f"{shape[1]} that their coordinates would form; interpolate them to one first"
        )
    heights = np.full(shape, np.nan)
    heights[i, j] = points[:, 2]
    if np.count_nonzero(~np.isnan(heights)) < len(points):
        raise InputError("three columns are x, y and height: two heights at one point")
    if lateral is not None and value is not None:
        heights *= conversion(value, lateral)
    unit = lateral if lateral is not None else value
    return Measurement(heights, "text, coordinates and heights", (shape[0] * step_x, shape[1] * step_y), unit)


def _lattice(values: np.ndarray) -> tuple[np.ndarray, float]:
    """Indices 0, 1, … of coordinates on equidistant lines, and the spacing of the lines.  Raises InputError."""
    lowest, highest = values.min(), values.max()
    steps = np.diff(np.unique(values))
    steps = steps[steps > SAME * (highest - lowest)]
    if not len(steps):
        return np.zeros(len(values), int), 0.0
    step = (highest - lowest) / np.rint((highest - lowest) / steps.min())  # free of the rounding of single values
    number = np.rint((values - lowest) / step)
    if np.abs(values - lowest - step * number).max() > LATTICE * step:
        raise InputError(
            "three columns are x, y and height, but their points lie on no lattice of equal distances; interpolate "
            "them to one first"
        )
    return number.astype(int), float(step)


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
                with _unpacked(path, dataset) as (inner, of_inner), _read(inner, of_inner) as measured:
                    yield measured
            else:
                with _read(path, dataset) as measured:
                    yield measured
        except FileNotFoundError:
            raise InputError("no such file") from None


@contextmanager
def _read(path: str, dataset: str | None) -> Iterator[Measurement]:
    """The heights in a file that is not packed."""
    if not os.path.getsize(path):
        raise InputError("is empty")
    if path.lower().endswith(TIFF_SUFFIXES):
        yield _tiff(path)
    elif not is_array(path, dataset):
        yield (read_text(path) if dataset is None else None) or _instrument(path, dataset)
    elif path.endswith(".npy"):
        if dataset is not None:
            raise InputError(f"holds no dataset {printable(dataset)!r}: .npy files are one array")
        yield _checked(Measurement(np.lib.format.open_memmap(path, mode="r"), "NumPy array"))
    else:
        import h5py

        with h5py.File(path, "r", locking=False) as file:
            yield _checked(_described(_dataset(file, dataset)))


@contextmanager
def _unpacked(path: str, dataset: str | None) -> Iterator[tuple[str, str | None]]:
    """A file with the content of a .gz, or of one member of a .zip, that lasts for the block, and the dataset in it."""
    with tempfile.TemporaryDirectory(prefix="pgfmd-") as folder, damage_reported("cannot be unpacked"):
        if path.lower().endswith(".gz"):
            inner = os.path.join(folder, os.path.basename(path)[:-3])
            with gzip.open(path) as source, open(inner, "wb") as target:
                shutil.copyfileobj(source, target)
        else:
            with zipfile.ZipFile(path) as archive:
                names = [name for name in archive.namelist() if not name.endswith("/") and name[:8] != "__MACOSX"]
                name = names[0] if len(names) == 1 else dataset or ""
                if name not in names:
                    listed = printable(", ".join(names), 300) or "none"
                    which = 'which of its files holds the heights (path = "file.zip:name")'
                    raise InputError(f"say {which}; found: {listed}")
                inner, dataset = archive.extract(name, folder), None if name == dataset else dataset
        yield inner, dataset


def _checked(measured: Measurement) -> Measurement:
    """The measurement; raises InputError unless it is a matrix of real numbers."""
    array = measured.array
    if array.dtype.kind not in "fiu":
        raise InputError(f"heights must be real numbers, not {array.dtype}")
    if len(array.shape) != 2 or not array.size:
        raise InputError(f"array of shape {tuple(array.shape)}: must be two-dimensional and not empty")
    return measured


def _described(dataset: h5py.Dataset) -> Measurement:
    """A dataset with its attributes `units` (or `unit`), scale_factor, add_offset and _FillValue (netCDF)."""
    unit = dataset.attrs.get("units", dataset.attrs.get("unit"))
    if isinstance(unit, bytes):
        unit = unit.decode(errors="replace")
    unit = unit.strip() if isinstance(unit, str) else ""
    unit = None if unit in NO_UNIT else unit

    def number(name: str, default: float | None) -> Any:
        value = np.asarray(dataset.attrs.get(name, np.nan))
        return value.item() if value.size == 1 and value.dtype.kind in "fiu" and not np.isnan(value) else default

    scaling = number("scale_factor", 1.0), number("add_offset", 0.0), number("_FillValue", None)
    return Measurement(dataset, f"HDF5 dataset {printable(dataset.name)}", None, unit, *scaling)


def _two_dimensional(file: h5py.File) -> list[str]:
    """Names of the two-dimensional datasets."""
    names: list[str] = []
    file.visititems(lambda key, item: names.append(key) if getattr(item, "ndim", 0) == 2 else None)
    return names


def _dataset(file: h5py.File, name: str | None) -> h5py.Dataset:
    if name is not None:
        if not hasattr(file.get(name), "dtype"):
            raise InputError(f"holds no dataset {printable(name)!r}")
        return file[name]
    names = _two_dimensional(file)
    choice = [key for key in names if key in ("height", "heights")] or names
    if len(choice) != 1:
        listed = printable(", ".join(names[:5]), 200) or "none"
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
        try:
            reader = SurfaceTopography.open_topography(_source(path))
        except SurfaceTopography.Exceptions.CannotDetectFileFormat:  # it lists what each of its readers found
            raise ValueError(f"of no format that it knows, or damaged; {NO_TABLE}") from None
        with reader:
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
    """The file; of SDF of EUR 15178 (BCR), the bytes with the magic word of ISO 25178-71, which the package knows."""
    with open(path, "rb") as file:
        if file.read(8) not in (b"aBCR-1.0", b"bBCR-1.0"):
            return path
        file.seek(0)
        content = file.read()
    return io.BytesIO(content[:1] + b"ISO" + content[4:])
