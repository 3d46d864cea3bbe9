"""A user-defined wall: any pressure that decreases with the gap, as a formula.

The gap at a pressure is found on the graph (`graph`), and the excess of the certificate,
the integral of p − P(g) over g from the gap at p to g' (P: the formula), is bounded by |p − P(g')| |g' − gap(p)|, as P
decreases: at most twice the excess where P is linear between.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, partial
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from pgfmd.errors import InputError
from pgfmd.options import expressions as formula
from pgfmd.options.rules import interval
from pgfmd.options.section import key, wrong
from pgfmd.physics.laws.exponential_law import LAST
from pgfmd.physics.laws.graph import Graph, loops, tabulate
from pgfmd.physics.laws.law import ContactLaw, Units

if TYPE_CHECKING:
    from pgfmd.physics.solids.solid import Solid


@dataclass(frozen=True, kw_only=True)
class FormulaWall(ContactLaw):
    """A user-defined wall: `pressure` is a formula that decreases with `gap`.  The gap is at least the first of `gaps`;
    beyond the second the pressure is 0.
    """

    kind: ClassVar[str] = "formula"
    methods: ClassVar[tuple[str, ...]] = ("newton", "gfmd")
    releases: ClassVar[bool] = False
    effort: ClassVar[float] = 26.0
    newton_effort: ClassVar[float] = 4.0  # 2.5 … 7 at 128², ζ of .03 … .3 of the rms height

    pressure: str = key(
        formula.formula("gap"), about="p(gap), in the units of both", needed=True, example="0.1 * (0.5 / gap)**9"
    )
    gaps: tuple[float, float] = key(
        interval(), about="smallest and largest gap", unit="length", needed=True, example=[0.1, 10.0]
    )

    def check(self) -> None:
        """The formula decreases between the gaps."""
        try:
            _ = self.graph
        except InputError as error:
            raise wrong(self, "pressure", str(error)) from None

    @property
    def graph(self) -> Graph:
        """The formula as a table."""
        return _graph(self.pressure, self.gaps)

    @property
    def ends(self) -> tuple[float, float]:
        """The first of `gaps`, and the second or where the formula becomes 0."""
        return self.graph.ends

    @property
    def reach(self) -> float:
        """From the smallest gap to the largest."""
        return self.ends[1] - self.ends[0]

    def softness(self, pressure: np.ndarray) -> float:
        """From the table."""
        return sum(float(p @ self.graph.ranges(p)) for p in pressure)

    def gap(self, pressure: float, solid: Solid) -> float:
        """The gap at which the formula gives that pressure."""
        return self.graph.gap(pressure)

    def pressure_at(self, gap: float, solid: Solid) -> float:
        """From the table."""
        return float(np.interp(gap, self.graph.gaps, self.graph.pressures))

    def in_units(self, units: Units) -> ContactLaw:
        """The same between p̂ and ĝ."""
        return _InUnits(self.graph, units)


@cache
def _graph(pressure: str, gaps: tuple[float, float]) -> Graph:
    of = formula.function(pressure, "gap")
    return tabulate(partial(formula.value, of), *gaps, of)


class _InUnits(ContactLaw):
    """The law of a graph between p̂ and ĝ."""

    kind, releases = FormulaWall.kind, FormulaWall.releases

    def __init__(self, graph: Graph, units: Units) -> None:
        self.graph, self.units = graph, units
        self.away = abs(units.offset) / units.height  # of ĝ = 0 from the gap 0, from where rounding counts
        table = (graph.gaps - units.offset) / units.height, graph.pressures / units.pressure
        loop, scales = loops(graph.function), (units.height, units.pressure, units.offset)

        def meet(line: tuple[float, float], *rows: np.ndarray) -> tuple[float, float]:
            return loop(table, line, *rows, scales)

        self.meet = meet

    def softness(self, pressure: np.ndarray) -> float:
        """From the table."""
        return sum(float(p @ self._ranges(p)) for p in pressure)

    def _ranges(self, pressure: np.ndarray) -> np.ndarray:
        """−p/(dp/dgap) at each pressure."""
        return self.graph.ranges(pressure * self.units.pressure) / self.units.height

    def softer(self, factor: float) -> ContactLaw:
        """As `ContactLaw.softer`."""
        return _InUnits(self.graph, self.units._replace(height=self.units.height / factor))

    def gap_and_slope(self, pressure: np.ndarray, gap: np.ndarray, slope: np.ndarray) -> None:
        """The gap to the last digits, where p = 0 the least of them; the slope of the table, right to 2 %."""
        released = (self.graph.ends[1] - self.units.offset) / self.units.height
        for row, own in enumerate(self._gaps(pressure)):
            np.minimum(own, released, out=gap[row])
        ranges = self._ranges(pressure)
        slope[...] = np.where(pressure > 0, np.inf, 0.0)
        np.divide(pressure, ranges, out=slope, where=ranges > 0)

    def respond(self, target: np.ndarray, pressure: np.ndarray, compliance: float, level: float) -> tuple[float, float]:
        """The point of the graph with compliance · p − gap = target + level."""
        total = slope = 0.0
        gap = np.empty((1, target.shape[1]))
        for row in range(len(target)):
            p, rate = self.meet((compliance, 1.0), target[row : row + 1] + level, gap, pressure[row : row + 1])
            total, slope = total + p, slope + rate
        return total, slope

    def moments(self, pressure: np.ndarray, gap: np.ndarray, threshold: float) -> tuple[float, float, int]:
        """(Σ p (g − gap(p)), Σ p, number of points with p > threshold)."""
        potential = 0.0
        for p, g, own in zip(pressure, gap, self._gaps(pressure), strict=True):
            potential += float(p @ (g - own))
        return potential, float(pressure.sum()), int(np.count_nonzero(pressure > threshold))

    def excess(
        self, pressure: np.ndarray, gap: np.ndarray, residual: np.ndarray, compliance: float, level: float
    ) -> float:
        """ρ is the distance of g − level from the gap of p⁺, so that the excess lies between two points of the graph;
        what rounding may leave in both factors of its bound is added to them.
        """
        total, shape = 0.0, (1, pressure.shape[1])
        answer, there = np.empty(shape), np.empty(shape)
        for p, g, rest, own in zip(pressure, gap, residual, self._gaps(pressure), strict=True):
            away = g - level
            self.meet((compliance, 1.0), np.atleast_2d(compliance * p - away), there, answer)
            np.subtract(away, there[0], out=rest)
            digits = 8 * LAST
            forces = np.abs(p - answer[0]) + digits * np.maximum(p, answer[0])
            lengths = np.abs(there[0] - own) + digits * (np.abs(own) + self.away + self._ranges(p))
            total += float(forces @ lengths)
        return total

    def finish(self, pressure: np.ndarray, gap: np.ndarray, level: float, units: Units) -> float:
        """As `ContactLaw.finish`; the violation is taken over points with more than the mean pressure."""
        largest = 0.0
        for p, g, own in zip(pressure, gap, self._gaps(pressure), strict=True):
            g -= level
            largest = max(largest, float(np.max(np.abs(g - own), where=p >= 1, initial=0.0)))
            g *= units.height
            g += units.offset
        pressure *= units.pressure
        return largest

    def _gaps(self, pressure: np.ndarray) -> Iterator[np.ndarray]:
        """The gap of the graph at each pressure, row by row; the same array each time."""
        gap, ignored = np.empty((1, pressure.shape[1])), np.empty((1, pressure.shape[1]))
        for row in range(len(pressure)):
            self.meet((1.0, 0.0), pressure[row : row + 1], gap, ignored)
            yield gap[0]
