"""The hard wall: p ≥ 0, gap ≥ 0, and one of them is zero; and one of limited hardness, as if asperities yielded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from pgfmd.options.rules import POSITIVE
from pgfmd.options.section import key
from pgfmd.parallel.compiled import compiled
from pgfmd.physics.laws.law import ContactLaw, Units

if TYPE_CHECKING:
    from pgfmd.physics.solids.solid import Solid

SATURATED = 1 - 1e-12  # of the highest pressure: a point that bears more than this is at its bound up to rounding

_jit = compiled()


@dataclass(frozen=True, kw_only=True)
class HardWall(ContactLaw):
    """The surfaces touch but do not overlap."""

    kind: ClassVar[str] = "hard"
    methods: ClassVar[tuple[str, ...]] = ("active-set", "gfmd")

    def gap(self, pressure: float, solid: Solid) -> float:
        return 0.0

    def in_units(self, units: Units) -> HardWall:
        return self

    def respond(self, target: np.ndarray, pressure: np.ndarray, compliance: float, level: float) -> tuple[float, float]:
        """A projection: p = (target + level)/compliance, clipped to 0 … `highest`."""
        return project(target, pressure, compliance, level, self.highest)

    def moments(self, pressure: np.ndarray, gap: np.ndarray, threshold: float) -> tuple[float, float, int, float]:
        """(Σ p g, Σ p, number of points with p > threshold, 0)."""
        return *moments(pressure, gap, threshold, self.highest), 0.0

    def excess(
        self, pressure: np.ndarray, gap: np.ndarray, residual: np.ndarray, compliance: float, level: float
    ) -> float:
        """ε = g − level, but at most compliance · p, and at least compliance · (p − highest)."""
        return excess(pressure, gap, residual, compliance, level, self.highest)

    def finish(self, pressure: np.ndarray, gap: np.ndarray, level: float, units: Units) -> float:
        """Makes the gap 0 where the pressure is between its bounds, ≥ 0 where it is 0, ≤ 0 where it is `highest`."""
        return finish_rows(pressure, gap, level, self.highest, units.pressure, units.height)


@dataclass(frozen=True, kw_only=True)
class Hardness(HardWall):
    """A hard wall that yields where the pressure reaches `hardness`.

    The pressure minimises the same energy as under the hard wall, over 0 ≤ p ≤ σ_Y, where φ(p) = 0.  Where p = σ_Y the
    wall yields: there u − h ≤ 0, and h − u is the plastic depth.  Solvers treat it as a negative gap; a solution has a
    field of its own for it.  σ_Y → ∞ is the hard wall; at p̄ = σ_Y all points bear σ_Y.

    This holds while the load increases.  A wall that has yielded keeps its shape, heights less plastic depth: under a
    lower load it is this shape that touches, without further yielding up to the largest load so far.
    """

    kind: ClassVar[str] = "hardness"

    hardness: float = key(
        POSITIVE, about="σ_Y, the largest pressure that a point bears", unit="pressure", needed=True, example=0.1
    )

    @property
    def highest(self) -> float:
        return self.hardness

    def up_to(self, pressure: float) -> HardWall:
        """The hard wall, if that pressure is not above σ_Y."""
        return HardWall() if pressure <= self.hardness else self

    def in_units(self, units: Units) -> Hardness:
        return Hardness(hardness=self.hardness / units.pressure)

    def finish(self, pressure: np.ndarray, gap: np.ndarray, level: float, units: Units) -> float:
        """As under the hard wall; yielded points get σ_Y exactly: as their gap is not 0, errors are of first order."""
        yields = pressure >= self.hardness
        violation = super().finish(pressure, gap, level, units)
        pressure[yields] = units.highest
        np.minimum(pressure, units.highest, out=pressure)
        return violation


@_jit
def project(
    target: np.ndarray, pressure: np.ndarray, compliance: float, level: float, highest: float
) -> tuple[float, float]:
    """p = (target + level)/compliance, clipped to 0 … `highest`; returns Σ p and Σ dp/dlevel."""
    total = slope = 0.0
    for i in range(target.shape[0]):
        for j in range(target.shape[1]):
            p = min(max(target[i, j] + level, 0.0) / compliance, highest)
            pressure[i, j] = p
            total += p
            slope += 0 < p < highest
    return total, slope / compliance


@_jit
def moments(pressure: np.ndarray, gap: np.ndarray, threshold: float, highest: float) -> tuple[float, float, int]:
    """(Σ p̂ g, Σ p̂, #{p̂ > threshold}), the sums where p̂ < highest."""
    potential = load = 0.0
    loaded = 0
    for i in range(gap.shape[0]):
        for j in range(gap.shape[1]):
            p = pressure[i, j]
            loaded += p > threshold
            if p < SATURATED * highest:
                potential += p * gap[i, j]
                load += p
    return potential, load, loaded


@_jit
def excess(
    pressure: np.ndarray, gap: np.ndarray, residual: np.ndarray, compliance: float, level: float, highest: float
) -> float:
    """residual = g − level, clipped to compliance · (p − highest) … compliance · p; returns Σ excess, which is p g' for
    a gap g' = g − level − residual > 0 and (p − highest) g' for g' < 0.
    """
    total = 0.0
    for i in range(gap.shape[0]):
        for j in range(gap.shape[1]):
            p, away = pressure[i, j], gap[i, j] - level
            most, least = compliance * p, compliance * (p - highest)
            residual[i, j] = min(max(away, least), most)
            if away > most:
                total += p * (away - most)
            elif away < least:
                total += (p - highest) * (away - least)
    return total


@_jit
def finish_rows(pressure: np.ndarray, gap: np.ndarray, level: float, top: float, unit: float, height: float) -> float:
    """p = unit · p and gap = height · (gap − level), clipped to ≥ 0 where p = 0, ≤ 0 where p = top, and 0 elsewhere;
    returns the largest |change| of gap − level.
    """
    largest = 0.0
    for i in range(gap.shape[0]):
        for j in range(gap.shape[1]):
            p, away = pressure[i, j], gap[i, j] - level
            right = max(away, 0.0) if p <= 0 else min(away, 0.0) if p >= top else 0.0
            largest = max(largest, abs(away - right))
            gap[i, j] = height * right
            pressure[i, j] = unit * p
    return largest
