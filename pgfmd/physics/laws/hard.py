"""The hard wall: p ≥ 0, gap ≥ 0, and one of them is zero."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numba
import numpy as np

from pgfmd.physics.laws.law import ContactLaw, Units

if TYPE_CHECKING:
    from pgfmd.physics.elasticity import Elasticity

_jit = numba.njit(nogil=True, cache=True, error_model="numpy")


@dataclass(frozen=True, kw_only=True)
class HardWall(ContactLaw):
    """The surfaces touch but do not overlap."""

    kind: ClassVar[str] = "hard"
    methods: ClassVar[tuple[str, ...]] = ("active-set", "gfmd")

    def gap(self, pressure: float, solid: Elasticity) -> float:
        """0 at every pressure."""
        return 0.0

    def in_units(self, units: Units) -> HardWall:
        """The same in any units."""
        return self

    def respond(
        self, target: np.ndarray, compliance: float, level: float, pressure: np.ndarray, first: int, stop: int
    ) -> tuple[float, float]:
        """A projection: p = max(target + level, 0)/compliance."""
        return project(target, compliance, level, pressure, first, stop)

    def moments(self, pressure: np.ndarray, gap: np.ndarray, first: int, stop: int) -> tuple[float, int]:
        """(Σ p g, #{p > 1})."""
        return moments(pressure, gap, first, stop)

    def split(
        self, pressure: np.ndarray, gap: np.ndarray, compliance: float, level: float, first: int, residual: np.ndarray
    ) -> float:
        """ρ = min(g − level, compliance · p)."""
        return split(pressure, gap, compliance, level, first, residual)

    def finish(self, pressure: np.ndarray, gap: np.ndarray, level: float, units: Units) -> float:
        """Makes the gap 0 where there is pressure, and nowhere negative."""
        return finish_rows(pressure, gap, level, units.pressure, units.height)


@_jit
def project(
    target: np.ndarray, compliance: float, level: float, pressure: np.ndarray, first: int, stop: int
) -> tuple[float, float]:
    """p = max(target + level, 0)/compliance; returns Σ p and Σ dp/dlevel."""
    total = slope = 0.0
    for i in range(first, stop):
        for j in range(target.shape[1]):
            p = max(target[i, j] + level, 0.0) / compliance
            pressure[i, j] = p
            total += p
            slope += p > 0
    return total, slope / compliance


@_jit
def moments(pressure: np.ndarray, gap: np.ndarray, first: int, stop: int) -> tuple[float, int]:
    """(Σ p̂ g, #{p̂ > 1}) of rows first … stop−1."""
    potential = 0.0
    loaded = 0
    for i in range(first, stop):
        for j in range(gap.shape[1]):
            p = pressure[i, j]
            potential += p * gap[i, j]
            loaded += p > 1
    return potential, loaded


@_jit
def split(
    pressure: np.ndarray, gap: np.ndarray, compliance: float, level: float, first: int, residual: np.ndarray
) -> float:
    """residual = min(g − level, compliance p) of the rows from `first` on; returns Σ p (g − level − residual)."""
    total = 0.0
    for i in range(residual.shape[0]):
        for j in range(gap.shape[1]):
            p, away = pressure[first + i, j], gap[first + i, j] - level
            within = compliance * p
            residual[i, j] = min(away, within)
            if away > within:
                total += p * (away - within)
    return total


@_jit
def finish_rows(pressure: np.ndarray, gap: np.ndarray, level: float, unit: float, height: float) -> float:
    """p = unit · p and gap = height · (0 where p > 0, max(gap − level, 0) elsewhere); returns the largest |gap − level|
    where p > 0 and level − gap elsewhere, as they were.
    """
    largest = 0.0
    for i in range(gap.shape[0]):
        for j in range(gap.shape[1]):
            away = gap[i, j] - level
            closed = pressure[i, j] > 0
            wrong = abs(away) if closed else -away
            if wrong > largest:
                largest = wrong
            gap[i, j] = 0.0 if closed else height * max(away, 0.0)
            pressure[i, j] *= unit
    return largest
