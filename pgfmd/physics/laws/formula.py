"""A user-defined wall: any pressure that decreases with the gap, as a formula.

The law is a graph of p over g: the formula between two gaps, a vertical line upwards at the smaller one (a hard wall),
and one down to p = 0 at the larger one.  It is maximal monotone: each line a p − b g = t with a, b ≥ 0, not both 0,
meets it in one point.  A table whose pressures fall by at most 5 % from node to node brackets the point and
interpolates; one step of Newton's method on the formula then gives it to the last digits.

The excess of the certificate is the integral of p − P(g) over g from the gap at p to g' (P: the formula).  As P
decreases, |p − P(g')| |g' − gap(p)| bounds it; where P is linear, the bound is twice the excess.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from pgfmd.errors import InputError
from pgfmd.grid.kernels import u
from pgfmd.options import expressions
from pgfmd.options.rules import interval
from pgfmd.options.section import key, wrong
from pgfmd.parallel.compiled import compiled
from pgfmd.physics.laws.derivative import compiled_pair
from pgfmd.physics.laws.exponential_law import LAST
from pgfmd.physics.laws.law import ContactLaw, Units

if TYPE_CHECKING:
    from pgfmd.physics.solids.solid import Solid

FALL = 1.05  # largest ratio of pressures at neighbouring nodes
NODES, ROUNDS = 256, 60  # equal intervals to begin with; most halvings of one: then its ends differ by a last digit
NEGLIGIBLE = 1e-290  # pressures below it need not decrease: they underflow
APART = 1e-6  # of the range of gaps: pressures of nodes closer than this may be equal, or rise by rounding
CLOSE = 3e-6  # of the width between nodes: the error after so short a Newton step, of second order, is a last digit
BLOCK = 8192  # points at a time, so that arrays stay in cache

Line = tuple[float, float]

_jit = compiled()


class Graph:
    """A formula of `gap` between two gaps, in units: x = (gap − offset)/height, p = P/pressure.

    gaps, pressures: increasing x of the nodes and their p (m,).
    """

    def __init__(self, written: str, gaps: np.ndarray, pressures: np.ndarray, units: Units) -> None:
        self._of, self._physical = written, (gaps, pressures)
        self._scales = units.height, units.pressure, units.offset
        self.gaps, self.pressures = (gaps - units.offset) / units.height, pressures / units.pressure
        self._tables: dict[Line, tuple[np.ndarray, ...]] = {}

    def scaled(self, units: Units) -> Graph:
        """The same in other units."""
        return Graph(self._of, *self._physical, units)

    @property
    def ends(self) -> tuple[float, float]:
        """The smallest gap, and the first node without pressure, or the last node."""
        bearing = int(np.count_nonzero(self._physical[1] > NEGLIGIBLE))
        return float(self.gaps[0]), float(self.gaps[min(bearing, len(self.gaps) - 1)])

    def gap(self, pressure: float) -> float:
        """The gap at that pressure."""
        return float(self.points((1.0, 0.0), np.full(1, pressure))[1, 0])

    def at_pressures(self, pressure: np.ndarray) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
        """Rows of a field (nx, ny), and the gap and dp/dg at the pressures there."""
        for rows in _blocks(pressure):
            _, gap, slope = self.points((1.0, 0.0), pressure[rows])
            yield rows, gap, slope

    def softness(self, pressure: np.ndarray) -> float:
        """Σ p × range over a field (nx, ny)."""
        return sum(
            float(np.vdot(p := pressure[rows], _ranges(p, slope))) for rows, _, slope in self.at_pressures(pressure)
        )

    def points(self, line: Line, targets: np.ndarray) -> np.ndarray:
        """The points with a p − b g = t for the targets t; line: (a, b).  Returns pressure, gap and dp/dg (3, …), which
        is −inf where the graph is vertical, and 0 beyond its end.
        """
        function, table, target = compiled_pair(self._of), self._table(line), targets.ravel()
        found, bracket = np.empty((2, 3, len(target)))
        _guess(target, line, table, found[1], bracket)
        function(found[1], self._scales, found[0], found[2])
        left = np.flatnonzero(_correct(target, line, bracket, found))
        while left.size:
            t, own, new = target[left], bracket[:, left], found[:, left]
            function(new[1], self._scales, new[0], new[2])
            more = _correct(t, line, own, new)
            bracket[:, left], found[:, left] = own, new
            left = left[more]
        return found.reshape(3, *targets.shape)

    def _table(self, line: Line) -> tuple[np.ndarray, ...]:
        """t, gap and dt/dg at the nodes; t is filled up with −inf to a power of 2."""
        if line not in self._tables:
            (a, b), size = line, 1 << len(self.gaps).bit_length()
            keys = np.full(size, -math.inf)
            keys[: len(self.gaps)] = a * self.pressures - b * self.gaps
            rates = np.empty_like(self.gaps)
            compiled_pair(self._of)(self.gaps, self._scales, np.empty_like(rates), rates)
            self._tables[line] = keys, self.gaps, a * rates - b
        return self._tables[line]


@_jit
def _guess(target: np.ndarray, line: Line, table: tuple[np.ndarray, ...], gap: np.ndarray, bracket: np.ndarray) -> None:
    """Brackets the points by nodes, and interpolates between them by cubic polynomials.  bracket: gap of the lower
    node, of the upper one, and their distance (3, m); at an end of the graph both are the end.
    """
    (_, b), (keys, gaps, rates), (low, high, width) = line, table, bracket
    last = gaps.size - 1
    place = np.zeros(target.size, np.uint32)
    size = keys.size // 2
    while size:  # without branches, so that the steps of several points overlap
        for i in range(target.size):
            other = place[u(i)] + np.uint32(size)
            place[u(i)] = other if keys[u(other)] > target[u(i)] else place[u(i)]
        size //= 2
    for i in range(target.size):
        t, k = target[i], place[u(i)]
        if keys[u(0)] <= t or k >= last:
            end = gaps[u(0)] if keys[u(0)] <= t else gaps[u(last)]
            low[i] = high[i] = end
            gap[i] = -t / b if b > 0 and t + b * end <= 0 else end
            width[i] = 0.0
            continue
        x, y, at_x, at_y = gaps[u(k)], gaps[u(k + 1)], keys[u(k)], keys[u(k + 1)]
        part, mean = (t - at_x) / (at_y - at_x), (at_y - at_x) / (y - x)
        bent = (1 - part) * (mean / rates[u(k)] - 1) - part * (mean / rates[u(k + 1)] - 1)
        g, straight = x + (y - x) * part * (1 + (1 - part) * bent), x + (y - x) * part
        low[i], high[i], width[i] = x, y, y - x
        gap[i] = g if x < g < y else straight


@_jit
def _correct(target: np.ndarray, line: Line, bracket: np.ndarray, found: np.ndarray) -> np.ndarray:
    """One step of Newton's method for each point, from the function at its gap; bisection where the step leaves the
    bracket.  found: pressure, gap and dp/dg (3, m).  Returns which points need another step (m,).
    """
    (a, b), (low, high, width), (pressure, gap, slope) = line, bracket, found
    more = np.zeros(target.size, np.bool_)
    for i in range(target.size):
        t, x, y, g, p, d = target[i], low[i], high[i], gap[i], pressure[i], slope[i]
        if x == y:
            pressure[i] = max((t + b * x) / a, 0.0)
            slope[i] = -np.inf if pressure[i] > 0 else 0.0
            continue
        off, rate = a * p - b * g - t, a * d - b
        if off > 0:
            low[i] = x = g
        else:
            high[i] = y = g
        step = off / rate
        new = g - step
        if rate < 0 and abs(step) <= CLOSE * width[i]:
            gap[i] = new
            pressure[i] = max((t + b * new) / a if -a * d > b or b == 0 else p - d * step, 0.0)
            continue
        if not x < new < y:
            new = (x + y) / 2
        gap[i] = new
        more[i] = x < new < y
        if not more[i]:  # a jump
            pressure[i], slope[i] = max((t + b * new) / a, 0.0), -np.inf
    return more


@_jit
def response(line: Line, pressure: np.ndarray, slope: np.ndarray) -> tuple[float, float]:
    """Σ p and Σ dp/dt."""
    a, b = line
    total = rates = 0.0
    for i in range(pressure.size):
        total += pressure[u(i)]
        rates += slope[u(i)] / (a * slope[u(i)] - b) if slope[u(i)] > -np.inf else 1 / a
    return total, rates


@cache
def tabulate(written: str, ends: tuple[float, float]) -> Graph:
    """The graph of a formula between two gaps.  Raises InputError unless it is finite, not negative, and decreases."""
    function = expressions.function(written, "gap")

    def at(gaps: np.ndarray) -> np.ndarray:
        return np.array([expressions.value(function, float(gap)) for gap in gaps])

    gaps = np.linspace(*ends, NODES + 1)
    pressures = at(gaps)
    for _ in range(ROUNDS):
        _check(gaps, pressures)
        middles = (gaps[1:] + gaps[:-1]) / 2
        steep = (pressures[:-1] > FALL * pressures[1:]) & (pressures[:-1] > NEGLIGIBLE)
        steep &= (gaps[:-1] < middles) & (middles < gaps[1:])
        if not steep.any():
            break
        where, added = np.flatnonzero(steep) + 1, middles[steep]
        gaps = np.insert(gaps, where, added)
        pressures = np.insert(pressures, where, at(added))
    return Graph(written, gaps, pressures, Units(1.0, 1.0, 0.0))


def _check(gaps: np.ndarray, pressures: np.ndarray) -> None:
    """Raises InputError for pressures that are not finite, negative, rise with the gap, or begin with 0."""
    wrong = ~(np.isfinite(pressures) & (pressures >= 0))
    if wrong.any():
        first = int(np.argmax(wrong))
        raise InputError(f"is {pressures[first]:g} at gap {gaps[first]:g}: must be finite and not negative")
    apart = np.diff(gaps) > APART * (gaps[-1] - gaps[0])
    before, after = pressures[:-1], pressures[1:]
    rises = (after > before * (1 + 1e-12)) | (after >= before) & apart
    rises &= np.maximum(before, after) > NEGLIGIBLE
    if rises.any():
        first = int(np.argmax(rises))
        raise InputError(
            f"goes from {before[first]:.6g} at gap {gaps[first]:g} to {after[first]:.6g} at {gaps[first + 1]:g}: "
            "must decrease with the gap"
        )
    if not pressures[0] > 0:
        raise InputError(f"is 0 at gap {gaps[0]:g}, the smallest of gaps: must be > 0 there")


@dataclass(frozen=True, kw_only=True)
class FormulaWall(ContactLaw):
    """A user-defined wall: `pressure` is a formula that decreases with `gap`.  The gap is at least the first of `gaps`;
    beyond the second the pressure is 0.
    """

    kind: ClassVar[str] = "formula"
    methods: ClassVar[tuple[str, ...]] = ("newton", "gfmd")
    releases: ClassVar[bool] = False
    effort: ClassVar[float] = 3.4
    newton_effort: ClassVar[float] = 1.4  # 1.05 … 1.5 for exponentials, 1.2 … 1.5 for power laws and springs (256²)

    pressure: str = key(
        expressions.formula("gap"), about="p(gap), in the units of both", needed=True, example="0.1 * (0.5 / gap)**9"
    )
    gaps: tuple[float, float] = key(
        interval(), about="smallest and largest gap", unit="length", needed=True, example=[0.1, 10.0]
    )

    def check(self) -> None:
        """Raises InputError unless the formula decreases between the gaps."""
        try:
            _ = self.graph
        except InputError as error:
            raise wrong(self, "pressure", str(error)) from None

    @property
    def graph(self) -> Graph:
        """The formula as a table."""
        return tabulate(self.pressure, self.gaps)

    @property
    def ends(self) -> tuple[float, float]:
        """The first of `gaps`, and the second or where the formula becomes 0."""
        return self.graph.ends

    def softness(self, pressure: np.ndarray) -> float:
        return self.graph.softness(pressure)

    def gap(self, pressure: float, solid: Solid) -> float:
        return self.graph.gap(pressure)

    def pressure_at(self, gap: float, solid: Solid) -> float:
        return float(np.interp(gap, self.graph.gaps, self.graph.pressures))

    def in_units(self, units: Units) -> ContactLaw:
        return _InUnits(self.graph, units)


class _InUnits(ContactLaw):
    """The law of a graph between p̂ and ĝ; the methods are those of `ContactLaw`."""

    kind, releases = FormulaWall.kind, FormulaWall.releases

    def __init__(self, graph: Graph, units: Units) -> None:
        self.graph, self.units = graph.scaled(units), units
        self.away = abs(units.offset) / units.height  # of ĝ = 0 from gap 0: rounding errors scale with it

    def softness(self, pressure: np.ndarray) -> float:
        return self.graph.softness(pressure)

    def softer(self, factor: float) -> ContactLaw:
        return _InUnits(self.graph, self.units._replace(height=self.units.height / factor))

    def gap_and_slope(self, pressure: np.ndarray, gap: np.ndarray, slope: np.ndarray) -> None:
        """As `ContactLaw.gap_and_slope`; where p = 0, the smallest gap without pressure."""
        for rows, own, rate in self.graph.at_pressures(pressure):
            np.minimum(own, self.graph.ends[1], out=gap[rows])
            np.negative(rate, out=slope[rows])

    def respond(self, target: np.ndarray, pressure: np.ndarray, compliance: float, level: float) -> tuple[float, float]:
        """The point of the graph with compliance · p − gap = target + level."""
        total = slopes = 0.0
        line = compliance, 1.0
        for rows in _blocks(target):
            p, _, slope = self.graph.points(line, target[rows] + level)
            pressure[rows] = p
            part = response(line, p.ravel(), slope.ravel())
            total, slopes = total + part[0], slopes + part[1]
        return total, slopes

    def moments(self, pressure: np.ndarray, gap: np.ndarray, threshold: float) -> tuple[float, float, int, float]:
        """(Σ p (g − gap(p)), Σ p, number of points with p > threshold, Σ p × range)."""
        potential = softness = 0.0
        for rows, own, slope in self.graph.at_pressures(pressure):
            p = pressure[rows]
            potential += float(np.vdot(p, gap[rows] - own))
            softness += float(np.vdot(p, _ranges(p, slope)))
        return potential, float(pressure.sum()), int(np.count_nonzero(pressure > threshold)), softness

    def excess(
        self, pressure: np.ndarray, gap: np.ndarray, residual: np.ndarray, compliance: float, level: float
    ) -> float:
        """ε = g − level − gap(p⁺): an excess between two points of the graph.  Its bound includes rounding errors."""
        total, digits = 0.0, 8 * LAST
        for rows, own, slope in self.graph.at_pressures(pressure):
            p, away = pressure[rows], gap[rows] - level
            answer, there, _ = self.graph.points((compliance, 1.0), compliance * p - away)
            np.subtract(away, there, out=residual[rows])
            forces = np.abs(p - answer) + digits * np.maximum(p, answer)
            lengths = np.abs(there - own) + digits * (np.abs(own) + self.away + _ranges(p, slope))
            total += float(np.vdot(forces, lengths))
        return total

    def finish(self, pressure: np.ndarray, gap: np.ndarray, level: float, units: Units) -> float:
        """As `ContactLaw.finish`; the violation is taken over points with more than the mean pressure."""
        largest = 0.0
        gap -= level
        for rows, own, _ in self.graph.at_pressures(pressure):
            largest = max(largest, float(np.max(np.abs(gap[rows] - own), where=pressure[rows] >= 1, initial=0.0)))
        gap *= units.height
        gap += units.offset
        pressure *= units.pressure
        return largest


def _blocks(field: np.ndarray) -> Iterator[slice]:
    """Slices of rows of a field (nx, ny) with about `BLOCK` points each."""
    many = max(1, BLOCK // max(1, field.shape[1]))
    return (slice(row, row + many) for row in range(0, len(field), many))


def _ranges(pressure: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """The length over which the pressure changes with the gap, −p/(dp/dg); 0 where the graph is vertical."""
    return np.divide(pressure, -slope, out=np.zeros_like(pressure), where=slope < 0)
