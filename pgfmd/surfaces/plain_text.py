"""Plain text: tables of numbers, and heights as a matrix or as x, y, height of points on a lattice.  No MPI here.

SurfaceTopography reads texts that say sizes or units.  Of 280 random matrices of the dialects below it reads 92 right,
and 14 as other heights; of 299 lists of points, 254 and 32.
"""

from __future__ import annotations

import os
import re
from dataclasses import replace

import numpy as np

from pgfmd.errors import InputError
from pgfmd.surfaces.measurement import Measurement, conversion, damage_reported, named

# Ways to write a line of numbers: what separates them (None: blanks), and the decimal mark.
STYLES = ((",", "."), ("\t", "."), (None, "."), (";", "."), (";", ","), ("\t", ","), (None, ","))
NOTHING = {"", "nan", "bad", "na", "n/a", "null", "none", "---", "--", "***"}  # fields of points not measured
UNIT = re.compile(r"(Lateral|Value) units:\s*(\S+)")  # of coordinates and heights, as Gwyddion exports points
FOREIGN = re.compile(r"(?i)\bunit|[:=]\s*\S*\d")  # in comments that give sizes or units: SurfaceTopography reads these
HEADER = 200  # lines of a .csv in which the first line of numbers is looked for
MOST_COMMENTS = 10**6  # lines of another text before its first line of numbers
LATTICE = 0.05  # distance from the lattice, over its spacing, at which a point still belongs to it
SAME = 1e-6  # coordinates closer than that, over their range, are equal


def read(path: str) -> Measurement | None:
    """The heights of a text file; None if it is no table of numbers, or if a comment gives sizes or units that only
    SurfaceTopography understands.

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
    found = _on_lattice(numbers, units.get("Lateral"), units.get("Value"))
    return replace(found, format=found.format + after)


def read_table(path: str, least: int = 3) -> np.ndarray | None:
    """The numbers of a text file (lines, columns) in float64, NaN where a field says that there is none; None if its
    first line does not consist of numbers.

    Columns are separated by blanks, tabs, commas or semicolons.  The decimal mark is a point, or a comma if commas do
    not separate columns.  # begins a comment.  A .csv may begin with lines of words, which are passed over up to the
    first line of `least` numbers.  Raises InputError, without the path, if lines differ in length.
    """
    _, first, passed = _opening(path, least)
    style = _style(first)
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
                found = "is not a line of numbers" if fields is None else f"has {len(fields)} numbers"
                raise InputError(f"line {number} {found}, unlike the first, which has {len(rows[0]) if rows else 0}")
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


def _opening(path: str, least: int) -> tuple[list[str], str, int]:
    """(comments, first, passed): the comments at the beginning of the file, and the first line that is neither comment
    nor blank.  If a .csv has a line of `least` numbers among the first HEADER ones, `first` is that line, and `passed`
    the number of lines before it; passed = 0 where no line of words comes before `first`.
    """
    comments: list[str] = []
    first, words, table = "", 0, os.fspath(path).lower().endswith(".csv")
    with open(path, encoding="utf-8-sig", errors="replace") as file:
        for passed in range(HEADER if table else MOST_COMMENTS):
            line = file.readline(2**22)  # a file with longer lines is no text
            if line.startswith("#"):
                comments.append(line)
            elif not line:
                break
            elif (line := line.partition("#")[0]).strip():
                first = first or line
                style = _style(line)
                if not table or style and len(_fields(line, style) or []) >= least:
                    return comments, line, passed if words else 0
                words += 1
    return comments, first, 0


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
    """The heights of points (count, 3) on the lattice that their coordinates form."""
    points = points[~np.isnan(points[:, 2])]
    if not len(points) or not np.isfinite(points[:, :2]).all():
        raise InputError("three columns are x, y and height, but not all of them are finite")
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
    """Numbers 0, 1, … of coordinates on equidistant lines, and the distance of these.  Raises InputError."""
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
