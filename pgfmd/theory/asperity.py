"""Independent-asperity models of an isotropic Gaussian surface: Greenwood–Williamson and Bush–Gibson–Thomas.

Each model is a function of the separation d between the mean plane of the rough surface and the flat (a length, any
shape) and returns the relative contact area and the mean pressure in the same shape.  `at_pressure` inverts any.
"""

from collections.abc import Callable
from functools import cache

import numpy as np
from scipy.optimize import brentq
from scipy.special import ellipe, ellipkm1, elliprd, gamma, pbdv

from pgfmd.errors import InputError
from pgfmd.theory import Reals
from pgfmd.theory.surface import SpectralMoments

Model = Callable[[Reals, SpectralMoments, Reals], tuple[np.ndarray, np.ndarray]]
"""(separation, moments, contact modulus) → area fraction, mean pressure."""
LOW_LOAD_KAPPA_BGT = np.sqrt(2 * np.pi)
"""κ = f_c E' g/p̄ of Bush, Gibson & Thomas in the limit of low load, for any bandwidth."""


def greenwood_williamson(
    separation: Reals, moments: SpectralMoments, contact_modulus: Reals
) -> tuple[np.ndarray, np.ndarray]:
    """Area fraction and mean pressure of equal spherical summits with Gaussian heights.

    Greenwood & Williamson (1966), doi:10.1098/rspa.1966.0242, with density, radius and height distribution of the
    summits from the spectral moments as McCool (1986), doi:10.1016/0043-1648(86)90045-1, and Nayak (1971) give them.
    """
    std, radius = moments.summit_height_std, 1 / moments.summit_curvature
    scaled = (np.asarray(separation, float) - moments.summit_height) / std
    area = np.pi * moments.summit_density * radius * std * gaussian_excess(1, scaled)
    force = 4 / 3 * contact_modulus * np.sqrt(radius) * std**1.5 * gaussian_excess(1.5, scaled)
    return area, moments.summit_density * force


def gaussian_excess(order: float, threshold: Reals) -> np.ndarray:
    """∫_t^∞ (x − t)^n N(x; 0, 1) dx = Γ(n+1) e^(−t²/4) D_(−n−1)(t)/√(2π), D the parabolic cylinder function."""
    threshold = np.asarray(threshold, float)
    return gamma(order + 1) / np.sqrt(2 * np.pi) * np.exp(-(threshold**2) / 4) * pbdv(-order - 1, threshold)[0]


def bush_gibson_thomas(
    separation: Reals, moments: SpectralMoments, contact_modulus: Reals
) -> tuple[np.ndarray, np.ndarray]:
    """Area fraction and mean pressure of elliptic paraboloids with the joint statistics of height and both curvatures.

    Bush, Gibson & Thomas (1975), doi:10.1016/0043-1648(75)90145-3; summit statistics of Nayak (1971).  With t and r the
    mean and half the difference of the principal curvatures, summits have the density per area

        n(z, t, r) = N₂(z, t) (3r/m₄) exp(−3r²/(2m₄)) (t² − r²)/(2π m₂),   0 ≤ r < t,

    N₂ the Gaussian with variances m₀ and 2m₄/3 and covariance m₂.  Each summit higher than d is in Hertzian contact.
    The triple integral is done by Gauss–Legendre quadrature (relative error near 1e-12).

    :raises InputError: if Nayak's bandwidth parameter is below 3/2, which no isotropic surface has.
    """
    if moments.alpha < 1.5 * (1 - 1e-12):
        raise InputError(f"Nayak's parameter m0 m4/m2^2 = {moments.alpha:g}: must be at least 1.5")
    separation = np.asarray(separation, float)
    pairs = [_integrate_summits(float(d), moments, contact_modulus) for d in separation.ravel()]
    area, pressure = np.array(pairs, dtype=float).reshape(-1, 2).T
    return area.reshape(separation.shape), pressure.reshape(separation.shape)


def at_pressure(
    model: Model, pressure: Reals, moments: SpectralMoments, contact_modulus: Reals
) -> tuple[np.ndarray, np.ndarray]:
    """(area fraction, separation) where `model` carries the mean pressure, each in the pressure's shape.

    :raises InputError: if the pressure is not reached between separations of −10 and +30 rms heights.
    """
    h_rms = np.sqrt(moments.m0)

    def solve(target: float) -> tuple[np.ndarray, float]:
        def excess(d: float) -> float:
            return np.log(model(d, moments, contact_modulus)[1]) - np.log(target)

        if not excess(30 * h_rms) < 0 < excess(-10 * h_rms):
            raise InputError(f"pressure {target:g}: outside the range of the asperity model")
        d = brentq(excess, -10 * h_rms, 30 * h_rms, xtol=1e-12 * h_rms)
        return model(d, moments, contact_modulus)[0], d

    pressure = np.asarray(pressure, float)
    pairs = np.array([solve(target) for target in pressure.ravel()], dtype=float).reshape(-1, 2)
    return pairs[:, 0].reshape(pressure.shape), pairs[:, 1].reshape(pressure.shape)


