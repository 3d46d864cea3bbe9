"""Walls that attract: an energy per area W(g) of the gap g, with the pressure p = −W'(g), negative where it attracts.

The gap is at least `least`, where the wall is hard; there any pressure above −W' is admissible.  The energy of a
contact, ½⟨u, Ku⟩ + ΣW(g), has several minima.  Solvers see gaps in units of the range ρ, and pressures in units of
σ₀ = w/ρ, w the work of adhesion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from pgfmd.grid.kernels import jit, u
from pgfmd.options import expressions as formula
from pgfmd.options.rules import POSITIVE, flag, interval, number
from pgfmd.options.section import key, wrong
from pgfmd.physics.laws.law import ContactLaw

if TYPE_CHECKING:
    from scipy.interpolate import PPoly

NODES = 20001  # of the spline through a formula, which is the law


@dataclass(frozen=True, kw_only=True)
class AttractiveWall(ContactLaw):
    """Base of the laws that attract.  least: the smallest gap over ρ, where the wall is hard.  farthest: gap over ρ
    beyond which the attraction is neglected.  steep: gap over ρ where −W'' is largest.
    """

    methods: ClassVar[tuple[str, ...]] = ("adhesive",)
    convex: ClassVar[bool] = False
    least: ClassVar[float] = 0.0
    farthest: ClassVar[float] = 60.0
    steep: ClassVar[float] = 0.0

    unresolved: bool = key(flag(), False, "solve also where the process zone ρ²E'/w is shorter than .8 pixels")

    @property
    def lowest(self) -> float:
        """No limit: a job may ask for any mean tension, and the run finds out whether a contact bears it."""
        return -math.inf

    @property
    def units(self) -> tuple[float, float]:
        """ρ and σ₀."""
        raise NotImplementedError

    def process_zone(self, contact_modulus: float) -> float:
        """ℓ = ρ E'/σ₀ = ρ²E'/w, the length along the surface over which the attraction falls at an edge of contact."""
        return self.units[0] * (contact_modulus / self.units[1])

    def energy(self, gap: np.ndarray) -> np.ndarray:
        """W/w at gaps over ρ."""
        raise NotImplementedError

    def traction(self, gap: np.ndarray) -> np.ndarray:
        """W'/σ₀ at gaps over ρ: positive where the wall attracts."""
        raise NotImplementedError

    def curvature(self, gap: np.ndarray) -> np.ndarray:
        """W''ρ/σ₀ at gaps over ρ."""
        raise NotImplementedError

    def values(self, gap: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Energy, traction and curvature at gaps over ρ."""
        return self.energy(gap), self.traction(gap), self.curvature(gap)

    def steepest(self, gap: np.ndarray, distance: float) -> np.ndarray:
        """The largest −W''ρ/σ₀ within `distance` of each gap, provided that it falls on both sides of `steep`."""
        return -self.curvature(np.clip(self.steep, np.maximum(gap - distance, self.least), gap + distance))


@dataclass(frozen=True, kw_only=True)
class RangedWall(AttractiveWall):
    """A hard wall that attracts within a range: `work` is the integral of its traction."""

    work: float = key(POSITIVE, about="work of adhesion w, per area", unit="pressure*length", needed=True, example=0.05)
    range: float = key(
        POSITIVE, about="ρ: the largest attraction is work/range", unit="length", needed=True, example=0.5
    )

    def check(self) -> None:
        """Raises InputError where the largest attraction is 0 or infinite."""
        if not 0 < self.work / self.range < math.inf:
            raise wrong(self, "work", "the largest attraction, work/range, is beyond double precision")

    @property
    def units(self) -> tuple[float, float]:
        return self.range, self.work / self.range


@dataclass(frozen=True, kw_only=True)
class AdhesiveWall(RangedWall):
    """A hard wall that attracts: energy −work exp(−gap/range) per area."""

    kind: ClassVar[str] = "adhesive"

    def energy(self, gap: np.ndarray) -> np.ndarray:
        return -self.traction(gap)

    def traction(self, gap: np.ndarray) -> np.ndarray:
        flat = np.ascontiguousarray(gap, float).reshape(-1)
        out = np.empty_like(flat)
        decay(flat, self.farthest, out)
        return out.reshape(np.shape(gap))

    def curvature(self, gap: np.ndarray) -> np.ndarray:
        return -self.traction(gap)

    def values(self, gap: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        traction = self.traction(gap)
        return -traction, traction, -traction


@jit
def decay(gap: np.ndarray, last: float, out: np.ndarray) -> None:
    """out = exp(−gap), 0 beyond a last gap; fast where points touch or are far, as most do."""
    for i in range(gap.size):
        at = gap[u(i)]
        out[u(i)] = 0.0 if at > last else 1.0 if at == 0 else math.exp(-at)


@dataclass(frozen=True, kw_only=True)
class Dugdale(RangedWall):
    """A hard wall that attracts with the traction work/range up to the gap `range` (Dugdale, Maugis)."""

    kind: ClassVar[str] = "dugdale"
    steep: ClassVar[float] = 1.0
    edge: float = key(
        number(low=0, high=2),
        0.0,
        "width, over range, of the interval about the range in which the traction falls to 0, as a cubic; 0: it jumps",
        unit="1",
    )

    def _across(self, gap: np.ndarray) -> np.ndarray:
        """Position across the edge, from 0 to 1."""
        return np.clip((gap - 1) / self.edge + 0.5, 0.0, 1.0)

    def energy(self, gap: np.ndarray) -> np.ndarray:
        """−∫ traction from the gap to infinity."""
        if self.edge == 0:
            return np.minimum(gap - 1, 0.0)
        x = self._across(gap)
        return np.minimum(gap - 1 + self.edge / 2, 0.0) - self.edge * (0.5 - x + x**3 - x**4 / 2)

    def traction(self, gap: np.ndarray) -> np.ndarray:
        """1 − 3x² + 2x³ at x across the edge."""
        if self.edge == 0:
            return np.where(gap < 1, 1.0, 0.0)
        x = self._across(gap)
        return 1 - x * x * (3 - 2 * x)

    def curvature(self, gap: np.ndarray) -> np.ndarray:
        """−6x(1 − x)/edge."""
        if self.edge == 0:
            return np.zeros_like(gap)
        x = self._across(gap)
        return -6 / self.edge * x * (1 - x)

    def steepest(self, gap: np.ndarray, distance: float) -> np.ndarray:
        """As of `AttractiveWall`; where the traction jumps, 1e9, which no stiffness reaches."""
        if self.edge == 0:
            return np.where(np.abs(gap - 1) <= distance, 1e9, 0.0)
        return super().steepest(gap, distance)


@dataclass(frozen=True, kw_only=True)
class Potential(AttractiveWall):
    """A pressure that is any formula of the gap, with repulsion at small gaps and attraction at large ones (Morse,
    Lennard-Jones).  The gap is at least the first of `gaps`; beyond the second the pressure is 0.
    """

    kind: ClassVar[str] = "potential"
    pressure: str = key(
        formula.formula("gap"), about="p(gap), in the units of both, negative where it attracts", needed=True,
        example="0.2 * (exp(-4 * (gap - 1)) - exp(-2 * (gap - 1)))",
    )  # fmt: skip
    gaps: tuple[float, float] = key(
        interval(), about="smallest and largest gap", unit="length", needed=True, example=[0.3, 10.0]
    )

    def check(self) -> None:
        """Raises InputError unless the formula is finite between the gaps, and attracts somewhere."""
        try:
            _, _, largest_tension = _spline(self.pressure, self.gaps)
        except ValueError as error:
            raise wrong(self, "pressure", str(error)) from None
        if not largest_tension > 0:
            raise wrong(self, "pressure", 'attracts nowhere between the gaps; without attraction: kind = "formula"')

    @property
    def units(self) -> tuple[float, float]:
        """Depth of the energy over the largest tension, and that tension."""
        return _spline(self.pressure, self.gaps)[1:]

    @property
    def least(self) -> float:  # type: ignore[override]
        return self.gaps[0] / self.units[0]

    @property
    def farthest(self) -> float:  # type: ignore[override]
        return self.gaps[1] / self.units[0]

    @property
    def steep(self) -> float:  # type: ignore[override]
        """Where the pressure rises most."""
        nodes = np.linspace(self.least, self.farthest, NODES)
        return float(nodes[np.argmax(_spline(self.pressure, self.gaps)[0](nodes, 1))])

    def _at(self, gap: np.ndarray, derivative: int) -> np.ndarray:
        spline, last = _spline(self.pressure, self.gaps)[0], self.farthest
        spline = spline.antiderivative() if derivative < 0 else spline
        end = spline(last) if derivative < 0 else 0.0
        return np.where(gap < last, end - spline(np.minimum(gap, last), max(derivative, 0)), 0.0)

    def energy(self, gap: np.ndarray) -> np.ndarray:
        """−∫ p from the last gap, so that it is 0 there."""
        return self._at(gap, -1)

    def traction(self, gap: np.ndarray) -> np.ndarray:
        return self._at(gap, 0)

    def curvature(self, gap: np.ndarray) -> np.ndarray:
        return self._at(gap, 1)


@cache
def _spline(written: str, gaps: tuple[float, float]) -> tuple[PPoly, float, float]:
    """The cubic spline through the formula in units of the law, and these two units, 0 if it attracts nowhere.  Raises
    ValueError where it is not finite.
    """
    from scipy.interpolate import CubicSpline

    of, nodes = formula.function(written, "gap"), np.linspace(*gaps, NODES)
    values = np.array([formula.value(of, at) for at in nodes])
    if not np.isfinite(values).all():
        raise ValueError(f"is not finite at gap = {nodes[~np.isfinite(values)][0]:g}")
    lowest, width = float(values.min()), gaps[1] - gaps[0]
    if not lowest < 0:
        return CubicSpline(nodes, values), 0.0, 0.0
    values, places = values / -lowest, (nodes - gaps[0]) / width
    energy = CubicSpline(places, values).antiderivative()(places)
    length = float(np.max(energy - energy[-1])) * width
    return CubicSpline(nodes / length, values), length, -lowest
