"""The points of a slab that are unknowns, listed row by row (compressed rows), and vectors on them.

In the primal steps these are points in contact, in the dual ones the others.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import DTypeLike

from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.parallel.layout import Exchange

HALO = 2  # rows of neighbouring ranks on either side: the radius of a stencil
LARGEST = 1e25  # of a residual: sums of such over stencils and meshes stay below what single precision holds

Points = tuple[np.ndarray, np.ndarray]
"""(columns, offsets): the points of row i are columns[offsets[i]:offsets[i + 1]]; values are listed alike."""
Fields = tuple[np.ndarray, np.ndarray]
"""Pressure and gap."""
Part = tuple[int, int]
"""The rows or entries first … stop−1."""


class Unknowns:
    """The unknowns of this rank.

    These are points whose pressure lies between its bounds 0 and `highest`, or at a bound from which the gap drives it
    (below `level` at 0, above it at `highest`).  For gaps as unknowns, the pressure and the gap change places.

    Attributes: count, the number of them; columns (count,) int32, and offsets (nx_local + 1,) of each row in it.
    `lists` and `extended` are `Points`, without and with a halo of `HALO` rows.
    Vectors on the set are arrays (count,), or `SetVector`s if neighbouring ranks need them.
    """

    def __init__(self, grid: SlabGrid, fields: Fields, level: float = 0.0, highest: float = math.inf) -> None:
        """fields: pressure and gap (nx_local, ny).  Collective."""
        self.grid, rows = grid, grid.local_shape[0]
        self.halo, around = grid.around(HALO, rows), grid.neighbours(fields, HALO)

        def choose(pressure: np.ndarray, gap: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            chosen = ((pressure > 0) | (gap < level)) & ((pressure < highest) | (gap > level))
            return np.count_nonzero(chosen, axis=1), np.nonzero(chosen)[1].astype(np.int32)

        parts = grid.threads.collect(lambda a, b: choose(fields[0][a:b], fields[1][a:b]), rows)
        before, after = (choose(*(field[part] for field in around)) for part in (slice(HALO), slice(HALO, None)))
        counts, columns = zip(before, *parts, after, strict=True)
        self.extended_offsets = np.concatenate([[0], *counts]).cumsum()
        own = self.extended_offsets[HALO : HALO + rows + 1]
        self.first, self.offsets, self.count = int(own[0]), own - own[0], int(own[-1] - own[0])
        extended = SetVector(self, np.int32)
        self.columns = extended.own
        self.extended: Points = np.concatenate(columns, out=extended.all), self.extended_offsets

    @property
    def lists(self) -> Points:
        """(columns, offsets) of this rank's points."""
        return self.columns, self.offsets

    def places(self, first: int, stop: int) -> tuple[slice, tuple[np.ndarray, np.ndarray]]:
        """Of the points in rows first … stop−1: where they are in a vector, and where in an array of these rows."""
        offsets = self.offsets[first : stop + 1]
        part = slice(offsets[0], offsets[-1])
        return part, (np.repeat(np.arange(stop - first), np.diff(offsets)), self.columns[part])

    def below(self, level: float, field: np.ndarray) -> SetVector:
        """level − field (nx_local, ny) on the set, in single precision and at most `LARGEST`."""
        out = SetVector(self)

        def take(first: int, stop: int) -> None:
            part, at = self.places(first, stop)
            out.own[part] = np.clip(level - field[first:stop][at], -LARGEST, LARGEST)

        self.grid.threads.deal(take, len(field))
        return out

    def add(self, field: np.ndarray, values: np.ndarray) -> None:
        """Adds values (count,) to a field (nx_local, ny) on the set."""

        def add(first: int, stop: int) -> None:
            part, at = self.places(first, stop)
            field[first:stop][at] += values[part]

        self.grid.threads.deal(add, len(field))


class SetVector:
    """A vector (count,) on a set, `own`, within an array `all` of the values of the rows before, its own, and the rows
    after, in the order of `Unknowns.extended`.
    """

    def __init__(self, points: Unknowns, dtype: DTypeLike = np.float32) -> None:
        self.points = points
        self.all = np.empty(points.extended_offsets[-1], dtype)
        self.own = self.all[points.first : points.first + points.count]

    def send(self, exchange: Exchange) -> None:
        """Adds to an exchange what brings the present values of the halo.  `own` may be read meanwhile."""
        exchange.fetch(self.points.halo, self.own, self.all, (self.points.offsets, self.points.extended_offsets))

    def exchange(self) -> np.ndarray:
        """The vector with the present values of its halo.  Collective."""
        exchange = Exchange(self.points.grid.comm)
        self.send(exchange)
        exchange.carry_out()
        return self.all
