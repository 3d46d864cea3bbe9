"""What a solver meets by itself in place of a given mean pressure: an approach, or a contact area.

The solver prescribes the level λ of contact, the value of g = u − h there, and reads off the load.  Lengths and
pressures are in the units of the problem; heights are counted from their mean, so that the mean gap is −λ.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from statistics import NormalDist
from typing import NamedTuple

SURE = 0.7  # part of the tolerance of an approach that the certified error may take
COARSE = 0.02  # relative tolerance of the area on coarse grids
SETTLED = 1e-3  # error of the energy over the squared change of ln p̄ below which an area is known well enough to ask it
STEP = 0.5  # largest change of ln p̄ that is asked for at once; to fall by more may lose contact
STEEPEST = 3.0  # largest factor between dλ/d ln p̄ and E_el/p̄, and inverse of the smallest
USUAL, LEAST, MOST = 0.4, 0.2, 0.9  # factors from grid to grid on the change of the area at one load


class Measured(NamedTuple):
    """Numbers of a feasible pressure: its level λ, mean, elastic energy per point, number of points in contact, and
    number of all points.
    """

    level: float
    pressure: float
    energy: float
    contact: int
    size: int

    @property
    def range(self) -> float:
        """About dλ/d ln p̄, the length γ in p̄ ∝ exp(λ/γ): E_el/p̄ (Akarapu, Sharp, Robbins 2011,
        doi:10.1103/PhysRevLett.106.204301).
        """
        return self.energy / self.pressure

    @property
    def log_load(self) -> float:
        """ln of the mean pressure of Persson's theory for the area, area = erf(p̄/√2 s), up to a constant."""
        return math.log(quantile(self.contact / self.size, self.size))


@dataclass(frozen=True)
class Imposed:
    """The target: an approach to `allowed`, level + compliance · p̄ with the level counted from first contact; or a
    relative area, to the part `allowed` of it or to one pixel.  compliance: of the mean mode, displacement per mean
    pressure.
    """

    allowed: float
    approach: float = 0.0
    compliance: float = 0.0
    area: float = 0.0

    def in_units(self, height: float, pressure: float, top: float) -> Imposed:
        """The same in other units, the approach counted from the mean height, which is `top` below the highest."""
        if self.area:
            return self
        return Imposed(self.allowed / height, self.approach / height - top, self.compliance * pressure / height)

    def guess(self, stress: float, rms: float, size: int) -> float:
        """A mean pressure to begin with, from the rms stress of full contact: Persson's theory; or its logarithm falls
        about linearly with the gap over the rms height.
        """
        if self.area:
            return stress * quantile(self.area, size)
        return stress * math.exp(max(-20.0, min(3.0, 2 * self.approach / rms)))

    def missed(self, at: Measured, exact: bool) -> float:
        """Distance to the target over what is allowed beside the certified error; with some slack if not `exact`."""
        if self.area:
            part = self.allowed if exact else max(self.allowed, COARSE)
            return abs(at.contact / at.size - self.area) / max(part * self.area, 1 / at.size)
        wanted = self.approach - self.compliance * at.pressure
        return abs(at.level - wanted) / ((1 - SURE) * self.allowed) if exact else 0.0

    def needed(self, at: Measured) -> float:
        """The certified error over 2 E_el with which the level is known to `SURE` of what is allowed: the error of the
        level is at most (2√(AB) + B)/p̄ with A = E_el and B the certified error (`quantities.MeanGap.bound`).  No
        certificate tells the error of an area.
        """
        return math.inf if self.area else (SURE * self.allowed / at.range / (2 + SURE)) ** 2 / 2


@dataclass
class Aim:
    """The level that is prescribed while a target is sought.

    stretch: dλ/d ln p̄ over its estimate `Measured.range`; here: the last measurement on this grid from which the level
    was changed; solved: those at the end of each coarser grid.
    """

    target: Imposed
    level: float
    stretch: float = 1.0
    here: Measured | None = None
    solved: Sequence[Measured] = field(default_factory=list)

    def follow(self, at: Measured, least: float) -> None:
        """Sets the level of an imposed approach, which depends on the load at most; at least to `least`."""
        if not self.target.area:
            level = self.target.approach - self.target.compliance * at.pressure
            self.level = max(least, level, at.level - STEP * at.range)

    def moves(self, at: Measured, error: float, exact: bool) -> bool:
        """Changes the level if the area misses its target by more than the error of the energy, relative to 2 E_el,
        lets areas be wrong; returns whether.
        """
        change = math.log(quantile(self.target.area, at.size)) - at.log_load if self.target.area else 0.0
        if not change or SETTLED * change**2 < error or self.target.missed(at, exact) <= 1:
            return False
        if self.here is not None and (moved := at.log_load - self.here.log_load):
            stretch = (at.level - self.here.level) / moved / at.range
            self.stretch = max(1 / STEEPEST, min(stretch, STEEPEST))
        self.here, self.level = at, at.level + self.stretch * at.range * max(-STEP, min(change, STEP))
        return True

    def refine(self, at: Measured) -> Aim:
        """The aim on the next finer grid, where an area at one load changes further as it did over coarser grids."""
        solved = [*self.solved, at]
        if not self.target.area:
            return Aim(self.target, self.level, solved=solved)
        reach = self.stretch * at.range
        loads = [each.log_load - each.level / reach for each in solved]
        changes = [b - a for a, b in itertools.pairwise(loads)]
        factor = changes[-1] / changes[-2] if len(changes) > 1 and changes[-2] else USUAL
        predicted = loads[-1] + max(LEAST, min(factor, MOST)) * (changes[-1] if changes else 0.0)
        level = reach * (math.log(quantile(self.target.area, at.size)) - predicted)
        return Aim(self.target, level, self.stretch, solved=solved)


def quantile(area: float, size: int) -> float:
    """x with area = erf(x/√2); the area is kept half a point away from 0 and 1."""
    half = 0.5 / size
    return NormalDist().inv_cdf((1 + min(max(area, half), 1 - half)) / 2)
