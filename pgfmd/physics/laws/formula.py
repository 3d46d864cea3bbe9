"""A user-defined wall: any pressure that decreases with the gap, as a formula.

Between two gaps the graph is the function; at the smaller gap it rises to any pressure (a hard wall), at the larger one
it falls to 0.  So it is maximal monotone: each line a p − b g = t with a, b ≥ 0, not both 0, meets it once.  Nodes with
pressures at most 2 % apart bracket a point; the compiled function finds it.  The excess of the certificate,
the integral of p − P(g) over g from the gap at p to g' (P: the formula), is bounded by |p − P(g')| |g' − gap(p)|, as P
decreases: at most twice the excess where P is linear between.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, cached_property, partial
from typing import TYPE_CHECKING, Any, ClassVar

import numba
import numpy as np

from pgfmd.errors import InputError
from pgfmd.options import expressions as formula
from pgfmd.options.rules import interval
from pgfmd.options.section import key, wrong
from pgfmd.physics.laws.exponential_law import LAST
from pgfmd.physics.laws.law import ContactLaw, Units

if TYPE_CHECKING:
    from pgfmd.physics.solids.solid import Solid

FALL = 1.02  # largest ratio of pressures at neighbouring nodes
NODES, ROUNDS = 256, 60  # equal intervals to begin with; halvings of one of them, which end at its last digits
NEGLIGIBLE = 1e-290  # pressures below it need not decrease: they underflow
APART = 1e-6  # of the range of gaps: nodes closer than this may differ by rounding only
CLOSE = 1e-5  # parts of the width between nodes: points closer than this give a slope no more digits
LAST_STEP = 1e-12  # parts of that width: after so short a step, the error is below the last digit
STEPS = 60  # to find a point; most take 5


@dataclass(frozen=True)
class Graph:
    """Nodes (m,): increasing gaps and their pressures; function: pressure from gap, for Python and for numba."""

    gaps: np.ndarray
    pressures: np.ndarray
    function: Callable[[float], float]

    @property
    def ends(self) -> tuple[float, float]:
        """The smallest gap, and the largest with a pressure, or the node after it."""
        bearing = int(np.count_nonzero(self.pressures > NEGLIGIBLE))
        return float(self.gaps[0]), float(self.gaps[min(bearing, len(self.gaps) - 1)])

    @cached_property
    def _between(self) -> np.ndarray:
        """−p/(dp/dg) between neighbouring nodes, from the last gap to the first; 0 before and after (m + 1,)."""
        falls = -np.diff(np.log(np.maximum(self.pressures, NEGLIGIBLE)))
        lengths = np.diff(self.gaps) / np.maximum(falls, np.finfo(float).eps)
        return np.concatenate(([0.0], lengths[::-1], [0.0]))

    def ranges(self, pressure: np.ndarray) -> np.ndarray:
        """The length over which the pressure changes with the gap, −p/(dp/dg), at pressures of any shape; 0 where the
        graph is vertical, at both of its ends.
        """
        return self._between[np.searchsorted(self.pressures[::-1], pressure, side="right")]

    def gap(self, pressure: float) -> float:
        """The gap at that pressure."""
        asked, point, borne = np.full((1, 1), pressure), np.empty((1, 1)), np.empty((1, 1))
        loops(self.function)((self.gaps, self.pressures), (1.0, 0.0), asked, point, borne, (1.0, 1.0, 0.0))
        return float(point[0, 0])


def tabulate(of: Callable[[float], float], low: float, high: float, function: Callable[[float], float]) -> Graph:
    """The graph of a function between two gaps; raises InputError where it is not finite, negative, or does not fall.

    of: the function, returning inf or NaN in place of errors.  function: the one to compile.
    """
    gaps = np.linspace(low, high, NODES + 1)
    pressures = np.array([of(float(gap)) for gap in gaps])
    for _ in range(ROUNDS):
        _check(gaps, pressures)
        middles = (gaps[1:] + gaps[:-1]) / 2
        steep = (pressures[:-1] > FALL * pressures[1:]) & (pressures[:-1] > NEGLIGIBLE)
        steep &= (gaps[:-1] < middles) & (middles < gaps[1:])
        if not steep.any():
            break
        where, added = np.flatnonzero(steep) + 1, middles[steep]
        gaps = np.insert(gaps, where, added)
        pressures = np.insert(pressures, where, [of(float(gap)) for gap in added])
    return Graph(gaps, pressures, function)


def _check(gaps: np.ndarray, pressures: np.ndarray) -> None:
    """Raises InputError for pressures that no wall has."""
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


@cache
def loops(function: Callable[[float], float]) -> Any:
    """The compiled loop `meet` for a function of the gap; kept in this process only, as the function is."""
    compiled: Any = numba.njit(nogil=True, error_model="numpy")(function)

    @numba.njit(nogil=True, error_model="numpy")
    def meet(table, line, target, gap, pressure, units):  # type: ignore[no-untyped-def]
        """The points of the graph with a p − b g = t for the targets t of rows (ny); line: (a, b).

        table: gaps and pressures, in the units of targets.  units: height, pressure and offset by which those of the
        function differ.  Fills `gap` and `pressure`; returns Σ p and Σ dp/dt.
        """
        (gaps, pressures), (a, b) = table, line
        height, unit, offset = units
        last = gaps.shape[0] - 1
        total = slopes = 0.0
        for i in range(target.shape[0]):
            for j in range(target.shape[1]):
                t = target[i, j]
                low, high = 0, last
                at_low, at_high = a * pressures[0] - b * gaps[0] - t, a * pressures[last] - b * gaps[last] - t
                if at_low <= 0:  # closed
                    g, p = gaps[0], (t + b * gaps[0]) / a
                    slope = 1 / a
                elif at_high >= 0:  # at the end of the range, or beyond
                    p = max((t + b * gaps[last]) / a, 0.0)
                    g = gaps[last] if p > 0 or b == 0 else -t / b
                    slope = 1 / a if p > 0 else 0.0
                else:
                    while high - low > 1:
                        middle = (low + high) // 2
                        value = a * pressures[middle] - b * gaps[middle] - t
                        if value > 0:
                            low, at_low = middle, value
                        else:
                            high, at_high = middle, value
                    x, y, at_x, at_y = gaps[low], gaps[high], at_low, at_high
                    left, right, width, rate = x, y, y - x, (at_y - at_x) / (y - x)
                    g = x - at_x / rate
                    p = pressures[low]
                    for _ in range(STEPS):  # secants, halves where they leave the bracket
                        if not left < g < right:
                            g = (left + right) / 2
                            if not left < g < right:
                                break
                        p = compiled(offset + height * g) / unit
                        at_g = a * p - b * g - t
                        if at_g > 0:
                            left = g
                        else:
                            right = g
                        x, at_x, y, at_y = y, at_y, g, at_g
                        if abs(y - x) > CLOSE * width and (at_y - at_x) * (y - x) < 0:
                            rate = (at_y - at_x) / (y - x)
                        step = at_g / rate
                        g -= step
                        if abs(step) <= LAST_STEP * width:
                            p += (rate + b) / a * -step
                            break
                    steep = -(rate + b) / a  # −dp/dg, infinite at a jump
                    slope = 1 / (a + b / steep)
                    if b > 0 and a * steep > b:
                        p = (t + b * g) / a  # with more digits there
                gap[i, j], pressure[i, j] = g, p
                total += p
                slopes += slope
        return total, slopes

    return meet


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
