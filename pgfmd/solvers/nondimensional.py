"""Dimensionless contact problems, so that solvers never overflow, and their solutions in physical units."""

from __future__ import annotations

import math
import time
from typing import NamedTuple

import numpy as np

from pgfmd.errors import InputError, Uncertifiable
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.physics.laws.law import ContactLaw, Units
from pgfmd.physics.problem import ContactProblem
from pgfmd.physics.solids.solid import Solid
from pgfmd.solvers.options import MODERATE
from pgfmd.solvers.second_order import last_digits
from pgfmd.solvers.solution import Certificate, ContactSolution, SolverState

LARGEST = 1e120  # of heights over the grid spacing, of pressures over the contact modulus; the inverse is the smallest
STIFFEST = 1e25  # of a solid over a half-space, so that single precision (to 3e38) holds it times the other factors
UNIFORM = 1e15  # range of a law over the rms height above which a pressure in double precision is uniform
SHORTEST = 8e-9  # least reach of a law over the rms height: ζ is then 1e5 units of the last digit of a gap
SUMS = 1e-12  # relative error of the sums in a certified error
BEYOND = 1.01  # safety factor on the depth that can touch
FAR = 16.0  # largest height over the range of heights that single precision holds: to 1e-6 of the range
WIDEST = 1e30  # largest range of heights and mean pressure in single precision; the inverse is the smallest
# Heights in double precision stay as they are if |mean|/rms is at most this, those in single if it is at most half
# the spacing of single-precision numbers at 1; and if rms and 1/rms are at most `MODERATE`.
CENTRED = 1e-13


