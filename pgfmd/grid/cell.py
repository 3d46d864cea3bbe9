"""The cell or patch as a job describes it: points, and their spacing or the cell's size.  No MPI here."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pgfmd.grid.domain import DOMAINS, Domain
from pgfmd.options.rules import POSITIVE, choice, integer, pair
from pgfmd.options.section import Section, key, wrong
from pgfmd.options.text import show

TRANSFORMS = ("blocked", "mpi4py-fft")  # `grid.transforms`, or the library (`grid.library_transform`)
WORKSPACE = {"blocked": 8.0, "mpi4py-fft": 52.0}
"""Memory of transforms in bytes per grid point: the strips of blocked ones on one node (on several it is twice that);
the library's arrays in both precisions, measured."""


@dataclass(frozen=True, kw_only=True)
class Cell(Section):
    """The grid of points, on a periodic cell or, with boundary = "open", on a patch outside of which nothing acts."""

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

    boundary: str = key(
        choice(*DOMAINS), "periodic", "open: a patch of an infinite surface, outside of which no pressure acts"
    )

    def check(self) -> None:
        if self.boundary == "open" and self.refine > 1:
            raise wrong(
                self, "refine", 'must be 1 with boundary = "open": heights that do not wrap have no Fourier modes'
            )
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
        return Cell(n=(nx, ny), length=self.lengths, boundary=self.boundary) if self.refine > 1 else self

    @property
    def domain(self) -> Domain:
        """Which points may bear pressure, and what wraps."""
        return DOMAINS[self.boundary]

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
