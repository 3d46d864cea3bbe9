"""The periodic cell as a job describes it: points, and their spacing or the cell's size.  No MPI here."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pgfmd.options.rules import POSITIVE, integer, pair
from pgfmd.options.section import Section, key, wrong
from pgfmd.options.text import show

TRANSFORMS = ("blocked", "mpi4py-fft")  # `grid.transforms`, or the library (`grid.library_transform`)
WORKSPACE = {"blocked": 8.0, "mpi4py-fft": 52.0}
"""Memory of transforms in bytes per grid point: the strips of blocked ones on one node (on several it is twice that);
the library's arrays in both precisions, measured."""


@dataclass(frozen=True, kw_only=True)
class Cell(Section):
    """The periodic cell and its grid of points."""

    where = "grid"
    n: tuple[int, int] = key(
        pair(integer(1)), about="points [nx, ny]; one number: both; left out: those of the file of heights",
        needed=True, example=512,
    )  # fmt: skip
    length: tuple[float, float] | None = key(pair(POSITIVE), about="of the cell, [lx, ly]; or spacing", unit="length")
    spacing: tuple[float, float] | None = key(
        pair(POSITIVE), about="of the grid, [ax, ay]; neither given: as in the file of heights, else 1", unit="length"
    )
    refine: int = key(
        integer(1),
        1,
        "contacts are solved on a grid with so many times the points each way, onto which the heights are interpolated "
        "by their Fourier modes: a smaller error where roughness reaches the pixel",
    )

    def check(self) -> None:
        if max(self.n) < 2:
            raise wrong(self, "n", "at least one direction must have 2 points")
        if self.length and self.spacing:
            raise wrong(self, "spacing", f"give either length or spacing, not both (length = {show(self.length)})")
        if not all(0 < value < math.inf for value in (*self.lengths, *self.spacings, math.prod(self.lengths))):
            raise wrong(self, "length" if self.length else "spacing", "cell or spacing is out of range of a float64")

    @property
    def refined(self) -> Cell:
        """The grid on which contacts are solved."""
        nx, ny = (self.refine * n for n in self.n)
        return Cell(n=(nx, ny), length=self.lengths) if self.refine > 1 else self

    @property
    def shape(self) -> tuple[int, int]:
        """Points (nx, ny)."""
        return self.n

    @property
    def lengths(self) -> tuple[float, float]:
        """Cell (lx, ly)."""
        if self.length:
            return self.length
        spacings = self.spacing or (1.0, 1.0)
        return self.n[0] * spacings[0], self.n[1] * spacings[1]

    @property
    def spacings(self) -> tuple[float, float]:
        """Grid spacings (ax, ay)."""
        return self.spacing or (self.lengths[0] / self.n[0], self.lengths[1] / self.n[1])