class Dimensionless:
    """A contact problem with heights about their mean and over their rms value, pressures over their mean.  Collective
    to make.  If the law has no length of its own, heights of mean 0 and moderate size stay as they are.

    uniform: the solution if no solver is needed (no load or no roughness), else None.  problem: the dimensionless
    problem, and rms: the rms value of its heights, set only if `uniform` is None.  For convex laws that only repel:
    the mean pressure is positive, and a point far below the highest bears none.  Wave numbers, and so lengths in the
    plane, keep their unit.

    Under a light load, points far below the highest one cannot touch, and how far below does not matter.  They are
    raised to just below the depth that can touch: heights are then of the size of the indentation, and lose no digits.
    """

    def __init__(self, physical: ContactProblem, overwrite_heights: bool = False):
        """overwrite_heights: their memory is used, and they are lost.  Raises InputError for what cannot be solved,
        Uncertifiable where no pressure in double precision is accurate enough."""
        physical.check()
        mean, single = physical.mean_pressure, physical.grid.storage is np.float32
        if single and mean and not 1 / WIDEST < mean < WIDEST:
            raise InputError(f'mean pressure = {mean:g}: too far from 1 for solver.storage = "float32"; take "float64"')
        assert physical.law.convex and physical.law.lowest == 0
        self.physical, self._began = physical, time.perf_counter()
        grid, solid, law = physical.grid, physical.solid, physical.law
        self._transforms = grid.transforms
        self._heights = made = dimensionless_heights(physical, overwrite_heights)
        self.uniform: ContactSolution | None = None
        if mean == 0 or made.rms == 0:
            self.uniform = self._uniform(made.field)
            return
        if (distance := law.range_at(mean)) >= UNIFORM * made.rms:
            raise Uncertifiable(
                f"the wall's range, −p/(dp/dgap) at the mean pressure or zeta = {distance:g}: the rms height is only "
                f"{made.rms:g}, so that the pressure differs by no more than its last digits: no elastic energy can be "
                "certified"
            )
        if 0 < law.reach < SHORTEST * made.unit:
            raise InputError(
                f"the wall's reach (800 zeta, or the distance of its gaps) is {law.reach:g}: must be at least "
                f"{SHORTEST:g} of the rms height of what can touch, here {made.unit:g}; shorter walls are hard: "
                'wall.kind = "hard"'
            )
        self.units = Units(made.unit, mean, law.gap(mean, solid), law.highest)
        self.problem = ContactProblem(
            grid, made.field, solid.in_units(made.unit, mean), law.in_units(self.units), 1.0,
            physical.imposed and physical.imposed.in_units(made.unit, mean, made.top),
        )  # fmt: skip
        if not type(law).__module__.startswith("pgfmd."):
            verify(law, self.problem.law, self.units, solid)
        self.rms = 1.0 if made.depth < math.inf else made.rms / made.unit
        if elastic_energy_is_lost(self.problem, self.rms):
            raise Uncertifiable(f"mean pressure = {mean:g}: the elastic energy is lost in the pressure's last digits")

    def _uniform(self, heights: np.ndarray) -> ContactSolution:
        """A uniform pressure; without a load the highest point touches.  heights: overwritten.  Collective."""
        mean, law = float(self.physical.mean_pressure), self.physical.law
        summit = self._heights.top * self._heights.unit
        mean_gap = law.gap(mean, self.physical.solid) if mean > 0 else summit
        heights *= self._heights.unit
        gap = np.subtract(mean_gap, heights, out=heights)
        return ContactSolution(
            pressure=np.full(gap.shape, mean, gap.dtype),
            gap=gap,
            mean_pressure=mean,
            mean_gap=mean_gap,
            elastic_energy=0.0,
            certificate=Certificate(0.0),
            seconds=time.perf_counter() - self._began,
            approach=summit - mean_gap,
            pressure_error=0.0,
        )

    def solution(
        self, state: SolverState, energy: float, tolerance: float, coarse_transforms: float = 0.0
    ) -> ContactSolution:
        """The physical solution of a dimensionless state, whose fields are changed and become its own.  Collective.

        energy: ½⟨p̂ û⟩ per point.  Raises Uncertifiable if the rounding of the pressure's last digits, which the
        certificate does not contain, brings the error above the tolerance.
        """
        pressure, gap, units, grid = state.pressure, state.gap, self.units, self.physical.grid
        law, level = self.problem.law, state.base + state.level

        def finish(first: int, stop: int) -> float:
            return law.finish(pressure[first:stop], gap[first:stop], state.level, units)

        mean, square = self.problem.mean_pressure, grid.reduction.dot(pressure, pressure) / grid.size
        if self.problem.imposed is not None:
            mean = grid.reduction.sum(pressure) / grid.size
            self.physical = self.physical.imposing(None, mean * units.pressure)
        softness = grid.reduction.sum(law.softness(pressure)) / grid.size
        # Errors add in their norm, √(2 × energy).
        digits = math.sqrt(last_digits(self.problem, square, softness) / (2 * energy))
        error = (1 + SUMS) * (math.sqrt(max(state.error, 0.0)) + digits) ** 2
        if not error <= tolerance:
            raise Uncertifiable(
                f"the certified error stays at {error:.1e}, above the tolerance {tolerance:.1e}: so small an elastic "
                "energy is lost in the last digits of the pressure; allow a larger tolerance"
            )
        raw = 0.0 if grid.domain.wraps else grid.reduction.sum(gap) / grid.size - state.level
        violation = grid.reduction.max(grid.threads.collect(finish, len(gap)))
        cut = 0.0 if grid.domain.wraps else grid.reduction.sum(gap) / grid.size - raw * units.height
        lowered, work = self._lower(pressure, gap) if self._heights.depth < math.inf else (0.0, 0.0)
        lost = work / (2 * energy * units.pressure * units.height) if work else 0.0
        depth, sunk = np.zeros(gap.shape), 0.0  # pages that are not written take no memory
        if law.highest < math.inf:
            depth = np.maximum(-gap, 0.0)
            np.maximum(gap, 0.0, out=gap)
            sunk = grid.reduction.sum(depth) / grid.size
        if grid.domain.wraps:  # the mean of Gp is 0
            mean_gap = units.offset - level * units.height + lowered + sunk
            if self.physical.law.reach == 0:  # within the error, full contact may come out below 0
                mean_gap = max(mean_gap, 0.0)
        else:
            mean_gap = grid.reduction.sum(gap) / grid.size
        return ContactSolution(
            pressure=pressure,
            gap=gap,
            mean_pressure=self.physical.mean_pressure,
            mean_gap=mean_gap,
            elastic_energy=energy * units.pressure * units.height,
            certificate=Certificate(error + (1 + SUMS) * lost),
            max_violation=violation * (units.height / self._heights.rms),
            iterations=state.iterations,
            transforms=grid.transforms - self._transforms + coarse_transforms,
            seconds=time.perf_counter() - self._began,
            threshold=self.physical.law.contact_above(mean, square) * units.pressure,
            approach=(level + self._heights.top) * units.height - units.offset,
            pressure_error=state.pressure_error,
            plastic_depth=depth,
            mean_plastic_depth=sunk,
            cut=cut,
        )

    def _lower(self, pressure: np.ndarray, gap: np.ndarray) -> tuple[float, float]:
        """Lowers raised points again; returns the growth of the mean gap, the pressure's work on them.  Collective."""
        grid, heights, made = self.physical.grid, self.physical.heights, self._heights

        def lower(first: int, stop: int) -> tuple[float, float]:
            rows = slice(first, stop)
            own = heights[rows].astype(np.float64, copy=False)
            below = np.maximum(made.high - own - made.depth, 0.0)
            gap[rows] += below
            return float(below.sum()), float(np.vdot(pressure[rows], below))

        parts = grid.threads.collect(lower, len(gap), grid.band)
        lowered, work = (grid.reduction.sum(part) / grid.size for part in zip(*parts, strict=True))
        return lowered, work


