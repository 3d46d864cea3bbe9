"""Adhesion of a rigid paraboloid r²/(2R) to an elastic half-space, and a criterion by which rough surfaces adhere.

Johnson, Kendall and Roberts 1971, doi:10.1098/rspa.1971.0141 (JKR); Derjaguin, Muller and Toporov 1975,
doi:10.1016/0021-9797(75)90018-1 (DMT); Maugis 1992, doi:10.1016/0021-9797(92)90285-T.
"""

import math
from typing import NamedTuple

import numpy as np

# Pull-off force over πwR against μ_T, for a hard wall with the energy −w exp(−g/ρ), by an axisymmetric solution on two
# grids; Maugis' theory with λ = .70 μ_T is within .9 % of it.
TRANSITION = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 3.0, 5.0)
PULL_OFF = (1.9960, 1.9820, 1.9595, 1.9053, 1.7780, 1.6642, 1.5746, 1.5415, 1.517)
EXPONENTIAL = 0.70  # Maugis' λ over μ_T for that attraction; for a constant traction w/ρ it is (9/2π)^(1/3)
CONSTANT = (9 / (2 * math.pi)) ** (1 / 3)


class Curve(NamedTuple):
    """Force (negative: tension) and approach beyond first contact as functions of the contact radius."""

    radius: np.ndarray
    force: np.ndarray
    approach: np.ndarray


def transition(work: float, reach: float, radius: float, contact_modulus: float) -> float:
    """μ_T = (R w²/(E'² ρ³))^(1/3) with ρ the reach of the attraction: JKR for large values, DMT for small ones."""
    return float(np.cbrt(radius / reach) * np.cbrt(work / contact_modulus / reach) ** 2)


def pull_off(mu: float) -> float:
    """Pull-off force over πwR under the attraction −w exp(−g/ρ): the table, interpolated in ln μ_T."""
    return float(np.interp(math.log(mu), np.log(TRANSITION), PULL_OFF))


def jkr(contact_radius: np.ndarray, work: float, radius: float, contact_modulus: float) -> Curve:
    """P = 4E'a³/3R − √(8πwE'a³), δ = a²/R − √(2πwa/E')."""
    a = np.asarray(contact_radius)
    force = 4 * contact_modulus * a**3 / (3 * radius) - np.sqrt(8 * math.pi * work * contact_modulus * a**3)
    return Curve(a, force, a**2 / radius - np.sqrt(2 * math.pi * work * a / contact_modulus))


def dmt(contact_radius: np.ndarray, work: float, radius: float, contact_modulus: float) -> Curve:
    """P = 4E'a³/3R − 2πwR, δ = a²/R."""
    a = np.asarray(contact_radius)
    return Curve(a, 4 * contact_modulus * a**3 / (3 * radius) - 2 * math.pi * work * radius, a**2 / radius)


def maugis(contact_radius: np.ndarray, parameter: float, work: float, radius: float, contact_modulus: float) -> Curve:
    """Maugis' theory with λ = parameter: a constant traction on a ring from a to m a, m by bisection."""
    stiff = 4 * contact_modulus / 3
    a = np.asarray(contact_radius) / np.cbrt(math.pi * work * radius**2 / stiff)

    def excess(m: np.ndarray) -> np.ndarray:
        root, angle = np.sqrt(m**2 - 1), np.arctan(np.sqrt(m**2 - 1))
        first = parameter * a**2 / 2 * (root + (m**2 - 2) * angle)
        return first + 4 * parameter**2 * a / 3 * (root * angle - m + 1) - 1

    low, high = np.ones_like(a), np.full_like(a, 1e6)
    for _ in range(100):
        middle = np.sqrt(low * high)
        low, high = np.where(excess(middle) < 0, middle, low), np.where(excess(middle) < 0, high, middle)
    root, angle = np.sqrt(low**2 - 1), np.arctan(np.sqrt(low**2 - 1))
    force = a**3 - parameter * a**2 * (root + low**2 * angle)
    approach = a**2 - 4 / 3 * a * parameter * root
    unit = np.cbrt((math.pi * work) ** 2 * radius / stiff**2)
    return Curve(np.asarray(contact_radius), force * math.pi * work * radius, approach * unit)


def stickiness(work: float, reach: float, slope: float, curvature: float, contact_modulus: float) -> float:
    """Pastewka and Robbins 2014, doi:10.1073/pnas.1320846111: rough surfaces stick where this is below about 1.

    slope, curvature: rms of |∇h| and of ∇²h.  With l_a = w/E', d = 4 slope/curvature, κ = 2 and Δr = reach it is
    (slope Δr/κ l_a)(slope d/4Δr)^(2/3) / (π (3/16)^(2/3)).
    """
    ratio = slope / (2 * (work / contact_modulus / reach)) * (slope * (slope / (curvature * reach))) ** (2 / 3)
    return ratio / (math.pi * (3 / 16) ** (2 / 3))