def _integrate_summits(separation: float, moments: SpectralMoments, contact_modulus: float) -> tuple[float, float]:
    """Area fraction and pressure at one separation: over z beyond d, over t given z, over r given t."""
    m0, m2, m4 = moments.m0, moments.m2, moments.m4
    nodes, weights = np.polynomial.legendre.leggauss(80)
    # Heights up to where exp(−z²/2m₀) has fallen to 1e-20 of its largest value; z = d + x², so
    # that (z − d)^{3/2} is smooth in x.  A break at z = 0, where summits set in as α → 3/2.
    top = np.sqrt(92 * m0 + max(separation, 0) ** 2)
    breaks = np.sqrt(np.array([separation, top] if separation >= 0 else [separation, 0, top]) - separation)
    half = np.diff(breaks)[:, None] / 2
    root = (breaks[:-1, None] + half * (1 + nodes)).ravel()
    excess = root**2
    z = separation + excess
    height_weight = (half * weights).ravel() * 2 * root * np.exp(-(z**2) / (2 * m0)) / np.sqrt(2 * np.pi * m0)
    # Curvature t given z: mean z m₂/m₀, variance 2m₄/3 − m₂²/m₀ (zero at α = 3/2), t > 0.
    mean = z * m2 / m0
    std = np.sqrt(max(2 * m4 / 3 - m2**2 / m0, 1e-24 * m4))
    low = np.clip(-mean / std, -9.5, 9.5)[:, None]
    scaled = low + (9.5 - low) * (1 + nodes) / 2
    # At α = 3/2 (std → 0) no t > 0 is left below the mean plane; its weight is zero, its value must only be valid.
    curvature = np.maximum(mean[:, None] + std * scaled, 1e-12 * np.sqrt(m4))
    curvature_weight = weights * (9.5 - low) / 2 * np.exp(-(scaled**2) / 2) / np.sqrt(2 * np.pi)

    ratio, ratio_weight, area_factor, load_factor = _ellipse_table()
    # ∫ dr over r = ρt: t⁴ (3/m₄) ρ (1 − ρ²) exp(−3 ρ² t²/(2 m₄)) × factor of the ellipse
    squared = (1.5 / m4) * curvature[..., None] ** 2
    shape = np.exp(-squared * ratio**2) * (ratio * (1 - ratio**2) * ratio_weight)
    density = 2 * squared[..., 0] * curvature**2 / (2 * np.pi * m2) * curvature_weight
    area = np.pi * np.sum((height_weight * excess)[:, None] * density / curvature * (shape @ area_factor))
    force = np.sum((height_weight * excess**1.5)[:, None] * density / np.sqrt(curvature) * (shape @ load_factor))
    return area, 2 * np.pi / 3 * contact_modulus * force


@cache
def _ellipse_table() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Nodes ρ = r/t, their weights, and Hertzian area and load over those of a sphere of curvature t.

    With b/a = k and e² = 1 − k² the axes of the contact ellipse (Johnson, Contact Mechanics, section 4.2), at
    penetration δ: area = π(δ/t) E/(k K), load = (2π/3) E' √(δ³/t) √E/(k K^{3/2}), and ρ = (E(1 + k²) − 2k²K)/(e²E). The
    integral runs over v with k = v², since ρ → 1 (k → 0) has a logarithm.
    """
    nodes, weights = np.polynomial.legendre.leggauss(96)
    v = (1 + nodes) / 2
    k2 = v**4
    m = 1 - k2
    first, second = ellipkm1(k2), ellipe(m)
    d = elliprd(0, k2, 1) / 3  # (K − E)/e² without cancellation at e = 0
    ratio = (first - (1 + k2) * d) / second
    slope = 1.5 * d / second + ratio * d / (2 * second) - ratio / m  # dρ/dm
    area_factor = second / (v**2 * first)
    load_factor = np.sqrt(second) / (v**2 * first**1.5)
    return ratio, slope * 4 * v**3 * weights / 2, area_factor, load_factor
