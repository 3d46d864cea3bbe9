"""Persson's theory of contact between a flat elastic solid and a Gaussian rough surface.

Scale by scale the pressure diffuses, with an absorbing wall at zero: Persson, J. Chem. Phys. 115, 3840 (2001),
doi:10.1063/1.1388626.  `std` is the standard deviation s = E' g/2 that the pressure would have in full contact, g the
rms slope.  Pressures in any unit; arrays broadcast.  Spectra as in the package docstring.
"""

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import erf, erfinv, exp1, ndtr

from pgfmd.theory import Reals

LOW_LOAD_KAPPA = np.sqrt(8 / np.pi)
"""κ = f_c E' g/p̄ in the limit of low load."""


def full_contact_std(contact_modulus: Reals, rms_slope: Reals) -> Reals:
    """Standard deviation E' g/2 of the pressure in full contact."""
    return np.multiply(contact_modulus, rms_slope) / 2


def contact_fraction(mean_pressure: Reals, std: Reals) -> np.ndarray:
    """f = erf(p̄/(√2 s)), the relative contact area; s = 0 (a flat surface) is in full contact at any load p̄ > 0."""
    mean_pressure, std = np.broadcast_arrays(np.asarray(mean_pressure, float), np.asarray(std, float))
    flat = std == 0
    return np.where(flat, mean_pressure > 0, erf(mean_pressure / (np.sqrt(2) * np.where(flat, 1, std))))


def kappa(mean_pressure: Reals, std: Reals) -> np.ndarray:
    """κ = f E' g/p̄ = 2 s f/p̄ at a finite load."""
    return 2 * np.asarray(std) * contact_fraction(mean_pressure, std) / mean_pressure


def load_for_area(fraction: Reals, std: Reals) -> np.ndarray:
    """The mean pressure at which `contact_fraction` is `fraction` (infinite for 1)."""
    return np.sqrt(2) * np.asarray(std) * erfinv(fraction)


def pressure_density(pressure: Reals, mean_pressure: Reals, std: Reals) -> np.ndarray:
    """P(σ) = N(σ; p̄, s) − N(σ; −p̄, s) for σ > 0, else 0; the missing weight 1 − f sits in a delta function at σ = 0."""
    pressure = np.asarray(pressure, float)
    gauss = np.exp(-((pressure - mean_pressure) ** 2) / (2 * std**2)) / (np.sqrt(2 * np.pi) * std)
    # The image Gaussian is gauss · exp(−2 p̄ σ/s²); expm1 keeps the difference exact at low load.
    return np.where(pressure > 0, -gauss * np.expm1(-2 * mean_pressure * np.maximum(pressure, 0) / std**2), 0.0)


def exceedance(pressure: Reals, mean_pressure: Reals, std: Reals) -> np.ndarray:
    """Fraction of the surface where σ > `pressure` ≥ 0; its value at 0 is the contact area."""
    pressure = np.asarray(pressure, float)
    return ndtr((mean_pressure - pressure) / std) - ndtr(-(mean_pressure + pressure) / std)


def mean_square(mean_pressure: Reals, std: Reals) -> np.ndarray:
    """⟨σ²⟩ over the whole surface, (s² + p̄²) f + √(2/π) s p̄ exp(−p̄²/2s²)."""
    mean_pressure, std = np.asarray(mean_pressure, float), np.asarray(std, float)
    tail = np.sqrt(2 / np.pi) * std * mean_pressure * np.exp(-((mean_pressure / std) ** 2) / 2)
    return (std**2 + mean_pressure**2) * contact_fraction(mean_pressure, std) + tail


def normalised_second_moment(mean_pressure: Reals, std: Reals) -> np.ndarray:
    """m₂ = ⟨σ²⟩_c/σ_c², means over the contact, σ_c = p̄/f: 4/π at low load, tending to 1 at high load."""
    return mean_square(mean_pressure, std) * contact_fraction(mean_pressure, std) / np.square(mean_pressure)


def fit_std(edges: Reals, density: Reals, mean_pressure: Reals) -> float:
    """The s for which P(σ) at the given mean pressure is nearest to a histogram: edges (m+1,), density (m,).

    Least squares of the density, each bin weighted with its width; theory is averaged over the bins.  The density is
    normalised to the contact area, not to 1, and bins must start at or above zero.
    """
    edges, density = np.asarray(edges, float), np.asarray(density, float)
    widths = np.diff(edges)

    def misfit(log_std: Reals) -> Reals:
        model = -np.diff(exceedance(edges, mean_pressure, np.exp(log_std))) / widths
        return np.sum(widths * (model - density) ** 2)

    # The measured second moment brackets s within a factor that covers any histogram with one peak.
    guess = np.log(np.sqrt(np.sum(widths * density * ((edges[1:] + edges[:-1]) / 2) ** 2) / np.sum(widths * density)))
    grid = guess + np.linspace(-4, 4, 81)
    best = grid[np.argmin([misfit(at) for at in grid])]
    return float(
        np.exp(minimize_scalar(misfit, bounds=(best - 0.1, best + 0.1), method="bounded", options={"xatol": 1e-12}).x)
    )


