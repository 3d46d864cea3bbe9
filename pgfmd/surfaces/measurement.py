"""The content of a file of heights: an array, with sides and unit if the file says them.  No MPI here."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from pgfmd.errors import InputError
from pgfmd.options.text import printable, reason
from pgfmd.parallel.collectives import slab

# Powers of ten of a metre.
UNITS = {"km": 3, "m": 0, "cm": -2, "mm": -3, "µm": -6, "nm": -9, "Å": -10, "pm": -12}
ALIASES = {"um": "µm", "\u03bcm": "µm", "A": "Å", "\u212b": "Å"}  # Greek mu, the angstrom sign
for _prefix, _unit in {"kilo": "km", "": "m", "centi": "cm", "milli": "mm", "micro": "µm", "nano": "nm"}.items():
    ALIASES |= {f"{_prefix}{name}": _unit for name in ("meter", "meters", "metre", "metres")}
ALIASES |= {"micron": "µm", "microns": "µm", "angstrom": "Å", "angstroms": "Å"}
FEW = 1 / 3  # part of the points up to which missing ones are filled unasked
CELL_DIGITS = 1e-3  # relative tolerance of the cell's sides against the file's: jobs give them with a few digits


@contextmanager
def named(path: str) -> Iterator[None]:
    """Puts the path before the message of an InputError raised inside the block."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


@contextmanager
def damage_reported(message: str) -> Iterator[None]:
    """Turns any error but InputError and MemoryError into an InputError: the message, then the reason, on one line."""
    try:
        yield
    except (InputError, MemoryError):
        raise
    except Exception as error:
        raise InputError(f"{message}: {printable(reason(error), 200)}") from None


@dataclass(frozen=True)
class Measurement:
    """Heights (nx, ny) as a file holds them: entry [i, j] of `array`, or [j, i] if transposed, times `factor` plus
    `offset`, at x = i aₓ, y = j a_y; NaN, masked or equal to `fill` where nothing was measured.

    array: NumPy array, memory map or HDF5 dataset, of which only the rows asked for are read.  format: in words.
    lengths (lx, ly), and unit of these and of the heights: None where the file does not say them.
    """

    array: Any
    format: str
    lengths: tuple[float, float] | None = None
    unit: str | None = None
    factor: float = 1.0
    offset: float = 0.0
    fill: float | None = None
    transposed: bool = False

    @property
    def shape(self) -> tuple[int, int]:
        """(nx, ny)."""
        nx, ny = self.array.shape
        return (ny, nx) if self.transposed else (nx, ny)

    def rows(self, first: int, stop: int) -> np.ndarray:
        """Heights first … stop−1 (stop − first, ny) in float64, NaN where nothing was measured."""
        block = self.array[:, first:stop].T if self.transposed else self.array[first:stop]
        with np.errstate(invalid="ignore", over="ignore"):  # heights that are not finite are refused later
            heights = np.array(np.ma.getdata(block), dtype=np.float64, order="C")
            if np.ma.isMaskedArray(block) or self.fill is not None:
                heights[np.ma.getmaskarray(block) | (np.ma.getdata(block) == self.fill)] = np.nan
            heights *= self.factor
            heights += self.offset
        return heights

    def turned(self) -> Measurement:
        """The same with x and y exchanged."""
        return dataclasses.replace(self, lengths=self.lengths and self.lengths[::-1], transposed=not self.transposed)

    def fitted(
        self, shape: tuple[int, int], lengths: tuple[float, float], copies: int, unit: str | None
    ) -> Measurement:
        """`converted` to the unit, if it fits a cell of `shape` points and sides `lengths`; copies: 2 if mirrored.

        Else raises InputError, which names all of points, unit and size that disagree, and what to write.
        """
        converted, faults = self, []
        points = [copies * count for count in self.shape]
        mirrored = ", with its mirror images" * (copies == 2)
        if tuple(points) != tuple(shape):
            turned = ' (or first_axis, the other of "x" and "y", under [surface])' * (points[::-1] == list(shape))
            faults.append(
                f"holds {points[0]} x {points[1]} points{mirrored}, the grid has {shape[0]} x {shape[1]}: "
                f"write n = {points} under [grid]{turned}"
            )
        try:
            converted = self.converted(unit)
        except InputError as error:
            faults.append(str(error))
        sides = [copies * side for side in converted.lengths or ()]
        if sides and not np.allclose(sides, lengths, rtol=CELL_DIGITS, atol=0):
            given = f" {converted.unit}" if converted.unit else ""
            faults.append(
                f"measures {sides[0]:.9g} x {sides[1]:.9g}{given}{mirrored}, the cell is "
                f"{lengths[0]:.9g} x {lengths[1]:.9g}: write length = [{sides[0]:.9g}, {sides[1]:.9g}] under [grid]"
                + converted._other_unit(sides, lengths, unit)
            )
        if faults:
            raise InputError("; it ".join(faults) + "; or leave out what the file says")
        return converted

    def _other_unit(self, sides: list[float], lengths: tuple[float, float], unit: str | None) -> str:
        """Advice for a cell whose sides are those of the file in another unit; "" if they are in none."""
        job = "" if usual_name(unit) in UNITS else ', and write length_unit = "m" under [output]'
        known = usual_name(self.unit or ("m" if job else unit))
        if known not in UNITS or not (self.unit or self.format.startswith("text")):
            return ""
        for name in UNITS:
            factor = conversion(known, name) if self.unit else conversion(name, known)
            if np.allclose(np.multiply(sides, factor), lengths, rtol=CELL_DIGITS, atol=0):
                if self.unit:
                    return f' (or length_unit = "{name}" under [output], if the lengths of the job are in it)'
                lines = f'"# Lateral units: {name}" and "# Value units: {name}"'
                return f" (or, if it is in {name}, begin it with {lines}{job})"
        return ""

    def converted(self, unit: str | None) -> Measurement:
        """The same in `unit`; unchanged if one of the two units is None.

        Raises InputError if the units differ and one of them is not a length known here.
        """
        if self.unit is None or unit is None:
            return self
        by = conversion(self.unit, unit)
        lengths = self.lengths and (float(by * self.lengths[0]), float(by * self.lengths[1]))
        return dataclasses.replace(self, lengths=lengths, unit=unit, factor=by * self.factor, offset=by * self.offset)

    def described(self) -> str:
        """Format, points, size and unit, in words."""
        (nx, ny), unit = self.shape, self.unit or "unit not said"
        size = f"{self.lengths[0]:.6g} x {self.lengths[1]:.6g}, " if self.lengths else ""
        axis = "y" if self.transposed else "x"
        return f"{self.format}, {nx} x {ny} points, first axis {axis}, {size}{printable(unit)}"


