"""Field theory of an exponential wall, σ = σ_ref exp(−gap/ζ), to first order in the heights."""

import numpy as np

from pgfmd.theory import Reals


def response(q: Reals, mean_pressure: Reals, zeta: Reals, *, contact_modulus: Reals) -> np.ndarray:
    """G₁(q) = 1/(1 + ζ q E'/(2 p̄)), shape of q: the stress σ̃ = G₁ (E' q/2) h̃ of a mode that is small against ζ.

    Stiffness p̄/ζ of the wall in series with the stiffness E' q/2 of the solid; at ζ → 0 it is full contact.
    """
    return 1 / (1 + zeta * np.asarray(q) * contact_modulus / (2 * mean_pressure))


def stress_spectrum(q: Reals, power: Reals, mean_pressure: Reals, zeta: Reals, *, contact_modulus: Reals) -> np.ndarray:
    """|σ̃|² = G₁² (E' q/2)² |h̃|² per mode, shape (m,); `power` (m,) is |h̃|² of a mode."""
    full = (contact_modulus * np.asarray(q) / 2) ** 2 * power
    return response(q, mean_pressure, zeta, contact_modulus=contact_modulus) ** 2 * full
