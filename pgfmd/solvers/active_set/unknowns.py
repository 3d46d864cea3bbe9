"""The points of a slab that are unknowns, listed row by row (compressed rows), and vectors on them."""

from __future__ import annotations

import math

import numpy as np

from pgfmd.grid.kernels import jit, u
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.parallel.layout import Exchange

HALO = 3  # rows of neighbouring ranks on either side: the radius of a stencil
PIECE = 64  # points of a row; where few are unknowns, most pieces have none
SHORT = 1 << 16  # columns up to which two bytes number them: .6 bytes per point less than with four, at an area of .18
LARGEST = 1e25  # of a residual: sums of such over stencils and meshes stay below what single precision holds

Points = tuple[np.ndarray, np.ndarray]
"""(columns (count,), offsets (rows + 1,)): the points of row i are columns[offsets[i]:offsets[i + 1]]; values are
listed alike."""
Fields = tuple[np.ndarray, np.ndarray]
"""Pressure and gap."""
Part = tuple[int, int]
"""The rows or entries first … stop−1."""


class Unknowns:
    """The unknowns of this rank.

    These are points whose pressure lies between its bounds 0 and `highest`, or at a bound from which the gap drives it
    (below `level` at 0, above it at `highest`).  For gaps as unknowns, the pressure and the gap change places.

    Attributes: count, the number of them; lists and extended, `Points` without and with a halo of `HALO` rows; own,
    the slice of the columns of `extended` that are those of `lists`; alone: on one rank, whose halo
    repeats its own rows, or is empty where fields end at the border.
    Vectors on the set are arrays (count,), or `SetVector`s if neighbouring ranks need them.
    """

    def __init__(self, grid: SlabGrid, fields: Fields, level: float = 0.0, highest: float = math.inf) -> None:
        """fields: pressure and gap (nx_local, ny).  Collective."""
        self.grid, rows = grid, grid.local_shape[0]
        self.halo = grid.around(HALO, rows)
        real = fields[1].dtype.type  # of the limits too, since loops that convert are slower
        index = np.uint16 if grid.shape[1] <= SHORT else np.int32

        def choose(pressure: np.ndarray, gap: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            counts, columns = np.empty(len(gap), np.int64), np.empty(gap.size, index)
            found = choose_points((pressure, gap), real(level), real(highest), counts, columns)
            return counts, columns[:found].copy()

        parts = grid.threads.collect(lambda a, b: choose(fields[0][a:b], fields[1][a:b]), rows, grid.band)
        self.alone = grid.comm.size == 1 and min(len(parts[0][0]), len(parts[-1][0])) >= HALO
        if self.alone and grid.domain.wraps:
            (first, start), (last, end) = parts[0], parts[-1]
            before = last[-HALO:], end[len(end) - int(last[-HALO:].sum()) :]
            after = first[:HALO], start[: int(first[:HALO].sum())]
        else:
            around = grid.neighbours(fields, HALO, (0.0, math.inf))
            before, after = (choose(*(field[part] for field in around)) for part in (slice(HALO), slice(HALO, None)))
        counts, lists = zip(before, *parts, after, strict=True)
        columns, offsets = self.extended = np.concatenate(lists), np.concatenate([[0], *counts]).cumsum()
        own = offsets[HALO : HALO + rows + 1]
        self.own = slice(int(own[0]), int(own[-1]))
        self.count = self.own.stop - self.own.start
        self.lists: Points = columns[self.own], own - own[0]

    def below(self, level: float, field: np.ndarray) -> SetVector:
        """level − field (nx_local, ny) on the set, in single precision and at most `LARGEST`."""
        out, line = SetVector(self), (level, -1.0)
        self.grid.threads.deal(lambda a, b: take_points(field[a:b], self.lists, a, line, out.own), len(field))
        return out

    def values(self, field: np.ndarray) -> np.ndarray:
        """A field (nx_local, ny) on the set, in its precision, at most `LARGEST`."""
        out = np.empty(self.count, field.dtype)
        self.grid.threads.deal(lambda a, b: take_points(field[a:b], self.lists, a, (0.0, 1.0), out), len(field))
        return out

    def add(self, field: np.ndarray, values: np.ndarray) -> None:
        """Adds values (count,) to a field (nx_local, ny) on the set."""
        self.grid.threads.deal(lambda a, b: add_points(values, self.lists, a, field[a:b]), len(field))


class SetVector:
    """A vector (count,) on a set, `own`, within an array `all` in the order of `Unknowns.extended`."""

    def __init__(self, points: Unknowns) -> None:
        self.points, self.all = points, np.empty(len(points.extended[0]), np.float32)
        self.own = self.all[points.own]

    def send(self, exchange: Exchange) -> None:
        """Adds to an exchange what brings the present values of the halo.  `own` may be read meanwhile."""
        if not self._repeat():
            exchange.fetch(self.points.halo, self.own, self.all, (self.points.lists[1], self.points.extended[1]))

    def exchange(self) -> None:
        """Brings the present values of the halo.  Collective."""
        if not self._repeat():
            exchange = Exchange(self.points.grid.comm)
            self.send(exchange)
            exchange.carry_out()

    def _repeat(self) -> bool:
        """Sets the halo, if it repeats rows of this rank; returns whether."""
        if self.points.alone:
            before, after = self.points.own.start, len(self.all) - self.points.own.stop
            self.all[:before], self.all[len(self.all) - after :] = self.own[len(self.own) - before :], self.own[:after]
        return self.points.alone


@jit
def choose_points(fields: Fields, level: float, highest: float, counts: np.ndarray, columns: np.ndarray) -> int:
    """Lists the columns of the unknowns among some rows, and how many each row has; returns how many there are."""
    count = 0
    for i in range(counts.size):
        before, p, g = count, fields[0][i], fields[1][i]
        for first in range(0, p.size, PIECE):
            stop, some = min(first + PIECE, p.size), False
            for j in range(first, stop):  # vectorised; most pieces have none
                some |= ((p[u(j)] > 0) | (g[u(j)] < level)) & ((p[u(j)] < highest) | (g[u(j)] > level))
            for j in range(first, stop if some else first):
                columns[u(count)] = j
                count += ((p[u(j)] > 0) | (g[u(j)] < level)) & ((p[u(j)] < highest) | (g[u(j)] > level))
        counts[i] = count - before
    return count


@jit
def take_points(field: np.ndarray, points: Points, first: int, line: tuple[float, float], out: np.ndarray) -> None:
    """out[k] = a + b · field[i, columns[k]], at most `LARGEST`, for the points k of row first + i; line: a and b."""
    columns, offsets = points
    a, b = line
    for i in range(field.shape[0]):
        row = field[i]
        for k in range(offsets[first + i], offsets[first + i + 1]):
            out[k] = min(max(a + b * row[u(columns[k])], -LARGEST), LARGEST)


@jit
def add_points(values: np.ndarray, points: Points, first: int, field: np.ndarray) -> None:
    """field[i, columns[k]] += values[k] for the points k of row first + i."""
    columns, offsets = points
    for i in range(field.shape[0]):
        row = field[i]
        for k in range(offsets[first + i], offsets[first + i + 1]):
            row[u(columns[k])] += values[k]
