"""Elastic response of a half-space or slab to normal pressure, mode by mode.

Half-space: p̃(q) = (E'/2) q ũ(q).  Slab of thickness d, with t = q d: p̃ = (E'/2) q F(t) ũ, for three ways to hold
its base (closed forms of plane-strain elasticity; see `Elasticity.slab_factor`).  The mean mode q = 0 is apart: at
imposed load it only shifts the surface as a whole.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import DTypeLike

from pgfmd.errors import InputError
from pgfmd.grid import kernels
from pgfmd.grid.callbacks import ColumnAction
from pgfmd.grid.slab_grid import SlabGrid

BASES = ("bonded", "free", "sliding")
SERIES, TERMS = 1.0, 10  # t below which series take over, and their terms after the first: the next is below 1e-17


@dataclass(frozen=True)
class Elasticity:
    """Contact modulus E' = E/(1−ν²), and for a slab its thickness, base and Poisson's ratio.  On a bonded base all of
    the response depends on Poisson's ratio, on a sliding one only the mean stiffness.
    """

    contact_modulus: float
    thickness: float = math.inf
    base: str = "bonded"
    poisson: float = 0.25

    def __post_init__(self) -> None:
        if not (self.contact_modulus > 0 and math.isfinite(self.contact_modulus)):
            raise InputError(f"contact_modulus = {self.contact_modulus!r}: must be positive and finite")
        if not self.thickness > 0:
            raise InputError(f"thickness = {self.thickness!r}: must be positive (inf for a half-space)")
        if self.base not in BASES:
            raise InputError(f"base = {self.base!r}: must be one of {', '.join(BASES)}")
        if not -1 < self.poisson < 0.5:
            raise InputError(f"poisson = {self.poisson!r}: must lie between -1 and 0.5, both excluded")

    def in_units(self, height: float, pressure: float) -> Elasticity:
        """The same solid where displacements and pressures count in these units (wave numbers are as they were)."""
        return dataclasses.replace(self, contact_modulus=self.contact_modulus * height / pressure)

    def slab_factor(self, t: np.ndarray) -> np.ndarray:
        """F(t) for t = q d > 0; tends to 1 as t → ∞.

            bonded     (k cosh 2t + 2t² + 5 − 4ν(3 − 2ν)) / (k sinh 2t − 2t),   k = 3 − 4ν
            free       (cosh 2t − 1 − 2t²) / (sinh 2t + 2t)
            sliding    (sinh 2t + 2t) / (cosh 2t − 1)

        Numerators and denominators are multiplied by e = exp(−2t), so that nothing overflows; series take over where
        terms of order 1 cancel.  So the relative error stays below 1e-15.
        """
        t = np.minimum(np.asarray(t, dtype=np.float64), 50.0)  # where F is 1, and nothing overflows
        e = np.exp(-2 * t)
        rise = -np.expm1(-2 * t)  # 1 − e
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            if self.base == "bonded":
                k = 3 - 4 * self.poisson
                # k sinh 2t − 2t = k (sinh 2t − 2t) + 2t (k − 1), and k − 1 = 2(1 − 2ν) is exact where it is small.
                divisor = k * _with_tail(rise * (1 + e) / 2 - 2 * t * e, t, e, 3)
                divisor = divisor + 2 * (1 - 2 * self.poisson) * 2 * t * e
                dividend = k * (1 + e * e) / 2 + (2 * t * t + 5 - 4 * self.poisson * (3 - 2 * self.poisson)) * e
            elif self.base == "free":
                dividend = _with_tail(rise**2 / 2 - 2 * t * t * e, t, e, 4)
                divisor = rise * (1 + e) / 2 + 2 * t * e
            else:
                dividend, divisor = rise * (1 + e) / 2 + 2 * t * e, rise**2 / 2
            return dividend / divisor

    def mean_stiffness(self) -> float:
        """dp̄/dū of the mean mode (pressure per length): that of uniaxial strain, E'(1−ν)²/((1−2ν) d), over a rigid
        base; else 0.

        A frictionless base with free lateral strain would be softer; the cell is periodic, which forbids lateral
        strain.
        """
        if math.isinf(self.thickness) or self.base == "free":
            return 0.0
        return self.contact_modulus * (1 - self.poisson) ** 2 / (1 - 2 * self.poisson) / self.thickness

    def stiffness(self, q: np.ndarray) -> np.ndarray:
        """(E'/2) q F(q d): pressure per displacement of the modes |q| > 0, and 0 at q = 0; the shape of `q`
        (rad/length).
        """
        q = np.asarray(q, dtype=np.float64)
        if math.isinf(self.thickness):
            return self.half_space_stiffness(q)
        factor = self.slab_factor(np.where(q > 0, q * self.thickness, 1.0))
        return self.half_space_stiffness(q) * factor

    def half_space_stiffness(self, q: np.ndarray) -> np.ndarray:
        """(E'/2) q, that of a half-space of the same contact modulus."""
        return 0.5 * self.contact_modulus * q

    def half_space_compliance(self, q: np.ndarray) -> np.ndarray:
        """1/half_space_stiffness, for q > 0."""
        return 1 / self.half_space_stiffness(q)

    def compliance(self, q: np.ndarray) -> np.ndarray:
        """1/stiffness, and 0 at q = 0."""
        stiffness = self.stiffness(q)
        return np.divide(1.0, stiffness, out=np.zeros_like(stiffness), where=stiffness > 0)

    def apply_compliance(self, grid: SlabGrid, dtype: DTypeLike, factor: float) -> ColumnAction:
        """Column action p̃ ← factor · compliance(q) · p̃ in the given precision."""
        if math.isinf(self.thickness):
            scale = 2 * factor / self.contact_modulus * min(grid.spacing)
            return _scale_by_q(grid, dtype, scale, divide=True)
        return multiply(grid, dtype, lambda q: factor * self.compliance(q))

    def apply_stiffness(self, grid: SlabGrid, dtype: DTypeLike, factor: float) -> ColumnAction:
        """Column action ũ ← factor · stiffness(q) · ũ in the given precision."""
        if math.isinf(self.thickness):
            scale = factor * self.contact_modulus / 2 / min(grid.spacing)
            return _scale_by_q(grid, dtype, scale, divide=False)
        return multiply(grid, dtype, lambda q: factor * self.stiffness(q))


def _scale_by_q(grid: SlabGrid, dtype: DTypeLike, scale: float, divide: bool) -> ColumnAction:
    """Column action that multiplies by scale · |q|, or divides by |q|, in units of the smaller spacing: |q|² then fits
    into single precision whatever the unit of length is.
    """
    real, step = np.dtype(dtype), min(grid.spacing)
    qx_squared, qy_squared = (((waves * step) ** 2).astype(real) for waves in (grid.qx[0], grid.qy[:, 0]))
    factor = np.asarray(scale, real)[()]

    def act(block: np.ndarray, first: int, stop: int) -> None:
        parts = block.view(real).reshape(*block.shape, 2)
        kernels.scale_by_q(parts, qx_squared, qy_squared[first:stop], factor, divide)

    return act


def multiply(grid: SlabGrid, dtype: DTypeLike, function: Callable[[np.ndarray], np.ndarray]) -> ColumnAction:
    """Column action that multiplies each mode by `function(|q|)`."""
    real = np.dtype(dtype)

    def action(block: np.ndarray, first: int, stop: int) -> None:
        with np.errstate(over="ignore", invalid="ignore"):  # an iteration that diverges ends at such numbers
            block *= function(np.sqrt(grid.q_squared(first, stop))).astype(real)

    return action


def _with_tail(far: np.ndarray, t: np.ndarray, e: np.ndarray, order: int) -> np.ndarray:
    """`far`; but where t < `SERIES`, e times x^n/n! + x^(n+2)/(n+2)! + … with x = 2t and n = `order`: sinh x − x for
    order 3, cosh x − 1 − x²/2 for order 4.
    """
    found, near = np.atleast_1d(far), np.atleast_1d(t < SERIES)
    x = 2 * np.atleast_1d(t)[near]
    total = np.ones_like(x)
    for n in range(order + 2 * TERMS, order, -2):
        total = 1 + x * x / (n * (n - 1)) * total
    found[near] = x**order / math.factorial(order) * total * np.atleast_1d(e)[near]
    return found.reshape(np.shape(t))
