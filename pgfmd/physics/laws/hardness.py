"""The wall of limited hardness: 0 ≤ p ≤ σ_Y, as if asperities yielded, and gap = 0 where p > 0.

The pressure minimises the same energy as under the hard wall, over 0 ≤ p ≤ σ_Y, where φ(p) = 0.  Where p = σ_Y the
wall yields: there u − h ≤ 0, and h − u is the plastic depth.  Solvers treat it as a negative gap; a solution has a
field of its own for it.  σ_Y → ∞ is the hard wall; at p̄ = σ_Y all points bear σ_Y.

This holds while the load increases.  A wall that has yielded keeps its shape, heights less plastic depth: under a
lower load it is this shape that touches, without further yielding up to the largest load so far.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pgfmd.options.rules import POSITIVE
from pgfmd.options.section import key
from pgfmd.physics.laws.hard import HardWall
from pgfmd.physics.laws.law import Units


@dataclass(frozen=True, kw_only=True)
class Hardness(HardWall):
    """A hard wall that yields where the pressure reaches `hardness`."""

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
        """As under the hard wall.  Yielded points get σ_Y to the last digit: their gap is not 0, so that an error there
        is of first order in energy.
        """
        yields = pressure >= self.hardness
        violation = super().finish(pressure, gap, level, units)
        pressure[yields] = units.highest
        np.minimum(pressure, units.highest, out=pressure)
        return violation
