"""Periodic contact with a hard wall: exact solutions (wavy surface, strip punch), limits and a table (2-D sinusoid).

Heights h = Δ cos(2πx/λ) (Westergaard 1939; Johnson, Contact Mechanics, section 13.2, doi:10.1017/CBO9781139171731) and
h = Δ cos(2πx/λ) cos(2πy/λ) (Johnson, Greenwood & Higginson 1985, doi:10.1016/0020-7403(85)90029-3).
p̄ is the mean pressure over the cell, p* that at which contact becomes full, f = p̄/p*.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import xlogy

from pgfmd.theory import Reals


@dataclass(frozen=True)
class Westergaard:
    """Contact of h = Δ cos(2πx/λ): amplitude Δ and wavelength λ (lengths), contact modulus E' (pressure)."""

    amplitude: float
    wavelength: float
    contact_modulus: float

    @property
    def full_pressure(self) -> float:
        """p* = π E' Δ/λ."""
        return np.pi * self.contact_modulus * self.amplitude / self.wavelength

    def _f(self, mean_pressure: Reals) -> Reals:
        return np.clip(np.asarray(mean_pressure, float) / self.full_pressure, 0, 1)

    def contact_area(self, mean_pressure: Reals) -> np.ndarray:
        """Relative contact area (2/π) asin √f; 1 at and above p*."""
        return 2 / np.pi * np.arcsin(np.sqrt(self._f(mean_pressure)))

    def half_width(self, mean_pressure: Reals) -> np.ndarray:
        """Half-width c = (λ/π) asin √f of the contact strip."""
        return self.wavelength / 2 * self.contact_area(mean_pressure)

    def pressure(self, x: Reals, mean_pressure: float) -> np.ndarray:
        """Pressure at x (any shape; the crest is at x = 0), 0 outside contact; p̄ + p* cos(2πx/λ) in full contact."""
        phase = np.pi * np.asarray(x, float) / self.wavelength
        if mean_pressure >= self.full_pressure:
            return mean_pressure + self.full_pressure * np.cos(2 * phase)
        f = self._f(mean_pressure)
        if f == 0:
            return np.zeros_like(phase)
        root = np.sqrt(np.maximum(f - np.sin(phase) ** 2, 0))  # f = sin²(πc/λ)
        return 2 * self.full_pressure * np.abs(np.cos(phase)) * root

    def mean_gap(self, mean_pressure: Reals) -> np.ndarray:
        """Δ (1 − f + f ln f)."""
        f = self._f(mean_pressure)
        return self.amplitude * (1 - f + xlogy(f, f))

    def elastic_energy(self, mean_pressure: Reals) -> np.ndarray:
        """Energy per area p* Δ f² (1 − 2 ln f)/4, constant above p*."""
        f = self._f(mean_pressure)
        return self.full_pressure * self.amplitude * (f**2 - 2 * f * xlogy(f, f)) / 4


@dataclass(frozen=True)
class Sinusoid2D:
    """Contact of h = Δ cos(2πx/λ) cos(2πy/λ): known at both ends of the load range, and as a table between."""

    amplitude: float
    wavelength: float
    contact_modulus: float

    @property
    def full_pressure(self) -> float:
        """p* = √2 π E' Δ/λ."""
        return np.sqrt(2) * np.pi * self.contact_modulus * self.amplitude / self.wavelength

    def low_load_area(self, mean_pressure: Reals) -> np.ndarray:
        """Relative contact area π (3f/8π)^{2/3} of separate Hertzian contacts, two per cell λ²: the limit f → 0."""
        return np.pi * (3 * np.asarray(mean_pressure) / (8 * np.pi * self.full_pressure)) ** (2 / 3)

    def high_load_area(self, mean_pressure: Reals) -> np.ndarray:
        """Relative contact area 1 − (3/2π)(1 − f): the limit f → 1."""
        return 1 - 3 / (2 * np.pi) * (1 - np.asarray(mean_pressure) / self.full_pressure)


SINUSOID_2D_TABLE = np.array(
    [
        (0.01, 0.0363, 0.81829, 0.421, 0.003113),
        (0.1, 0.1905, 0.38475, 0.884, 0.06171),
        (0.2, 0.349, 0.20463, 1.096, 0.14465),
        (0.5, 0.704, 0.04508, 1.479, 0.44904),
        (0.9, 0.951, 0.00065, 1.900, 1.05888),
    ],
    dtype=[(name, float) for name in ("f", "area", "gap", "peak_pressure", "mean_square")],
)
"""f, A/A₀, gap/Δ, p_max/p*, ⟨p²⟩/p*² of the 2-D sinusoid, from an independent numerical solution to these digits (area
corrected for the pixel staircase; at f = 0.2, where contacts are about to merge, it is uncertain by 0.004)."""


@dataclass(frozen=True)
class StripPunch:
    """A flat punch of half-width c on every period λ of the half-space (lengths), contact modulus E' (pressure)."""

    half_width: float
    wavelength: float
    contact_modulus: float

    def pressure(self, x: Reals, mean_pressure: float) -> np.ndarray:
        """p̄ cos(πx/λ)/√(sin²(πc/λ) − sin²(πx/λ)) for |x| < c (x modulo λ), 0 outside; singular at the edge."""
        phase = np.pi * np.asarray(x, float) / self.wavelength
        under = np.sin(np.pi * self.half_width / self.wavelength) ** 2 - np.sin(phase) ** 2
        inside = under > 0
        return np.where(inside, mean_pressure * np.abs(np.cos(phase)) / np.sqrt(np.where(inside, under, 1)), 0.0)

    def approach(self, mean_pressure: Reals) -> np.ndarray:
        """Depth of the punch below the mean plane of the solid: −(2 p̄ λ/(π E')) ln sin(πc/λ)."""
        depth = -2 / np.pi * np.log(np.sin(np.pi * self.half_width / self.wavelength))
        return np.asarray(mean_pressure) * self.wavelength / self.contact_modulus * depth
