"""What can be imposed on a contact in place of the mean pressure, each as a quantity that grows with the load."""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np
from scipy.special import erfinv

from pgfmd.errors import InputError, Unreachable
from pgfmd.grid.callbacks import source
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.options import Load
from pgfmd.solvers.solution import ContactSolution

EQUAL = 4 * np.finfo(float).eps  # of the largest height: points that differ by less from the highest are as high
TINY = 1e-300  # so that logarithms of nothing are finite
FINEST = 1e-24  # certified error below which levels are known to rounding, a few 1e-12, and no better


class Control:
    """A quantity that is imposed, and its value for solutions of one surface.  Collective to make.

    summit, height: highest point over the mean, and rms height.  jumps: whether it is not continuous in the load.
    """

    jumps = False

    def __init__(self, problem: ContactProblem, load: Load):
        self.problem, self.options, self.grid = problem, load, problem.grid
        heights, reduce = problem.heights, problem.grid.reduction
        mean = reduce.sum(heights) / self.grid.size
        self.top = reduce.max(heights)
        self.summit, self.height = self.top - mean, math.sqrt(reduce.sum((heights - mean) ** 2) / self.grid.size)
        stiffness = problem.solid.mean_stiffness()
        self.mean_compliance = 1 / stiffness if stiffness > 0 else 0.0

    def refuse(self, target: float) -> None:
        """Raises InputError for a target that is wrong input."""
        if self.height == 0:
            name = self.options.control
            raise InputError(f"load.{name}: the surface is flat: its contact is full at any load; impose a pressure")

    def check_reachable(self, target: float) -> None:
        """Raises Unreachable for a target that no load gives.  Collective."""

    def lets_go(self, target: float) -> bool:
        """Whether the target is met without a load."""
        return False

    def guess(self, target: float) -> float:
        """ln p̄ to begin with.  Collective."""
        raise NotImplementedError

    def distance(self, found: ContactSolution, target: float) -> float:
        """How far the load is above what the target wants, in coordinates in which that is nearly straight over ln p̄.
        Collective.
        """
        raise NotImplementedError

    def error(self, found: ContactSolution, target: float) -> float:
        """By how much the target is missed, over what is allowed.  Collective."""
        raise NotImplementedError

    @property
    def key(self) -> str:
        """The tolerance as the job says it."""
        return f"load.gap_tolerance = {self.options.gap_tolerance:g}"

    def uncertainty(self, found: ContactSolution, target: float) -> float:
        """By how much, in the same measure, the solution's own error may move it."""
        return 0.0

    def displacement(self, found: ContactSolution) -> float:
        """Approach of the far side from where the undeformed solid touches the highest point."""
        return found.approach + found.mean_pressure * self.mean_compliance

    @cached_property
    def stress(self) -> float:
        """Rms of the stress of full contact, Kh (Persson's s).  Collective."""
        grid, stiffness, parts = self.grid, self.problem.solid.stiffness, dict[int, float]()

        def measure(block: np.ndarray, first: int, stop: int) -> None:
            stress = np.abs(block) * stiffness(np.sqrt(grid.q_squared(first, stop)))
            parts[first] = float(np.sum(grid.hermitian_weight[first:stop] * stress**2))

        grid.read_spectrum(source(self.problem.heights), measure)
        return math.sqrt(grid.reduction.sum([parts[first] for first in sorted(parts)])) / grid.size


class Pressure(Control):
    """Mean pressure: the load itself."""

    def refuse(self, target: float) -> None:
        """Raises InputError for a pressure that the law does not carry."""
        self.problem.at(target).check()


class ContactArea(Control):
    """Relative contact area, to `area_tolerance` or one pixel."""

    jumps = True

    def check_reachable(self, target: float) -> None:
        """First contact, at no load, has the area of all points that are as high as the highest."""
        heights, pixel = self.problem.heights, 1 / self.grid.size
        level = self.top - EQUAL * max(abs(self.top), self.summit)
        least = self.grid.reduction.sum(np.count_nonzero(heights >= level)) * pixel
        if target < least * (1 - self.options.area_tolerance) and target < least - pixel:
            raise Unreachable(f"load.contact_area = {target:g}: not reachable, {least:g} touches first")

    @property
    def key(self) -> str:
        """The tolerance as the job says it."""
        return f"load.area_tolerance = {self.options.area_tolerance:g}"

    def area(self, found: ContactSolution) -> float:
        """Relative contact area.  Collective."""
        return self.grid.reduction.sum(np.count_nonzero(found.pressure > 0)) / self.grid.size

    def guess(self, target: float) -> float:
        """Persson's theory: area = erf(p̄/√2 s)."""
        return math.log(math.sqrt(2) * self.stress * erfinv(target))

    def distance(self, found: ContactSolution, target: float) -> float:
        """The same, for Persson's theory is nearly right up to a factor on the load."""
        area = min(max(self.area(found), 0.5 / self.grid.size), 1 - 0.5 / self.grid.size)
        return math.log(erfinv(area) / erfinv(target))

    def error(self, found: ContactSolution, target: float) -> float:
        """Over a share of the target, or a pixel."""
        return abs(self.area(found) - target) / max(self.options.area_tolerance * target, 1 / self.grid.size)


