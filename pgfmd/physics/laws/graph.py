"""The graph of a pressure that decreases with the gap, and loops that compute points on it.

Between two gaps it is the function; at the smaller gap it rises to any pressure (a hard wall), at the larger one it
falls to 0.  That is a maximal monotone graph: each line a p − b g = t with a, b ≥ 0, not both 0, meets it once.

The function is tabulated so densely that it falls by at most 2 % from one node to the next.  The table brackets a
point; the function itself, compiled, then finds it to the last digits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numba
import numpy as np

from pgfmd.errors import InputError

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
