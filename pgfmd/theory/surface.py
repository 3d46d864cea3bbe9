"""The ideal isotropic self-affine surface in the continuum, and the spectral moments that asperity models need."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import exprel

from pgfmd.errors import InputError
from pgfmd.theory import Reals


@dataclass(frozen=True)
class SelfAffineSpectrum:
    """The isotropic power spectrum of `surfaces.self_affine`: constant for 2π/λ_l ≤ q < 2π/λ_r, ∝ q^(−2(1+H)) up to
    2π/λ_s, zero elsewhere.

    Lengths in any unit.  Without `lambda_r` there is no plateau.  The spectrum is scaled to the rms slope √⟨|∇h|²⟩.

    :raises InputError: unless 0 < λ_s < λ_l, λ_s ≤ λ_r ≤ λ_l, and the slope is positive and finite.
    """

    hurst: float
    lambda_s: float
    lambda_l: float
    rms_slope: float
    lambda_r: float | None = None

    def __post_init__(self) -> None:
        if not 0 < self.lambda_s < self.lambda_l < np.inf:
            raise InputError(f"lambda_s = {self.lambda_s:g}: must be positive and below lambda_l = {self.lambda_l:g}")
        if self.lambda_r is not None and not self.lambda_s <= self.lambda_r <= self.lambda_l:
            raise InputError(f"lambda_r = {self.lambda_r:g}: must lie between lambda_s and lambda_l")
        if not 0 < self.rms_slope < np.inf:
            raise InputError(f"rms_slope = {self.rms_slope:g}: must be positive and finite")

    @property
    def q_limits(self) -> tuple[float, float, float]:
        """Lowest wave number, end of the plateau, highest wave number (radians per length)."""
        roll_off = self.lambda_l if self.lambda_r is None else self.lambda_r
        return 2 * np.pi / self.lambda_l, 2 * np.pi / roll_off, 2 * np.pi / self.lambda_s

    @property
    def _scale(self) -> float:
        """C at the end of the plateau (length⁴)."""
        return self.rms_slope**2 / self._unscaled_moment(2, *self.q_limits[::2])

    def density(self, q: Reals) -> np.ndarray:
        """C(q) with ⟨h²⟩ = ∫ C d²q, shape of `q` (length⁴); one mode of a cell of area A₀ has ⟨|h̃|²⟩ = (2π)² C/A₀."""
        low, roll_off, high = self.q_limits
        q = np.asarray(q, dtype=float)
        inside = (q >= low) & (q <= high)
        return self._scale * np.where(inside, (np.maximum(q, roll_off) / roll_off) ** (-2 * (1 + self.hurst)), 0.0)

    def moment(self, order: float, q_low: Reals = 0.0, q_high: Reals = np.inf) -> np.ndarray:
        """∫ q^order C d²q over q_low ≤ q ≤ q_high: order 0 is h_rms², 2 is the squared rms slope.  Arrays broadcast."""
        return self._scale * self._unscaled_moment(order, q_low, q_high)

    def lines(self, count: int = 2000) -> tuple[np.ndarray, np.ndarray]:
        """The spectrum as `count` lines (q, variance), each of shape (count,), for the sums of the other modules.

        One line for each of `count` equal steps of ln q, with the exact ⟨h²⟩ and ⟨|∇h|²⟩ of its step.
        """
        edges = np.geomspace(*self.q_limits[::2], count + 1)
        height = self.moment(0, edges[:-1], edges[1:])
        slope = self.moment(2, edges[:-1], edges[1:])
        return np.sqrt(slope / height), height

    def moments(self) -> SpectralMoments:
        """m₀, m₂, m₄ of the surface."""
        return SpectralMoments.from_radial(*(float(self.moment(order)) for order in (0, 2, 4)))

    def _unscaled_moment(self, order: Reals, q_low: Reals, q_high: Reals) -> Reals:
        low, roll_off, high = self.q_limits
        start, stop = np.maximum(q_low, low), np.minimum(q_high, high)
        plateau = _power_integral(order + 1, np.minimum(start, roll_off), np.minimum(stop, roll_off))
        decay = 2 * (1 + self.hurst)
        decaying = _power_integral(order + 1 - decay, np.maximum(start, roll_off), np.maximum(stop, roll_off))
        return 2 * np.pi * (plateau + decaying * roll_off**decay)


def _power_integral(exponent: Reals, start: Reals, stop: Reals) -> Reals:
    """∫ q^exponent dq, zero where stop ≤ start; accurate also at and near exponent = −1, where it is a logarithm."""
    logarithm = np.log(np.maximum(stop, start) / start)
    return start ** (exponent + 1) * logarithm * exprel((exponent + 1) * logarithm)


@dataclass(frozen=True)
class SpectralMoments:
    """m₀ = ⟨h²⟩, m₂ = ⟨h_x²⟩, m₄ = ⟨h_xx²⟩ of an isotropic Gaussian surface (Nayak 1971, doi:10.1115/1.3451608)."""

    m0: float
    m2: float
    m4: float

    @classmethod
    def from_radial(cls, height: float, slope: float, curvature: float) -> SpectralMoments:
        """From ⟨q⁰⟩, ⟨q²⟩, ⟨q⁴⟩ of the 2-D spectrum: directional averages give 1, 1/2 and 3/8."""
        return cls(height, slope / 2, 3 * curvature / 8)

    @classmethod
    def from_spectrum(cls, q: Reals, power: Reals, count: Reals = 1) -> SpectralMoments:
        """From a radial spectrum: `power` (m,) is the mean |h̃|² of each of `count` (m,) modes at q (m,)."""
        q, variance = np.asarray(q, dtype=float), np.asarray(power, dtype=float) * count
        return cls.from_radial(*(float(np.sum(q**order * variance)) for order in (0, 2, 4)))

    @property
    def alpha(self) -> float:
        """Nayak's bandwidth parameter m₀m₄/m₂², at least 3/2."""
        return self.m0 * self.m4 / self.m2**2

    @property
    def rms_slope(self) -> float:
        """√⟨|∇h|²⟩."""
        return np.sqrt(2 * self.m2)

    @property
    def summit_density(self) -> float:
        """Summits per unit area, m₄/(6π√3 m₂)."""
        return self.m4 / (6 * np.pi * np.sqrt(3) * self.m2)

    @property
    def summit_curvature(self) -> float:
        """Mean curvature of a summit, averaged over summits: (8/3)√(m₄/π)."""
        return 8 / 3 * np.sqrt(self.m4 / np.pi)

    @property
    def summit_height(self) -> float:
        """Mean height of the summits above the mean plane, 4√(m₀/(πα))."""
        return 4 * np.sqrt(self.m0 / (np.pi * self.alpha))

    @property
    def summit_height_std(self) -> float:
        """Standard deviation of the summit heights, √(m₀(1 − (1 + 16/π − 3√3)/α)); the bracket is 0.8968."""
        return np.sqrt(self.m0 * (1 - (1 + 16 / np.pi - 3 * np.sqrt(3)) / self.alpha))