def verify(law: ContactLaw, scaled: ContactLaw, units: Units, solid: Solid) -> None:
    """Raises InputError if a user's law in units does not answer as its own `gap` says, or certifies too little."""

    def gaps(pressures: np.ndarray) -> np.ndarray:
        physical = [law.gap(float(p) * units.pressure, solid) for p in pressures.flat]
        return (np.array(physical).reshape(pressures.shape) - units.offset) / units.height

    answers = np.array([[0.5, 1.0, min(2.0, 0.5 + 0.5 * units.highest / units.pressure)]])
    pressures, found = np.ascontiguousarray(answers[:, ::-1]), np.empty_like(answers)
    residual, nodes = np.empty(answers.shape, np.float32), np.polynomial.legendre.leggauss(20)
    with np.errstate(all="ignore"):
        scaled.respond(answers - gaps(answers), found, 1.0, 0.0)
        excess = scaled.excess(pressures, pressures - answers + gaps(answers), residual, 1.0, 0.0)
        between = answers + (pressures - answers) * (nodes[0][:, None] + 1) / 2
        least = float(np.sum((gaps(answers) - gaps(between)) * (pressures - answers) * nodes[1][:, None] / 2))
    wrong = ""
    if law.releases and law.reach > 0:
        wrong = "releases: True is for laws of reach 0, of which contacts have an edge"
    elif not np.allclose(found, answers, rtol=1e-6):
        wrong = "respond: the pressures are not those at which compliance * p - gap(p) is the target"
    elif not np.allclose(residual, pressures - answers, atol=1e-5):
        wrong = "excess: the residual is not compliance * (p - p+)"
    elif not excess >= 0.8 * least - 1e-6:  # nodes may miss where gaps jump
        wrong = f"excess: {excess:.6g} is less than what gaps make it, {least:.6g}"
    if wrong:
        raise InputError(f'wall.kind = "{law.kind}": {wrong} (in the units of in_units)')


