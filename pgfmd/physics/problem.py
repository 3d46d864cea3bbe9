"""What is to be solved: a rough surface pressed against an elastic solid at a mean pressure, an area or an approach.

To impose an approach, the solver prescribes the level λ, the value of g = u − h at points in contact, and the load
follows.  To impose an area, it prescribes a load and corrects it.  Heights have mean 0: so the mean gap is −λ.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from pgfmd.errors import InputError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.physics.laws.law import ContactLaw
from pgfmd.physics.solids.solid import Solid

SURE = 0.7  # least part of the tolerance of an approach that is left to the certified error
MOST = 0.98  # largest sum of that part and of the distance from the target
NOISE = 4.0  # error of ln p̄ at an imposed area over √(relative energy error): up to 3.6 in 12 solves, 512² … 8192²
STEP = 0.5  # largest change of ln p̄ in one step: a level that falls by more may lose contact


class Measured(NamedTuple):
    """Of a feasible pressure: its level λ, mean, elastic energy per point, points in contact, and all points."""

    level: float
    pressure: float
    energy: float
    contact: int
    size: int

    @property
    def range(self) -> float:
        """About γ in p̄ ∝ exp(λ/γ), E_el/p̄ (Akarapu, Sharp, Robbins 2011, doi:10.1103/PhysRevLett.106.204301)."""
        return self.energy / self.pressure


@dataclass(frozen=True)
class Imposed:
    """The target: an approach, level + compliance · p̄, the level counted from first contact, within `allowed`; or, if
    `area` is not 0, a relative area, within the part `allowed` of it or one pixel.  compliance: of the mean mode,
    displacement per mean pressure.
    """

    allowed: float
    approach: float = 0.0
    compliance: float = 0.0
    area: float = 0.0

    @property
    def is_gap(self) -> bool:
        """Whether it is a mean gap, whatever the load, where the approach counts from the mean height."""
        return not self.area and not self.compliance and self.approach < 0

    def in_units(self, height: float, pressure: float, top: float) -> Imposed:
        """The target in these units, the approach counted from the mean height, `top` units below the highest."""
        if self.area:
            return self
        return Imposed(self.allowed / height, self.approach / height - top, self.compliance * pressure / height)

    def guess(self, stress: float, rms: float, size: int) -> float:
        """A mean pressure to begin with.  stress: rms of full contact; rms: of the heights.  An area by Persson's
        theory; for an approach ln p̄ is linear in approach over rms, roughly.
        """
        if self.area:
            return stress * quantile(self.area, size)
        return stress * math.exp(max(-20.0, min(3.0, 2 * self.approach / rms)))

    @property
    def tolerance(self) -> float:
        """Energy error over 2 E_el at which an area is known to half of what is allowed: a measured rule (`NOISE`), no
        bound.  At least 1e-8: below, only single points change.
        """
        return max((self.allowed / 2 / NOISE) ** 2, 1e-8) if self.area else math.inf

    def missed(self, at: Measured) -> float:
        """Distance from the target over the part of `allowed` that is not left to the certified error: met up to 1."""
        if self.area:
            return abs(at.contact / at.size - self.area) / max(self.allowed * self.area, 1 / at.size)
        return abs(at.level - self.approach + self.compliance * at.pressure) / ((1 - SURE) * self.allowed)

    def needed(self, at: Measured) -> float:
        """Certified error over 2 E_el that bounds the error of the level by `SURE` allowed, or by what the distance to
        the target leaves of `allowed`: that error is at most (2√(AB) + B)/p̄ with A = E_el and B the certified error
        (`controls.MeanGap.bound`).
        """
        rest = max(SURE, MOST - (1 - SURE) * self.missed(at))
        return math.inf if self.area else (rest * self.allowed / at.range / (2 + rest)) ** 2 / 2


@dataclass
class Aim:
    """What a solver prescribes while it seeks a target: the level for an approach, the mean pressure for an area.

    stresses: number of points of a grid → rms stress of full contact there (Persson's s), up to a common factor; of
    this grid and the finest at least.  solved: `Aim.loaded` at the end of each coarser grid.  last:
    the last change of ln p̄; most: limit on the size of the next ones.
    """

    target: Imposed
    stresses: Mapping[int, float] = field(default_factory=dict)
    level: float = 0.0
    pressure: float = 0.0
    solved: Sequence[float] = ()
    last: float = 0.0
    most: float = STEP

    def follow(self, at: Measured, least: float) -> None:
        """Sets the level of the imposed approach at this load, at least `least`, lowered by at most `STEP` · range."""
        level = self.target.approach - self.target.compliance * at.pressure
        self.level = max(least, level, at.level - STEP * at.range)

    def moves(self, at: Measured, error: float) -> bool:
        """Changes the mean pressure if the area misses its target by more than its uncertainty; returns whether it did.

        error: of the energy, over 2 E_el.  The uncertainty must also be small enough that the change meets the target,
        or leaves a fifth of the distance.  When the sign of the change turns, its limit `most` becomes half of the last
        one, so that the search converges; far below `allowed` it ends.
        """
        change, unsure = self._change(at), NOISE * math.sqrt(error)
        allowed = self.target.allowed
        if self.target.missed(at) <= 1 or abs(change) < allowed + unsure or unsure > max(allowed / 2, abs(change) / 5):
            return False
        if change * self.last < 0:
            self.most = abs(self.last) / 2
        if self.most < allowed / 10:  # the area jumps here
            return False
        self.last = max(-self.most, min(change, self.most))
        self.pressure = at.pressure * math.exp(self.last)
        return True

    def refine(self, at: Measured) -> Aim:
        """The aim on the next finer grid."""
        if not self.target.area:
            return dataclasses.replace(self)
        pressure = at.pressure * math.exp(self._change(at))
        return dataclasses.replace(self, pressure=pressure, solved=[*self.solved, self.loaded(at)], last=0.0, most=STEP)

    def loaded(self, at: Measured) -> float:
        """ln of the mean pressure at which Persson's theory, area = erf(p̄/√2 s), gives the measured area, over the
        actual one: the same on all grids up to the error of discretisation.
        """
        return math.log(quantile(at.contact / at.size, at.size)) + math.log(self.stresses[at.size] / at.pressure)

    def _change(self, at: Measured) -> float:
        """Change of ln p̄, at most `STEP`, that gives the finest grid the area; coarser grids are extrapolated."""
        values, size = [*self.solved, self.loaded(at)], max(self.stresses)
        changes = [b - a for a, b in itertools.pairwise(values)]
        ahead = changes[-1] * (1 - math.sqrt(at.size / size)) if changes else 0.0
        wanted = math.log(quantile(self.target.area, size) * self.stresses[size]) - values[-1] - ahead
        return max(-STEP, min(wanted - math.log(at.pressure), STEP))


def quantile(area: float, size: int) -> float:
    """x with area = erf(x/√2); the area is kept half a point away from 0 and 1."""
    half = 0.5 / size
    return NormalDist().inv_cdf((1 + min(max(area, half), 1 - half)) / 2)


@dataclass(frozen=True)
class ContactProblem:
    """A rigid surface of `heights` (nx_local, ny) on `grid`, pressed at `mean_pressure` against an elastic `solid`;
    `law` relates pressure and gap.  imposed: the target in place of `mean_pressure`, which is then a guess.
    """

    grid: SlabGrid
    heights: np.ndarray
    solid: Solid
    law: ContactLaw
    mean_pressure: float = 0.0
    imposed: Imposed | None = None

    def at(self, mean_pressure: float) -> ContactProblem:
        """The same surface at another mean pressure."""
        return dataclasses.replace(self, mean_pressure=mean_pressure)

    def imposing(self, imposed: Imposed | None, guess: float) -> ContactProblem:
        """The same surface with that target (None: the mean pressure) and a guess of the mean pressure."""
        return dataclasses.replace(self, mean_pressure=guess, imposed=imposed)

    def on(self, grid: SlabGrid, heights: np.ndarray) -> ContactProblem:
        """The same solid, law and mean pressure with another surface."""
        return dataclasses.replace(self, grid=grid, heights=heights)

    def with_law(self, law: ContactLaw) -> ContactProblem:
        """The same problem under another law."""
        return dataclasses.replace(self, law=law)

    @property
    def load(self) -> float:
        """Σ p over all points."""
        return self.mean_pressure * self.grid.size

    @property
    def least_area(self) -> float:
        """A lower bound of the relative contact area: p̄ over the largest pressure that the law admits."""
        return max(self.mean_pressure, 0.0) / self.law.highest

    def check(self) -> None:
        """Raise InputError for a mean pressure that the law does not admit."""
        pressure, law = self.mean_pressure, self.law
        if not (pressure > law.lowest or law.releases and pressure == law.lowest) or math.isinf(pressure):
            least = f"above {law.lowest:g}" if law.lowest < 0 else "not negative" if law.releases else "positive"
            raise InputError(f"mean pressure = {pressure!r}: must be {least} and finite with a wall of kind {law.kind}")
        if not pressure < law.highest:
            raise InputError(f"mean pressure = {pressure!r}: must be below {law.highest:g}, the most the wall bears")
