"""Bearing-area model: contact wherever a Gaussian surface rises above a height; no elasticity, no load.

The threshold is chosen to give the contact area of the elastic contact.  Lengths in any unit; arrays broadcast.
"""

import numpy as np
from scipy.special import ndtr, ndtri, owens_t

from pgfmd.theory import Reals


def area(threshold: Reals, h_rms: Reals) -> np.ndarray:
    """Fraction of a Gaussian surface of standard deviation `h_rms` above `threshold` (measured from the mean plane)."""
    return ndtr(-np.asarray(threshold) / h_rms)


def threshold(fraction: Reals, h_rms: Reals) -> np.ndarray:
    """The height above which lies the given fraction of a Gaussian surface."""
    return -h_rms * ndtri(fraction)


def autocorrelation(height_correlation: Reals, fraction: Reals) -> np.ndarray:
    """⟨Θ(r)Θ(r')⟩ of the bearing contact from ρ = ⟨h(r)h(r')⟩/⟨h²⟩: both heights of a Gaussian pair above threshold.

    P(X > t, Y > t) = Q(t) − 2 T(t, √((1−ρ)/(1+ρ))) with Owen's T function (1956), doi:10.1214/aoms/1177728074.
    It is `fraction` at ρ = 1 and fraction² at ρ = 0.
    """
    rho = np.clip(np.asarray(height_correlation, float), -1.0, 1.0)
    with np.errstate(divide="ignore"):  # ρ = −1 rightly gives T(t, ∞)
        ratio = np.sqrt((1 - rho) / (1 + rho))
    return fraction - 2 * owens_t(-ndtri(fraction), ratio)


def spectrum_exponent(hurst: float) -> float:
    """2 + H: the contact spectrum falls as q^−(2+H) between the cut-offs.

    Near r = 0 the autocorrelation falls by a cusp ∝ √(1 − ρ) ∝ r^H (doi:10.1088/0953-8984/23/21/215004).
    """
    return 2 + hurst


def patch_exponent(hurst: float) -> float:
    """τ = 2 − H/2 of the patch-size law P(a_c) ∝ a_c^−τ: the islands of a self-affine surface (Mandelbrot)."""
    return 2 - hurst / 2