def in_storage(grid: SlabGrid, heights: np.ndarray) -> np.ndarray:
    """Heights (nx_local, ny) in the precision in which the grid's fields are stored, in the same array if they have it.
    Raises InputError for heights that single precision would not hold to 1e-6 of their range.  Collective.
    """
    if grid.storage is np.float64:
        return heights
    high, low = grid.reduction.max(heights), grid.reduction.min(heights)
    largest, height, reason = max(abs(high), abs(low)), high - low, ""
    if height and largest > FAR * height:
        reason = f"the largest is {largest / height:.0f} times their range; subtract the mean"
    if height and not 1 / WIDEST < height < WIDEST:
        reason = f"their range is {height:.1e}, and must lie between {1 / WIDEST:g} and {WIDEST:g}; take another unit"
    if not largest < WIDEST:
        reason = f"the largest is {largest:.1e}, and must be below {WIDEST:g}; take another unit"
    if reason:
        raise InputError(f'solver.storage = "float32": not with these heights: {reason}, or take "float64"')
    grid.make_room()  # of transforms in double precision
    return heights.astype(np.float32)


def elastic_energy_is_lost(problem: ContactProblem, rms: float) -> bool:
    """Whether errors in the last digits of the pressure have more energy than any elastic energy of the problem.  With
    heights h of that rms value and pressures p ≥ 0 of mean 1, ⟨p, Gp⟩ is at most ⟨h, Kh⟩ in a periodic cell, and at
    most the largest compliance times ⟨p²⟩, which is at most the number of points.
    """
    grid, solid = problem.grid, problem.solid
    shortest, longest = math.hypot(*(math.pi / step for step in grid.spacing)), 2 * math.pi / max(grid.period)
    stiffness, compliance = float(solid.stiffness(np.array(shortest))), float(solid.compliance(np.array(longest)))
    most = min(rms**2 * stiffness if grid.domain.wraps else math.inf, grid.size * compliance)
    return last_digits(problem, 1.0, problem.law.range_at(1.0)) > most


def deepest(problem: ContactProblem, height: float) -> float:
    """How far below the highest point another may lie and still touch; inf if that is more than `height`.  Collective.

    A point i in contact lies below the highest one j by h_j − h_i ≤ u_j − u_i ≤ (max G − min G) Σp, and G lies between
    ±⟨compliance(q)⟩, the mean over all modes.  The reach of a law adds to that depth.  A law that limits the pressure
    admits any overlap, so that there is no such depth.
    """
    if problem.law.highest < math.inf:
        return math.inf
    grid, solid, beyond = problem.grid, problem.solid, problem.law.reach
    stiffest = math.hypot(*(math.pi / step for step in grid.spacing))
    if 2 * problem.mean_pressure * grid.size * float(solid.compliance(np.array(stiffest))) + beyond >= height:
        return math.inf  # the mean of the compliance is larger still
    depth = BEYOND * 2 * problem.mean_pressure * grid.size * mean_compliance(grid, solid) + beyond
    return depth if depth < height else math.inf


def mean_compliance(grid: SlabGrid, solid: Solid) -> float:
    """Mean compliance of all modes, that of a point.  Collective."""
    parts = []
    solid.modes(grid, 0, 0)  # collective, where the domain has a border
    for first in range(0, grid.spectral_shape[0], grid.band):
        stop = min(first + grid.band, grid.spectral_shape[0])
        parts.append(float(grid.hermitian_weight[first:stop, 0] @ (solid.modes(grid, first, stop) @ grid.even_weight)))
    return grid.reduction.sum(parts) / grid.modes


class Heights(NamedTuple):
    """Dimensionless heights (nx_local, ny) of mean 0, and how they were made.

    top: the largest dimensionless height.  unit: unit of heights, 0 for a plane, 1 if they stay as they are.
    rms, high: rms and largest value of the physical heights.  depth: points more than this below `high` were raised to
    that depth; inf if none was.
    """

    field: np.ndarray
    top: float
    unit: float
    rms: float
    high: float
    depth: float


