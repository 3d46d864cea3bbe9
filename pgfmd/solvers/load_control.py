"""Which mean pressure to impose: given, or found from a contact area, a mean gap, or a displacement of the far side.

All of these are monotone in the load.  It is found by secants in coordinates in which the relation is nearly straight,
kept inside a bracket; solutions on the way are loose, and start from the one before where that is close enough to help.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.special import erfinv

from pgfmd.errors import InputError, SolverError
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.solution import ContactSolution

Solve = Callable[[float, np.ndarray | None, float], ContactSolution]
"""(mean pressure, pressure to start from or None, tolerance) → solution."""

NEAR = math.log(1.05)  # loads this close start from each other; over larger steps coarse grids are cheaper
LOOSE = 1e-3  # certified error on the way: it gives the contact area to about 1e-3, the mean gap to 1e-3 rms heights
TIGHT = 1e-8  # certified error where a gap is to be found to GAP_TOLERANCE
GAP_TOLERANCE = 1e-5  # of mean gap or displacement, over the rms height
JUMP = 1e-6  # relative width of a bracket of loads across which the measure jumps
MOST_SOLVES = 80
CONTROLS = ("pressure", "contact_area", "mean_gap", "displacement")


class Loads:
    """Solutions of one surface, each at a load given in terms of `control`, in any order.  Collective to make.

    contact_area: relative, to `area_tolerance` (relative) or one pixel; where the area jumps across the target, the
    load of the jump, on the nearer side.  mean_gap: ⟨u − h⟩.  displacement: approach of the solid's far side
    (half-space, or slab under a constant stress: of its mean plane) from where the undeformed solid touches the summit.
    """

    def __init__(
        self,
        control: str,
        solve: Solve,
        problem: ContactProblem,
        tolerance: float = 1e-6,
        area_tolerance: float = 0.005,
    ):
        if control not in CONTROLS:
            raise InputError(f"load control {control!r}: must be one of {', '.join(CONTROLS)}")
        if control == "contact_area" and not problem.law.releases:
            raise InputError(f"load.contact_area: a wall of kind {problem.law.kind} touches everywhere")
        self.control, self._solve, self.grid, self.law = control, solve, problem.grid, problem.law
        self.tolerance, self.area_tolerance = tolerance, area_tolerance
        self.previous: ContactSolution | None = None
        self._resumed: np.ndarray | None = None
        if control == "pressure":
            return
        grid, heights, reduce = problem.grid, problem.heights, problem.grid.reduction
        mean = reduce.sum(heights) / grid.size
        self.summit = reduce.max(heights) - mean
        self.height = math.sqrt(reduce.sum((heights - mean) ** 2) / grid.size)
        if self.height == 0:
            raise InputError(f"load.{control}: the surface is flat: its contact is full at any load; impose a pressure")
        self.stress = _full_contact_stress(problem)
        mean_stiffness = problem.solid.mean_stiffness()
        self.mean_compliance = 1 / mean_stiffness if mean_stiffness > 0 else 0.0

    def resume(self, pressure: np.ndarray | None) -> None:
        """Begin the next target from that pressure (nx_local, ny), of an unfinished solution."""
        self._resumed = pressure

    def solution(self, target: float) -> ContactSolution:
        """The contact at that target.  Collective.  Raises InputError for one that no load gives, and SolverError."""
        if self.control == "pressure":
            return self.at(target, self.tolerance)
        if self.control == "contact_area":
            wanted, highest = float(erfinv(target)), 1 - 0.5 / self.grid.size
            allowed = max(self.area_tolerance * target, 1 / self.grid.size)
            return self._search(
                lambda found: float(erfinv(min(self.area(found), highest))),
                lambda found, _: abs(self.area(found) - target) <= allowed,
                wanted,
                math.log(math.sqrt(2) * self.stress * wanted),  # Persson's theory
                (min(LOOSE, self.area_tolerance / 5), self.tolerance),
            )
        if self._out_of_touch(target):
            return self.at(0.0, self.tolerance)
        measure = self.approach if self.control == "displacement" else lambda found: -found.mean_gap
        wanted = target if self.control == "displacement" else -target
        close = self.summit - wanted if self.control == "displacement" else target
        return self._search(
            measure,
            lambda found, error: abs(measure(found) - wanted) <= max(GAP_TOLERANCE, error) * self.height,
            wanted,
            math.log(self.stress) - min(max(2 * close / self.height, -20), 20),
            (LOOSE, min(self.tolerance, TIGHT)),
        )

    def at(self, mean_pressure: float, tolerance: float) -> ContactSolution:
        """The contact at that mean pressure, from the previous solution where that is near.  Collective."""
        before, start = self.previous, self._resumed
        self._resumed = None
        if start is None and before is not None and before.mean_pressure > 0 and mean_pressure > 0:
            if abs(math.log(mean_pressure / before.mean_pressure)) <= NEAR:
                start = before.pressure
        self.previous = self._solve(mean_pressure, start, tolerance)
        return self.previous

    def area(self, found: ContactSolution) -> float:
        """Relative contact area.  Collective."""
        return self.grid.reduction.sum(np.count_nonzero(found.pressure > 0)) / self.grid.size

    def approach(self, found: ContactSolution) -> float:
        """Displacement of the far side from where the undeformed solid touches the summit."""
        return self.summit - found.mean_gap + found.mean_pressure * self.mean_compliance

    def _out_of_touch(self, target: float) -> bool:
        """Whether a hard wall carries nothing there; raises InputError beyond full contact."""
        if not self.law.releases:
            return False
        if self.control == "mean_gap":
            low, high, apart = 0.0, math.inf, target >= self.summit
        else:
            low, high = -math.inf, math.inf if self.mean_compliance else self.summit
            apart = target <= 0
        if not low < target < high:
            limit = f"above {low:g}" if self.control == "mean_gap" else f"below {high:g}"
            raise InputError(f"load.{self.control} = {target:g}: must be {limit}, where contact is full at any load")
        return apart

    def _search(self, measure, within, wanted: float, guess: float, tolerances: tuple[float, ...]) -> ContactSolution:
        """Solve until `within(solution, tolerance)`, with measure(solution) increasing in the load.  Collective.

        wanted: the measure's value; guess: of ln p̄.  One stage for each tolerance; returns the last one's solution.
        """
        at, best = guess, None
        if self._resumed is not None:
            at = math.log(self.grid.reduction.sum(self._resumed) / self.grid.size)
        for tolerance in tolerances:
            low, high, points = None, None, []
            for _ in range(MOST_SOLVES):
                found = self.at(math.exp(at), tolerance)
                value = measure(found)
                if within(found, tolerance):
                    break
                points.append((at, value))
                if value < wanted:
                    low = (at, value, found) if low is None or at > low[0] else low
                else:
                    high = (at, value, found) if high is None or at < high[0] else high
                if low and high and high[0] - low[0] <= JUMP:
                    found = min(low, high, key=lambda side: abs(side[1] - wanted))[2]
                    break
                at = _next(points, low, high, wanted)
            else:
                last = math.exp(at)
                raise SolverError(f"load.{self.control}: not found in {MOST_SOLVES} solutions, the last at {last:g}")
            best, at = found, math.log(found.mean_pressure)
        return best


def _next(points, low, high, wanted: float) -> float:
    """The next logarithm of the load: a secant through the two last points, inside the bracket and not too far."""
    at, value = points[-1]
    slope = 1.0
    if len(points) > 1 and points[-2][0] != at:
        slope = (value - points[-2][1]) / (at - points[-2][0])
    elif value != 0 and value * wanted > 0:
        return at + max(-3.0, min(3.0, math.log(wanted / value)))  # proportional to the load, nearly
    trial = at + (wanted - value) / slope if slope > 0 else math.nan
    if low and high:
        # Every fourth step, later every second one, halves the bracket, so that a bent relation cannot creep.
        inside = low[0] < trial < high[0] and len(points) % (4 if len(points) < 10 else 2)
        return trial if inside else (low[0] + high[0]) / 2
    step = trial - at if math.isfinite(trial) else math.copysign(3.0, wanted - value)
    if step * (wanted - value) <= 0:
        step = math.copysign(3.0, wanted - value)
    return at + max(-3.0, min(3.0, step))


def _full_contact_stress(problem: ContactProblem) -> float:
    """Rms of the stress of full contact, Kh (Persson's s).  Collective."""
    grid, heights, parts = problem.grid, problem.heights, []

    def fill(first: int, stop: int, rows: np.ndarray):
        rows[...] = heights[first:stop]

    def action(block: np.ndarray, first: int, stop: int):
        stress = np.abs(block) * problem.solid.stiffness(np.hypot(grid.qx, grid.qy[first:stop]))
        parts.append((first, float(np.sum(grid.hermitian_weight[first:stop] * stress**2))))

    grid.read_spectrum(fill, action)
    return math.sqrt(grid.reduction.sum([part for _, part in sorted(parts)])) / grid.size
