"""A homogeneous half-space, slabs of one material with three ways to hold the base, and a layer on a half-space.

Slab of thickness d, with t = q d (closed forms of plane-strain elasticity, k = 3 − 4ν):

    bonded     F = (k cosh 2t + 2t² + 5 − 4ν(3 − 2ν)) / (k sinh 2t − 2t)
    free       F = (cosh 2t − 1 − 2t²) / (sinh 2t + 2t)
    sliding    F = (sinh 2t + 2t) / (cosh 2t − 1)

The first two are limits of a layer that is bonded to a half-space.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import DTypeLike

from pgfmd.options.rules import choice, number
from pgfmd.options.section import key, wrong
from pgfmd.physics.solids.solid import Solid

if TYPE_CHECKING:
    from pgfmd.grid.slab_grid import SlabGrid
    from pgfmd.grid.transforms import ColumnAction

SERIES, TERMS = 1.5, 12  # t below which series are summed, and their terms after the first: the next is below 1e-17
THICK = 25.0  # t from which F is 1 to the last digit
Pair = tuple[float, float] | np.ndarray


@dataclass(frozen=True, kw_only=True)
class Homogeneous(Solid):
    """A half-space or, if a thickness is given, a slab.

    On a bonded base all of the response depends on Poisson's ratio, on a sliding one only the mean stiffness.
    """

    kind = "homogeneous"
    thickness: float = key(number(above=0, infinite=True), math.inf, "of a slab; inf is a half-space", unit="length")
    base: str = key(
        choice("bonded", "free", "sliding"), "bonded", "slab's far face; free: under constant pressure, not held"
    )

    def check(self) -> None:
        super().check()
        if math.isinf(self.thickness) and self.base != "bonded":
            raise wrong(self, "base", "only a slab has a base: give thickness as well")

    @property
    def needs_poisson(self) -> bool:
        return math.isfinite(self.thickness) and self.base != "free"

    @property
    def effort(self) -> float:
        return super().effort if math.isfinite(self.thickness) else 1.0

    @property
    def no_border(self) -> str:
        return "on a free base a slab has no approach of distant points" if self.base == "free" else ""

    @property
    def only_inwards(self) -> bool:
        return math.isinf(self.thickness)

    def factor(self, q: np.ndarray) -> np.ndarray:
        if math.isinf(self.thickness):
            return np.ones(np.shape(q))
        t, nu = q * self.thickness, self.poisson or 0.0
        if self.base != "sliding":
            return layer_factor(t, (0.0, 1.0) if self.base == "bonded" else (1.0, 0.0), (nu, 0.5))
        t = np.minimum(t, THICK)
        e, rise = np.exp(-2 * t), -np.expm1(-2 * t)
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            return (rise * (1 + e) + 4 * t * e) / rise**2

    def softest(self, lengths: tuple[float, float], spacing: tuple[float, float]) -> float:
        return super().softest(lengths, spacing) if math.isfinite(self.thickness) else 1.0

    def mean_stiffness(self, periodic: bool = True) -> float:
        """Of uniaxial strain, E'(1−ν)²/((1−2ν) d), on a rigid base; E'/d on a sliding one with free lateral strain."""
        if not self.needs_poisson:
            return 0.0
        nu = self.poisson or 0.0
        uniaxial = (1 - nu) ** 2 / (1 - 2 * nu) if periodic or self.base == "bonded" else 1.0
        return self.contact_modulus * uniaxial / self.thickness

    def open_table(self, grid: SlabGrid) -> np.ndarray:
        from pgfmd.physics.solids.open_kernel import kept_table, layer_table

        name = self.thickness, self.base, self.poisson if self.needs_poisson else None
        return kept_table(grid, name, lambda: layer_table(grid, self, self.thickness))

    def apply_compliance(self, grid: SlabGrid, dtype: DTypeLike, factor: float) -> ColumnAction:
        if math.isfinite(self.thickness) or not grid.domain.wraps:
            return super().apply_compliance(grid, dtype, factor)
        return _scale_by_q(grid, dtype, 2 * factor / self.contact_modulus * min(grid.spacing), divide=True)

    def apply_stiffness(self, grid: SlabGrid, dtype: DTypeLike, factor: float) -> ColumnAction:
        if math.isfinite(self.thickness) or not grid.domain.wraps:
            return super().apply_stiffness(grid, dtype, factor)
        return _scale_by_q(grid, dtype, factor * self.contact_modulus / 2 / min(grid.spacing), divide=False)


def _scale_by_q(grid: SlabGrid, dtype: DTypeLike, scale: float, divide: bool) -> ColumnAction:
    """Column action that multiplies by scale · |q|, or divides scale by |q|.  |q| is in units of the smaller spacing:
    then its square fits into single precision, whatever the unit of length.
    """
    from pgfmd.grid import kernels  # compiled code, which only a run needs

    real, step = np.dtype(dtype), min(grid.spacing)
    if (real, step) not in grid.tables:
        grid.tables[real, step] = [((waves * step) ** 2).astype(real) for waves in (grid.qx[0], grid.qy[:, 0])]
    qx_squared, qy_squared = grid.tables[real, step]
    with np.errstate(over="ignore"):  # then no pressure is certified
        factor = np.asarray(scale, real)[()]

    def act(block: np.ndarray, first: int, stop: int) -> None:
        parts = block.view(real).reshape(*block.shape, 2)
        kernels.scale_by_q(parts, qx_squared, qy_squared[first:stop], factor, divide)

    return act


def layer_factor(t: np.ndarray, shear_moduli: Pair, poisson: Pair) -> np.ndarray:
    """F(t) for t = q d > 0 of a layer bonded to a half-space, to some 5e-16 of its value; tends to 1 as t → ∞.

    Shear moduli, of which only the ratio r = μ₁/μ₂ counts, and Poisson's ratios of layer and half-space.  μ₁ = 0 is a
    layer on a rigid base, μ₂ = 0 one on nothing.  With k = 3 − 4ν, e = exp(−2t), m = (r − 1)/(r + k₁) and
    n = (r k₂ − k₁)/(r k₂ + 1):

        F = [(1 − me)(1 − ne) − 4mt²e] / [1 + 4mte − mne²]

    Here both are multiplied by (μ₁ + k₁μ₂)(μ₂ + k₂μ₁)/e, and are sums of terms that are not negative: those with
    (1 − e)² − 4t²e, 1 − m, 1 − n, and with 1 − e² − 4te, 1 + m, 1 − mn.
    """
    (upper, lower), (above, below) = shear_moduli, poisson
    one, two = upper + (3 - 4 * above) * lower, lower + (3 - 4 * below) * upper
    apart = 4 * (1 - above) * lower  # (1 − m) · one, or (1 − n) · two
    factor, inside = np.ones(np.shape(t)), t < THICK
    x = 2 * np.asarray(t)[inside]
    rise, near, both = np.exp(x), x < 2 * SERIES, 2 * one * two
    e = 1 / rise
    sinh, cosh = (rise - e) / 2 - x, (rise + e) / 2 - (1 + x * x / 2)
    sinh[near], cosh[near] = _tail(x[near], 3), _tail(x[near], 4)
    dividend = both * cosh + apart**2 * e + apart * two * x * x + 2 * apart * (one + two) * ((sinh + x) / (1 + rise))
    divisor = both * sinh + 4 * (upper + (1 - 2 * above) * lower) * two * x
    divisor += 16 * upper * lower * (1 - above) * (1 - below) * e
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        factor[inside] = dividend / divisor
    return factor


def _tail(x: np.ndarray, order: int) -> np.ndarray:
    """x^n/n! + x^(n+2)/(n+2)! + … with n = `order`: sinh x − x for order 3, cosh x − 1 − x²/2 for order 4."""
    square, total = x * x, np.ones_like(x)
    for n in range(order + 2 * TERMS, order, -2):
        total = 1 + square * (1 / (n * (n - 1))) * total
    return square * (x if order == 3 else square) / math.factorial(order) * total