def dimensionless_heights(problem: ContactProblem, overwrite: bool = False) -> Heights:
    """Dimensionless heights, in a new array or, if `overwrite` and no point is raised, in that of the physical ones; or
    these, if they need no change.  Collective.

    Raises InputError if the range of heights, the mean pressure or the solid's stiffness to the longest wave exceeds
    `LARGEST` or `STIFFEST`.
    """
    grid, heights = problem.grid, problem.heights
    reduce, threads, rows = grid.reduction, grid.threads, grid.local_shape[0]

    def measure(first: int, stop: int) -> tuple[float, float]:
        return heights[first:stop].min(), heights[first:stop].max()

    lows, highs = zip(*threads.collect(measure, rows, grid.band), strict=True)
    low, high = float(reduce.min(lows)), float(reduce.max(highs))
    solid = problem.solid
    stiffer = float(solid.factor(np.array(2 * math.pi / max(grid.lengths))))
    stiffer = stiffer or math.ulp(0.0)  # where it underflows, it is refused
    limits = (
        ("range of heights / grid spacing", high / 2 - low / 2, min(grid.spacing), LARGEST),
        ("mean pressure / contact modulus", problem.mean_pressure, solid.contact_modulus, LARGEST),
        (f"{solid.long_waves}: stiffness to the longest wave / that of a half-space", stiffer, 1.0, STIFFEST),
    )
    for name, value, unit, limit in limits:
        if value != 0 and not 1 / limit <= value / unit <= limit:
            raise InputError(f"{name} = {value / unit:.1e}: must lie between {1 / limit:g} and {limit:g}")
    if low == high and not grid.domain.wraps and problem.mean_pressure > 0:  # a punch: its indentation is the unit
        unit = problem.mean_pressure / solid.contact_modulus * max(grid.lengths)
        return Heights(np.zeros(grid.local_shape), 0.0, unit, unit, high, math.inf)
    if low == high:
        return Heights(np.zeros(grid.local_shape, heights.dtype), 0.0, 0.0, 0.0, high, math.inf)
    depth = deepest(problem, high - low) if problem.mean_pressure > 0 and not problem.imposed else math.inf
    if problem.law.reach == 0 and depth == math.inf and problem.mean_pressure > 0 and max(abs(low), high) < MODERATE**2:
        mean, rms = _spread(grid, threads.collect(lambda a, b: _sums(heights[a:b]), rows, grid.band))
        centred = max(CENTRED, float(np.finfo(heights.dtype).eps) / 2)
        if 1 / MODERATE <= rms <= MODERATE and abs(mean) <= centred * rms:
            return Heights(heights, high, 1.0, rms, high, math.inf)
    out = heights if overwrite and depth == math.inf else grid.new_field()

    def rescale(size: float) -> tuple[float, float]:
        """Sets `out` to max((heights − high)/size, −1); returns its mean and standard deviation."""

        def part(first: int, stop: int) -> tuple[float, float]:
            own = out[first:stop]
            np.subtract(heights[first:stop], high, out=own)
            own /= size
            np.maximum(own, -1.0, out=own)
            return _sums(own)

        return _spread(grid, threads.collect(part, rows, grid.band))

    size = high - low
    mean, spread = rescale(size)
    rms = size * spread
    if depth < math.inf:
        size = depth
        mean, spread = rescale(size)
    inverse = 1 / spread

    def centre(_: int, first: int, stop: int) -> None:
        part = out[first:stop]
        part -= mean
        part *= inverse

    threads.share(centre, rows, grid.band)
    return Heights(out, -mean * inverse, size * spread, rms, high, depth)


def _sums(field: np.ndarray) -> tuple[float, float]:
    """The sum of a field and that of its squares."""
    field = field.astype(np.float64, copy=False)
    return float(field.sum()), float(np.vdot(field, field))


def _spread(grid: SlabGrid, parts: list[tuple[float, float]]) -> tuple[float, float]:
    """Mean and standard deviation from sums of values and of their squares over some rows.  Collective."""
    mean, square = grid.reduction.sums(*map(math.fsum, zip(*parts, strict=True))) / grid.size
    return mean, math.sqrt(max(square - mean**2, 0.0))  # 0 where the mean is far larger
