"""What a file says that holds more than bare numbers: heights, the size of the rectangle, and a unit.  No MPI here."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pgfmd.errors import InputError
from pgfmd.options.text import printable

# Powers of ten of a metre.
UNITS = {"km": 3, "m": 0, "cm": -2, "mm": -3, "µm": -6, "nm": -9, "Å": -10, "pm": -12}
ALIASES = {"um": "µm", "\u03bcm": "µm", "A": "Å", "\u212b": "Å"}  # Greek mu, the angstrom sign
CELL_DIGITS = 1e-3  # relative difference of a cell that is still the measured one: jobs are written with a few digits


@dataclass(frozen=True)
class Measurement:
    """Heights (nx, ny) in float64, NaN where nothing was measured; size (lx, ly) of the rectangle and unit of both,
    None where the file does not say it; the format, in words.
    """

    heights: np.ndarray
    lengths: tuple[float, float] | None
    unit: str | None
    format: str

    def converted(self, unit: str | None) -> Measurement:
        """The same in `unit`; unchanged if one of the two units is not said.

        Raises InputError if `unit` or that of the file is not a length known here.
        """
        if self.unit is None or unit is None:
            return self
        factor = conversion(self.unit, unit)
        lengths = self.lengths and (float(factor * self.lengths[0]), float(factor * self.lengths[1]))
        return Measurement(self.heights * factor, lengths, unit, self.format)

    def check(self, shape: tuple[int, int], lengths: tuple[float, float], copies: int) -> None:
        """Whether grid and cell fit; `copies` = 2 if the cell is made of mirror images.  Raises InputError."""
        points = [copies * count for count in self.heights.shape]
        mirrored = ", with its mirror images" * (copies == 2)
        if tuple(points) != tuple(shape):
            raise InputError(
                f"holds {points[0]} x {points[1]} points{mirrored}, the grid has {shape[0]} x {shape[1]}: "
                f"write n = {points} under [grid]"
            )
        if self.lengths is None:
            return
        sides = [copies * side for side in self.lengths]
        if not np.allclose(sides, lengths, rtol=CELL_DIGITS, atol=0):
            unit = f" {self.unit}" if self.unit else ""
            raise InputError(
                f"measures {sides[0]:.9g} x {sides[1]:.9g}{unit}{mirrored}, the cell is "
                f"{lengths[0]:.9g} x {lengths[1]:.9g}: write length = [{sides[0]:.9g}, {sides[1]:.9g}] under [grid]"
            )


def conversion(given: str, wanted: str) -> float:
    """Factor from one unit of length to another; raises InputError if one of them is not in UNITS."""
    given, wanted = ALIASES.get(given, given), ALIASES.get(wanted, wanted)
    if given not in UNITS:
        raise InputError(f"is in {printable(given)!r}, which is none of the lengths {', '.join(UNITS)}")
    if wanted not in UNITS:
        raise InputError(
            f'is in {given}: write length_unit = "{given}" under [output], or another of {", ".join(UNITS)}, and all '
            "lengths of the job in it"
        )
    return float(f"1e{UNITS[given] - UNITS[wanted]}")