def holes_in_words(holes: int, size: int, rule: str) -> str:
    """What happens to `holes` missing of `size` points, or "".  Raises InputError if `rule`, the key `missing` of the
    surface, does not allow so many.
    """
    part = f"{holes} of {size} points ({holes / size:.2g} of all) were not measured"
    if holes == size:
        raise InputError("no point was measured")
    if holes > FEW * size and rule == "few":
        raise InputError(
            f'{part}: too many to fill them unasked; missing = "interpolate" under [surface] fills them '
            "(contacts there are lost), or cut out a part that was measured"
        )
    return f"{part}: interpolated between their neighbours" * (holes > 0)


def is_topography(given: Any) -> bool:
    """Whether this is a topography of the package SurfaceTopography."""
    return hasattr(given, "heights") and hasattr(given, "physical_sizes")


def measured_heights(given: Any, spacing: Any, comm: Any) -> tuple[Any, Any]:
    """(heights, spacing) of a topography: this rank's rows, NaN where undefined.  (given, spacing) if `given` is none.
    Raises InputError if a spacing is given, and is not the topography's.
    """
    if not is_topography(given):
        return given, spacing
    if given.dim != 2 or given.physical_sizes is None:
        raise InputError("heights: a topography must be two-dimensional and have a size")
    own = tuple(float(side) / count for side, count in zip(given.physical_sizes, given.nb_grid_pts, strict=True))
    if spacing is not None and not np.allclose(spacing, own, rtol=CELL_DIGITS, atol=0):
        raise InputError(f"spacing = {spacing}: the topography's is {own[0]:.9g}, {own[1]:.9g}; leave it out")
    heights = np.ma.filled(np.ma.asarray(given.heights(), dtype=np.float64), np.nan)
    if comm.size > 1 and not given.is_domain_decomposed:
        heights = heights[slab(len(heights), comm.size, comm.rank)]
    return heights, own


def usual_name(unit: str | None) -> str | None:
    """The spelling in UNITS of a unit of length; any other name, or None, as it is."""
    return ALIASES.get(unit, unit) if unit else unit


def conversion(given: str, wanted: str) -> float:
    """Factor from one unit of length to another; raises InputError if they differ and one of them is not in UNITS."""
    given, wanted = ALIASES.get(given, given), ALIASES.get(wanted, wanted)
    if given == wanted:
        return 1.0
    if given not in UNITS:
        raise InputError(
            f"is in {printable(given)!r}, which is none of the lengths {', '.join(UNITS)} nor the job's "
            f"length_unit = {printable(wanted)!r}"
        )
    if wanted not in UNITS:
        raise InputError(
            f'is in {given}: write length_unit = "{given}" under [output], or another of {", ".join(UNITS)}, and all '
            "lengths of the job in it"
        )
    return float(f"1e{UNITS[given] - UNITS[wanted]}")