class MeanGap(Control):
    """Mean gap, to `gap_tolerance`; what grows with the load is the approach from first contact, summit − mean gap."""

    def __init__(self, problem: ContactProblem, load: Load):
        super().__init__(problem, load)
        overlap = not problem.law.releases or problem.law.highest < math.inf
        self.limit = math.inf if overlap else self.summit  # of the approach

    def approach(self, target: float) -> float:
        """That of a target."""
        return self.summit - target

    def reached(self, found: ContactSolution) -> float:
        """That of a solution."""
        return found.approach

    def refuse(self, target: float) -> None:
        """At full contact the load is not determined any more, unless the law lets the surfaces overlap."""
        super().refuse(target)
        if self.approach(target) >= self.limit:
            name = self.options.control
            limit = "above 0" if name == "mean_gap" else f"below {self.limit:g}"
            raise InputError(f"load.{name} = {target:g}: must be {limit}, where contact is full at any load")

    def lets_go(self, target: float) -> bool:
        """Before first contact."""
        return self.problem.law.releases and self.approach(target) <= 0

    def guess(self, target: float) -> float:
        """The stress of full contact where the mean height is reached, exponentially less before, and more beyond."""
        beyond = (self.approach(target) - self.summit) / self.height
        return math.log(self.stress) + max(-20.0, min(3.0, 2 * beyond))

    def distance(self, found: ContactSolution, target: float) -> float:
        """In the logarithm of the approach, and near full contact of what is left of it."""
        return self._coordinate(self.reached(found)) - self._coordinate(self.approach(target))

    def _coordinate(self, approach: float) -> float:
        if not self.problem.law.releases:
            return approach / self.height
        left = self.limit - approach
        return math.log(max(approach, TINY)) - (math.log(max(left, TINY)) if left < math.inf else 0.0)

    def allowed(self, target: float) -> float:
        """By how much the approach may miss its target."""
        approach = self.approach(target)
        short = min(abs(approach), self.limit - approach)
        return self.options.gap_tolerance * max(short, self.problem.law.range)

    def error(self, found: ContactSolution, target: float) -> float:
        """Over what is allowed."""
        return abs(self.reached(found) - self.approach(target)) / self.allowed(target)

    def uncertainty(self, found: ContactSolution, target: float) -> float:
        """A bound of the mean gap's own error, over what is allowed.

        The least energy J*(P) is convex in the load P, and its slope is the level λ* of contact.  A solution p of
        energy error B bounds it on both sides by its multiples: with E = ½⟨p, Gp⟩ and a law of range ζ

            J*(P ± sP) ≤ J(p ± sp) = J(p) ± sPλ + s² (E + ζP/2),    J*(P) ≥ J(p) − B,

        so that |λ* − λ| ≤ min over s of (s (E + ζP/2) + B/s)/P.
        """
        energy, pressure = found.elastic_energy, found.mean_pressure
        bound = 2 * energy * max(found.certified_error, FINEST)
        return (2 * math.sqrt(bound * (energy + self.problem.law.range * pressure / 2)) + bound) / (
            pressure * self.allowed(target)
        )


class Displacement(MeanGap):
    """Approach of the solid's far side, to `gap_tolerance`: that of its surface and its own compression."""

    def __init__(self, problem: ContactProblem, load: Load):
        super().__init__(problem, load)
        if self.mean_compliance:
            self.limit = math.inf

    def approach(self, target: float) -> float:
        """The target itself."""
        return target

    def reached(self, found: ContactSolution) -> float:
        """That of the far side."""
        return self.displacement(found)


CONTROLS: dict[str, type[Control]] = {
    "pressure": Pressure,
    "contact_area": ContactArea,
    "mean_gap": MeanGap,
    "displacement": Displacement,
}
