"""Hertz: a rigid paraboloid r²/(2R) on an elastic half-space, alone and repeated on a square cell.

Hertz (1881), doi:10.1515/crll.1882.92.156; Johnson, Contact Mechanics, chapter 4, doi:10.1017/CBO9781139171731.
"""

from typing import NamedTuple

import numpy as np

from pgfmd.theory import Reals

# Σ' |n|^−1 (continued analytically: a neutralising background) and Σ' |n|^−3 over the square lattice without its
# origin, 4 ζ(s) β(s) at s = 1/2 and 3/2 (β is Dirichlet's).
LATTICE_SUM_1 = -3.9002649200019559
LATTICE_SUM_3 = 9.0336216831009503


class HertzContact(NamedTuple):
    """Contact radius, peak pressure, and approach (on a periodic cell: below the mean plane of the deformed solid)."""

    radius: float
    peak_pressure: float
    approach: float


def contact(load: Reals, tip_radius: Reals, *, contact_modulus: Reals) -> HertzContact:
    """The free asperity under the force `load`: a³ = 3 P R/(4E'), p₀ = 3P/(2πa²), approach a²/R.  Arrays broadcast."""
    radius = np.cbrt(3 * np.asarray(load) * tip_radius / (4 * contact_modulus))
    return HertzContact(radius, 2 * contact_modulus * radius / (np.pi * tip_radius), radius**2 / tip_radius)


def periodic_contact(load: Reals, tip_radius: Reals, cell: Reals, *, contact_modulus: Reals) -> HertzContact:
    """The same on a square lattice of period `cell` (length), to third order in radius/cell.

    The images shift the solid by a constant, ∝ Σ'|n|^−1, and bend it as the paraboloid r² Σ'|n|^−3/(4 cell³) does,
    which stiffens the asperity.  With a_H the free radius: radius a_H[1 − 0.63900 (a_H/L)³], peak pressure p_H[1 +
    1.27800 (…)³], approach (a_H²/R)[1 − 1.65534 a_H/L + 1.02240 (…)³].  The next order is the fifth.
    """
    free = contact(load, tip_radius, contact_modulus=contact_modulus)
    ratio = free.radius / cell
    shift = -4 * LATTICE_SUM_1 / (3 * np.pi)
    bend = 2 * LATTICE_SUM_3 / (3 * np.pi)
    # In the approach, a²/R with the radius and the curvature (1 + bend ratio³)/R that the images leave gives bend/3;
    # the pressure of an image, which is spread over ⟨r²⟩ = 2a²/5, adds bend/5.
    return HertzContact(
        free.radius * (1 - bend / 3 * ratio**3),
        free.peak_pressure * (1 + 2 * bend / 3 * ratio**3),
        free.approach * (1 - shift * ratio + bend * (1 / 3 + 1 / 5) * ratio**3),
    )


def pressure(r: Reals, radius: Reals, peak_pressure: Reals) -> Reals:
    """p₀ √(1 − r²/a²) inside the contact, 0 outside; shape of r."""
    return peak_pressure * np.sqrt(np.maximum(1 - (np.asarray(r) / radius) ** 2, 0))


def elastic_energy(load: Reals, tip_radius: Reals, *, contact_modulus: Reals) -> Reals:
    """Energy of the free contact, (2/5) P × approach."""
    return 0.4 * np.asarray(load) * contact(load, tip_radius, contact_modulus=contact_modulus).approach


def patch_area(load: Reals, tip_radius: Reals, *, contact_modulus: Reals) -> Reals:
    """a_c = π (3 R l_c/(4E'))^{2/3}, the area of one patch that carries the force l_c."""
    return np.pi * contact(load, tip_radius, contact_modulus=contact_modulus).radius ** 2


def radius_from_second_moment(second_moment: Reals) -> Reals:
    """Contact radius from the pressure-weighted ⟨r²⟩ = 2a²/5: far more accurate than counting pixels."""
    return np.sqrt(2.5 * np.asarray(second_moment))
