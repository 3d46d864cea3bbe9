"""Quantities that can be imposed on a contact in place of the mean pressure; each is monotonic in the load."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property

import numpy as np

from pgfmd.errors import InputError, Unreachable
from pgfmd.grid.transforms import source
from pgfmd.physics.problem import ContactProblem, Imposed, quantile
from pgfmd.solvers.options import Load
from pgfmd.solvers.second_order import LEAST_ERROR
from pgfmd.solvers.solution import ContactSolution

EQUAL = 4 * np.finfo(float).eps  # over the largest height: points this close to the highest count as equally high
TINY = 1e-300  # least argument of a logarithm, and tolerance of a gap
CLOSING_AREA = 0.37  # in Persson's theory, of the load at which the gap of rough surfaces closes (.33 … .40)
ROUNDED = 1e-6  # least part of the elastic energy that is not that of a uniform pressure, in bounds
RESOLVED = 1e-9  # tolerance over the rms height down to which approaches are counted from the mean height


def stress_of_full_contact(problem: ContactProblem, height: float = 1.0) -> float:
    """Rms of Kh (Persson's s).  height: about that of the heights, so that no square overflows.  Collective."""
    grid, stiffness, parts = problem.grid, problem.solid.stiffness, dict[int, float]()
    stiffest = float(stiffness(np.array(math.hypot(*(math.pi / a for a in grid.spacing)))))

    def measure(block: np.ndarray, first: int, stop: int) -> None:
        stress = np.abs(block) / height * (stiffness(np.sqrt(grid.q_squared(first, stop))) / stiffest)
        parts[first] = float(np.sum(grid.hermitian_weight[first:stop] * stress**2))

    grid.read_spectrum(source(problem.heights), measure)
    total = grid.reduction.sum([parts[first] for first in sorted(parts)])
    return height * stiffest * math.sqrt(total / grid.modes / grid.size)


class Control:
    """A quantity that is imposed on one surface, and its value for a solution.  jumps: whether it is discontinuous in
    the load.  tolerance_key: the key of its tolerance.
    """

    jumps = False
    tolerance_key = "gap_tolerance"

    def __init__(self, problem: ContactProblem, load: Load):
        self.problem, self.options, self.grid = problem, load, problem.grid
        # With open boundaries the approach contains the compression of a slab: distant points are at rest.
        stiffness = problem.solid.mean_stiffness() if problem.grid.domain.wraps else 0.0
        self.mean_compliance = 1 / stiffness if stiffness > 0 else 0.0

    @cached_property
    def top(self) -> float:
        """Largest height, from any origin.  Collective."""
        return self.grid.reduction.max(self.problem.heights)

    @cached_property
    def lowest(self) -> float:
        """Smallest height, from any origin.  Collective."""
        return self.grid.reduction.min(self.problem.heights)

    @cached_property
    def summit(self) -> float:
        """Largest height, from the mean height.  Collective."""
        # Depths below the highest point keep their digits even where heights are far from 0.
        top = self.top  # collective: not in threads
        return self._mean(lambda heights: top - heights)

    @cached_property
    def rms_height(self) -> float:
        """Of the heights about their mean.  Collective."""
        top, summit = self.top, self.summit  # collective: not in threads
        size = top - self.lowest or 1.0  # squares of heights may underflow
        return size * math.sqrt(self._mean(lambda heights: ((top - heights - summit) / size) ** 2))

    def _mean(self, function: Callable[[np.ndarray], np.ndarray]) -> float:
        """Mean of a function of the heights, made of a band of rows at a time: whole, it would be the peak of memory.
        Threads call the function, so that it must make no collective call.  Collective.
        """
        heights = self.problem.heights

        def part(first: int, stop: int) -> float:
            return float(np.sum(function(heights[first:stop].astype(np.float64, copy=False))))

        parts = self.grid.threads.collect(part, len(heights), self.grid.band)
        return self.grid.reduction.sum(parts) / self.grid.size

    def imposed(self, target: float) -> Imposed | None:
        """What a solver meets by itself under a hard wall; None where it cannot.  Collective."""
        return None

    def check_target(self, target: float) -> None:
        """Raises InputError for a target that is wrong input.  Collective."""
        if self.rms_height == 0:
            name = self.options.control
            if not self.grid.domain.wraps and name != "contact_area":
                return
            raise InputError(f"load.{name}: the surface is flat: its contact is full at any load; impose a pressure")

    def check_reachable(self, target: float) -> None:
        """Raises Unreachable for a target that no load gives.  Collective."""

    def separation(self, target: float) -> float | None:
        """Distance of the solid from first contact at a target that needs no load; None if it needs one."""
        return None

    def guess(self, target: float) -> float:
        """An estimate of ln p̄ at the target.  Collective."""
        raise NotImplementedError

    def distance(self, found: ContactSolution, target: float) -> float:
        """Value minus target, in a coordinate that increases and is nearly linear in ln p̄.  Collective."""
        raise NotImplementedError

    def error(self, found: ContactSolution, target: float) -> float:
        """|Value − target| over the tolerance.  Collective."""
        raise NotImplementedError

    def asked(self, target: float) -> str:
        """The key and its value, for messages."""
        return f"load.{self.options.control} = {target:g}"

    @property
    def tolerance_text(self) -> str:
        """The key of the tolerance and its value, for messages."""
        return f"load.{self.tolerance_key} = {getattr(self.options, self.tolerance_key):g}"

    def uncertainty(self, found: ContactSolution, target: float) -> float:
        """Bound on the value's error implied by `certified_error`, over the tolerance; 0 if none is known."""
        return 0.0

    def displacement(self, found: ContactSolution) -> float:
        """Approach of the far side from where the undeformed solid touches the highest point."""
        return found.approach + found.mean_pressure * self.mean_compliance

    @cached_property
    def stress(self) -> float:
        """Rms of the stress of full contact, Kh (Persson's s).  Collective."""
        return stress_of_full_contact(self.problem, self.rms_height)


class Pressure(Control):
    """Mean pressure: the load itself."""

    def check_target(self, target: float) -> None:
        """Raises InputError for a pressure that the law does not carry."""
        self.problem.at(target).check()


class ContactArea(Control):
    """Relative contact area, to `area_tolerance` or one pixel."""

    jumps = True
    tolerance_key = "area_tolerance"

    def check_reachable(self, target: float) -> None:
        """Raises Unreachable below the area of first contact, that of the highest points.  Collective."""
        heights, pixel = self.problem.heights, 1 / self.grid.size
        level = self.top - EQUAL * max(abs(self.top), self.summit)
        least = self.grid.reduction.sum(np.count_nonzero(heights >= level)) * pixel
        if target < least * (1 - self.options.area_tolerance) and target < least - pixel:
            first = f"{least:g} touches first (shares of the cell)"
            raise Unreachable(f"load.contact_area = {target:g}: not reachable, {first}")

    def imposed(self, target: float) -> Imposed | None:
        return Imposed(self.options.area_tolerance, area=target) if self.problem.law.kind == "hard" else None

    def area(self, found: ContactSolution) -> float:
        """Relative contact area.  Collective."""
        return self.grid.reduction.sum(np.count_nonzero(found.pressure > 0)) / self.grid.size

    def guess(self, target: float) -> float:
        """Persson's theory: area = erf(p̄/√2 s).  Collective."""
        return math.log(self.stress * quantile(target, self.grid.size))

    def distance(self, found: ContactSolution, target: float) -> float:
        """ln of p̄(area)/p̄(target) by Persson's theory, nearly right up to a factor on the load.  Collective."""
        size = self.grid.size
        return math.log(quantile(self.area(found), size) / quantile(target, size))

    def error(self, found: ContactSolution, target: float) -> float:
        """|Area − target| over `area_tolerance` times the target, or over one pixel if that is more.  Collective."""
        return abs(self.area(found) - target) / max(self.options.area_tolerance * target, 1 / self.grid.size)


class Closure(ContactArea):
    """The load at which no path in the gap winds around the cell any more; where that is, `LoadControl` finds."""

    tolerance_key = "percolation_accuracy"

    def asked(self, target: float) -> str:
        return f'load.percolation = "{self.options.percolation}"'

    def check_target(self, target: float) -> None:
        """Raises InputError without a period, and on flat surfaces.  Collective."""
        self.options.check_domain(self.grid.domain)
        super().check_target(target)

    def check_reachable(self, target: float) -> None:
        """Not known before contacts are solved."""

    def imposed(self, target: float) -> Imposed | None:
        return None

    def guess(self, target: float) -> float:
        """ln of the load of the usual area.  Collective."""
        return super().guess(CLOSING_AREA)


class MeanGap(Control):
    """Mean gap, to `gap_tolerance`.  The search uses the approach since first contact, summit − mean gap, which grows
    with the load, from `begin` to `limit`.  Collective to make.
    """

    def __init__(self, problem: ContactProblem, load: Load):
        super().__init__(problem, load)
        least, most = problem.law.ends
        self.begin, self.limit = -most, self.summit - least
        self.closed = least if least > -math.inf else 0.0  # gap of the hard wall with which it is compared

    def approach(self, target: float) -> float:
        """Approach at a target."""
        return self.summit - target

    def reached(self, found: ContactSolution) -> float:
        """Approach of a solution, counted to the mean gap: what has yielded leaves no gap."""
        if not self.grid.domain.wraps:  # the surface moves by less than its far side
            return self.summit - found.mean_gap
        return found.approach - found.mean_plastic_depth

    def imposed(self, target: float) -> Imposed | None:
        """The approach, unless its tolerance is lost in rounding."""
        if not (self.grid.domain.wraps or isinstance(self, Displacement)):
            return None  # the surface moves by less than its far side
        allowed = self.options.gap_tolerance * self._size(target)
        if self.problem.law.kind != "hard" or allowed < RESOLVED * self.rms_height or self.rms_height == 0:
            return None
        return Imposed(allowed, self.approach(target))

    def check_target(self, target: float) -> None:
        """Raises InputError for full contact, which any load gives, and for gaps beyond the law's last.  Collective."""
        super().check_target(target)
        name, by_gap = self.options.control, self.options.control == "mean_gap"
        if self.approach(target) >= self.limit:
            limit = f"above {self.problem.law.ends[0]:g}" if by_gap else f"below {self.limit:g}"
            raise InputError(f"load.{name} = {target:g}: must be {limit}, where contact is full at any load")
        if not self.problem.law.releases and self.approach(target) <= self.begin:
            limit = f"below {self.summit - self.begin:g}" if by_gap else f"above {self.begin:g}"
            raise InputError(f"load.{name} = {target:g}: must be {limit}, where the wall ends and bears no load")

    def separation(self, target: float) -> float | None:
        """−approach where that ends before first contact, or None."""
        approach = self.approach(target)
        return -approach if self.problem.law.releases and approach <= 0 else None

    def guess(self, target: float) -> float:
        """ln of the sum of the law's pressure at the mean gap, and that of a hard wall at its smallest: the stress of
        full contact there, from where its logarithm decreases linearly with the gap.  Where the solid is compressed
        as a whole, the gap may be larger, and the law's pressure counts up to that stress.  Collective.
        """
        law, gap = self.problem.law, self.summit - self.approach(target)
        if self.rms_height == 0:  # a punch as wide as the domain
            pressed = self.problem.solid.surface_modulus * max(self.approach(target), 0.0) / max(self.grid.lengths)
            return math.log(max(pressed + law.pressure_at(gap, self.problem.solid), TINY))
        pressure = self.stress * math.exp(max(-20.0, min(3.0, 2 * (self.closed - gap) / self.rms_height)))
        bearing = law.pressure_at(gap, self.problem.solid)
        return math.log(pressure + (min(bearing, self.stress) if self.mean_compliance else bearing))

    def distance(self, found: ContactSolution, target: float) -> float:
        """In ln((approach − begin)/(limit − approach)), or in the approach itself if the law has no ends."""
        approach = self.approach(target)
        change = self.reached(found) - approach
        if math.isinf(self.begin):
            return change / (self.rms_height or self.problem.law.length_scale)
        left = self.limit - approach
        return _growth(approach - self.begin, change) - (_growth(left, -change) if left < math.inf else 0.0)

    def allowed(self, found: ContactSolution, target: float) -> float:
        """Tolerance of the approach at a solution near the target.

        It is relative to the approach since first contact with a hard wall at the law's smallest gap, or to the
        distance from an end if that is less.  Under a law with a range it is relative to that if it is more, but never
        to more than the rms height: a range grows without limit where the pressure hardly depends on the gap.  Under
        one that limits the pressure, a displacement is relative also to what is open and what has yielded: where both
        are 0, any load has it.
        """
        law, approach, size = self.problem.law, self.approach(target), self._size(target)
        if law.highest < math.inf and not self.mean_compliance:
            size = min(size, found.mean_gap + found.mean_plastic_depth)
        if law.reach > 0:
            size = min(max(size, law.range_at(found.mean_pressure)), self.rms_height or math.inf)
        size = max(size, abs(self.reached(found) - approach), TINY)  # far from the target, size may be 0
        return self.options.gap_tolerance * size

    def _size(self, target: float) -> float:
        """The approach since first contact, or the way to an end if that is less."""
        approach = self.approach(target)
        return min(abs(approach + self.closed), approach - self.begin, self.limit - approach)

    def error(self, found: ContactSolution, target: float) -> float:
        """|Approach − target| over its tolerance."""
        return abs(self.reached(found) - self.approach(target)) / self.allowed(found, target)

    def uncertainty(self, found: ContactSolution, target: float) -> float:
        """`bound` over the tolerance.  With open boundaries the bound grows: under a hard wall by the mean of the gaps
        that were set to 0; where a wall limits the pressure, by the mean displacement ⟨Gδ⟩ for an error δ of the
        pressure: ⟨Gδ⟩² ≤ ⟨1, G1⟩⟨δ, Gδ⟩/N² = 2B W/N.  Collective.
        """
        bound = self.bound(found)
        if self._moved and self.problem.law.kind == "hard":
            bound += abs(found.cut)
        elif self._moved and self.problem.law.highest < math.inf:
            above = 2 * found.elastic_energy * max(found.certified_error, LEAST_ERROR)
            bound += math.sqrt(2 * above * self._uniform)
        return bound / self.allowed(found, target)

    @property
    def _moved(self) -> bool:
        """Whether a change of the mean displacement changes the mean gap, at a given approach."""
        return not (self.grid.domain.wraps or isinstance(self, Displacement))

    @cached_property
    def _uniform(self) -> float:
        """Mean displacement W of an open patch under a uniform pressure 1: ⟨1, G1⟩/N.  Collective."""
        grid = self.grid
        places = np.arange(grid.torus[0] // 2 + 1), np.arange(grid.columns.start, grid.columns.stop)
        along, across = (
            (np.divide(np.sin(n * x), np.sin(x), out=np.full(x.shape, float(n)), where=k > 0)) ** 2
            for k, n, x in ((k, n, np.pi * k / m) for k, n, m in zip(places, grid.shape, grid.torus, strict=True))
        )
        weights = grid.hermitian_weight[:, 0] * across
        return float(grid.reduction.sum(weights @ (self.problem.solid.modes(grid) @ (grid.even_weight * along)))) / (
            grid.modes * grid.size
        )

    def bound(self, found: ContactSolution) -> float:
        """A bound of the errors of the mean gap and of the approach.  Collective.

        The least energy J*(P) is convex in the load P = Σ p, and its slope is the level λ* of contact.  A solution p
        with energy error B, and its multiples, bound J* from both sides: with a law of range ζ, A = ½⟨p, Gp⟩ + ζP/2,
        and 0 < s ≤ 1

            J*(P ± sP) ≤ J(p ± sp) ≤ J(p) ± sPλ + s² A + s³ ζP/2,    J*(P) ≥ J(p) − B,

        so that |λ* − λ| ≤ (s A + s² ζP/2 + B/s)/P, which is at most (2√(AB) + B)/P at s = √(B/A), or at 1 if that is
        less.  Where the range depends on the pressure, ζP is Σ p × range, as s is small.

        With open boundaries the mean gap is ⟨Gp⟩ − λ.  It is −K'(0)/P for the convex K(t) + ½t²P²W/N, K(t) the least
        J(p) − tP⟨1, Gp⟩/N with Σ p = P + tP, so that the same holds with A = ½⟨p − p̄, G(p − p̄)⟩ + ζP/2.

        Under a law that limits the pressure to σ_Y, p may not be multiplied: w = min(p, σ_Y − p) is added or taken away
        instead.  Then A = ½⟨w, Gw⟩, P is Σ w, and the terms ±s Σ w(g − λ), which vanish for w = p, are at most 2s√(AB):
        the bound is (4√(AB) + B)/Σ w.  The plastic depth d is that of λ p̄ − σ_Y⟨d⟩, the slope of J* as the load and
        σ_Y grow by one factor, to which p may be multiplied: its error is at most 2√(AB) + B per point, with A = ½⟨p,
        Gp⟩.  The mean gap, ⟨d⟩ − λ, then errs by (1 − p̄/σ_Y) times the error of λ, and that over σ_Y.
        """
        energy, change, law, grid = found.elastic_energy, found.mean_pressure, self.problem.law, self.grid
        above, highest = 2 * energy * max(found.certified_error, LEAST_ERROR), law.highest
        curvature = energy + grid.reduction.sum(law.softness(found.pressure)) / grid.size / 2
        if self._moved and highest == math.inf:
            mean = found.mean_pressure
            rest = energy + mean * (mean * self._uniform / 2 - (found.approach - self.reached(found)))
            curvature += max(rest, ROUNDED * energy) - energy  # of flat heights 0, but for rounding
        scaled, roots = 2 * math.sqrt(above * curvature) + above, 2
        if highest < math.inf:
            curvature, change = self._energy(np.minimum(found.pressure, highest - found.pressure))
            roots = 4
        if change == 0:  # every point is at a bound: the level may lie anywhere between their gaps
            return math.inf
        level = (roots * math.sqrt(above * curvature) + above) / change
        return max(level, (1 - found.mean_pressure / highest) * level + scaled / highest)

    def _energy(self, pressure: np.ndarray) -> tuple[float, float]:
        """½⟨p, Gp⟩ per point, without the mode q = 0, and the mean of a pressure (nx_local, ny).  Collective."""
        grid, parts = self.grid, dict[int, tuple[float, float]]()

        def measure(first: int, stop: int, rows: np.ndarray) -> None:
            block = pressure[first:stop]
            parts[first] = float(np.vdot(rows, block)) / 2, float(block.sum())

        grid.convolve(source(pressure), self.problem.solid.apply_compliance(grid, np.float64, 1 / grid.modes), measure)
        energy, total = grid.reduction.sums_of_blocks(parts, 2)
        return float(energy) / grid.size, float(total) / grid.size


class Displacement(MeanGap):
    """Approach of the solid's far side, to `gap_tolerance`: the approach of its surface plus its compression."""

    def __init__(self, problem: ContactProblem, load: Load):
        super().__init__(problem, load)
        if self.mean_compliance or problem.law.highest < math.inf or not self.grid.domain.wraps:
            self.limit = math.inf

    def approach(self, target: float) -> float:
        return target

    def imposed(self, target: float) -> Imposed | None:
        """The approach, and the compliance of the mean mode."""
        found = super().imposed(target)
        return found and replace(found, compliance=self.mean_compliance)

    def reached(self, found: ContactSolution) -> float:
        return self.displacement(found)

    def check_target(self, target: float) -> None:
        """Raises InputError also where all points bear the highest pressure.  Collective."""
        super().check_target(target)
        if (highest := self.problem.law.highest) < math.inf:
            limit = self.top - self.lowest + highest * self.mean_compliance
            if target >= limit and not self.grid.domain.wraps:  # on a periodic cell a uniform pressure bends nothing
                limit = self._open_limit(highest)
            if target >= limit:
                raise InputError(f"load.displacement = {target:g}: must be below {limit:g}, where all points yield")

    def _open_limit(self, pressure: float) -> float:
        """Displacement of an open patch at which the last point touches, if all bear this pressure.  Collective."""
        grid, heights, parts = self.grid, self.problem.heights, dict[int, float]()

        def fill(first: int, stop: int, rows: np.ndarray) -> None:
            rows[...] = pressure

        def measure(first: int, stop: int, rows: np.ndarray) -> None:
            parts[first] = float(np.max(rows - heights[first:stop]))

        grid.convolve(fill, self.problem.solid.apply_compliance(grid, np.float64, 1 / grid.modes), measure)
        return self.top + grid.reduction.max(np.array(list(parts.values())))


def _growth(length: float, change: float) -> float:
    """ln((length + change)/length), to all digits also of a small change; lengths below TINY count as that."""
    if abs(change) < abs(length) / 2:
        return math.log1p(change / length)
    return math.log(max(length + change, TINY)) - math.log(max(length, TINY))


CONTROLS: dict[str, type[Control]] = {
    "pressure": Pressure,
    "contact_area": ContactArea,
    "mean_gap": MeanGap,
    "displacement": Displacement,
    "percolation": Closure,
}