def cumulative_slope(q: Reals, power: Reals, count: Reals = 1) -> np.ndarray:
    """g(q), the rms slope of all modes up to and including q, shape (m,): g² = Σ_{q' ≤ q} q'² |h̃|²."""
    return np.sqrt(np.cumsum(np.square(q) * power * count))


def scale_contact_fraction(
    mean_pressure: Reals, q: Reals, power: Reals, count: Reals = 1, *, contact_modulus: Reals
) -> np.ndarray:
    """f(q) = erf(√2 p̄/(E' g(q))), shape (m,): the contact area seen when roughness beyond q is ignored."""
    return contact_fraction(mean_pressure, contact_modulus * cumulative_slope(q, power, count) / 2)


def full_contact_spectrum(q: Reals, power: Reals, *, contact_modulus: Reals) -> np.ndarray:
    """|σ̃|² = (E' q/2)² |h̃|² per mode in full contact, shape (m,)."""
    return (contact_modulus * np.asarray(q) / 2) ** 2 * power


def energy_factor(fraction: Reals, gamma: Reals = 1.0) -> np.ndarray:
    """S(f) = γ + (1 − γ) f²: what contact regions of a partial contact carry relative to full contact.

    γ = 1 is Persson's first theory.  Yang & Persson (2008), doi:10.1088/0953-8984/20/21/215214, give the form; values
    of γ fitted to simulations lie near 0.4 … 0.5.
    """
    return gamma + (1 - gamma) * np.square(fraction)


def stress_spectrum(
    mean_pressure: Reals, q: Reals, power: Reals, count: Reals = 1, *, contact_modulus: Reals, gamma: Reals = 1.0
) -> np.ndarray:
    """|σ̃(q)|² = (E' q/2)² |h̃|² f(q) S(f(q)) per mode, shape (m,); γ = 1 (S = 1) is the plain theory."""
    fraction = scale_contact_fraction(mean_pressure, q, power, count, contact_modulus=contact_modulus)
    full = full_contact_spectrum(q, power, contact_modulus=contact_modulus)
    return full * fraction * energy_factor(fraction, gamma)


def elastic_energy(
    mean_pressure: Reals, q: Reals, power: Reals, count: Reals = 1, *, contact_modulus: Reals, gamma: Reals = 1.0
) -> float:
    """Energy per area (E'/4) Σ q |h̃|² f S(f), from the stress spectrum and the compliance 2/(E' q).

    Persson (2007), doi:10.1103/PhysRevLett.99.125502.  Each line enters at the middle of its own share of g², so that a
    sum over lines converges to the integral with the square of their width.
    """
    fraction = contact_fraction(mean_pressure, _middle_std(q, power, count, contact_modulus))
    weights = contact_modulus / 4 * np.asarray(q) * power * count
    return float(np.sum(weights * fraction * energy_factor(fraction, gamma)))


def mean_gap(
    mean_pressure: Reals, q: Reals, power: Reals, count: Reals = 1, *, contact_modulus: Reals, gamma: Reals = 1.0
) -> float:
    """Mean gap ∫_p̄^∞ (dE/dp)/p dp of `elastic_energy`, since dE/dp̄ = −p̄ dū/dp̄ and the gap closes at infinite load.

    With x = p/(√2 s) a mode contributes ∫ [γ + 3(1−γ) erf²x] (2/√π) exp(−x²) dx/x; the part with γ is E₁(x²)/√π.
    Persson (2007) and Yang & Persson (2008), see above.
    """
    std = _middle_std(q, power, count, contact_modulus)
    weights = contact_modulus / 4 * np.asarray(q) * power * count
    rough = std > 0  # lines below the lowest wave number of the surface add nothing
    std, weights = std[rough], weights[rough]
    start = mean_pressure / (np.sqrt(2) * std)
    integral = gamma * exp1(start**2) / np.sqrt(np.pi)
    if gamma != 1:
        integral = integral + 3 * (1 - gamma) * _erf_square_integral(start)
    return float(np.sum(weights * integral / (np.sqrt(2) * std)))


def _middle_std(q: Reals, power: Reals, count: Reals, contact_modulus: Reals) -> Reals:
    share = np.square(q) * power * count
    return contact_modulus / 2 * np.sqrt(np.cumsum(share) - share / 2)


def _erf_square_integral(start: Reals) -> Reals:
    """∫_start^∞ erf²x (2/√π) exp(−x²) dx/x; exp(−x²) is below 1e-21 at x = 7.  The integrand is smooth."""
    nodes, weights = np.polynomial.legendre.leggauss(64)
    start = np.minimum(start, 7.0)
    half = (7.0 - start)[..., None] / 2
    x = 7.0 - half * (1 - nodes)
    return np.sum(half * weights * erf(x) ** 2 * 2 / np.sqrt(np.pi) * np.exp(-(x**2)) / x, axis=-1)
