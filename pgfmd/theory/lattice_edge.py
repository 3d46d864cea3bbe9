"""The edge of a contact on a grid: exact pressures, gaps, and where counting grid points puts the edge.

The grid's solid has its stiffness K(q) on the modes of the grid, q in the first Brillouin zone.  A field that is
constant along an edge with normal along (m/ax, k/ay), gcd(m, k) = 1, depends on one integer s = m i + k j, at the
distance d = h s + const with h = 1/|(m/ax, k/ay)|.  With contact for s ≥ 0 this is a Wiener–Hopf problem (solved in
NUMERICS.md, section "Contact lines between pixels").  Pressures p_s and gaps g_{−s} are linear in 0 ≤ β ≤ 1: as β
passes from 0 to 1 the edge moves by one line of the grid.

A pixel is in contact if its centre lies less than δ outside the true edge, and counting pixels overestimates an area by
δ times the length of its edge.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

STAIRCASE = 0.101378
"""Area error of counting square pixels, in pixels, per pixel edge that separates contact from non-contact, averaged
over offsets and directions: ∮ δ dθ / ∮ (|cos θ| + |sin θ|) dθ.  Computed by `tools/bench/contact_line.py constant`.
Geometry alone, doi:10.1016/j.triboint.2017.04.023, gives 0.118."""


Stiffness = Callable[[np.ndarray], np.ndarray]
LONG, SHORT = 1e-5, 1e6  # wave numbers times the spacing, between which the integral X is computed


@dataclass(frozen=True)
class LatticeEdge:
    """A straight edge with normal along (m/ax, k/ay); lengths in the unit of the spacing.  E' and the stress intensity
    K are 1; for a slab, far from the edge, dp/dd = 1.

    pressure, gap: (2, count), with p_s = pressure[0, s] − β pressure[1, s] and g_{−s} = gap[0, s] + β gap[1, s].
    """

    normal: tuple[float, float]
    step: float  # h, from one line of the grid to the next
    shift: float  # δ
    pressure: np.ndarray
    gap: np.ndarray

    def distance(self, line: np.ndarray, beta: np.ndarray) -> np.ndarray:
        """Distance d of a line s of grid points to the edge, positive in contact."""
        return self.step * (line + 1 - beta) - self.shift

    def signed(self, line: np.ndarray, beta: np.ndarray) -> np.ndarray:
        """The pressure where s ≥ 0, minus the gap elsewhere."""
        at = np.abs(line)
        inside = self.pressure[0, at] - beta * self.pressure[1, at]
        return np.where(line >= 0, inside, -self.gap[0, at] - beta * self.gap[1, at])


def lattice_edge(
    m: int,
    k: int,
    spacing: tuple[float, float] = (1.0, 1.0),
    count: int = 64,
    points: int = 2048,
    stiffness: Stiffness | None = None,
) -> LatticeEdge:
    """Solve the edge problem for the direction (m, k), without common factor, on the first `count` lines each side.

    points: of the quadrature over κ; δ is then right to 2e-4 of a spacing.  stiffness: K(q) of a slab on a rigid base,
    pressure per displacement for arrays of wave numbers q > 0; None: a half-space.
    """
    step = 1 / math.hypot(m / spacing[0], k / spacing[1])
    kappa = 2 * np.pi * (np.arange(points) + 0.5) / points
    q = np.hypot(_wrap(m * kappa) / spacing[0], _wrap(k * kappa) / spacing[1])
    symbol = 2 * np.sin(kappa / 2) / (step * q) if stiffness is None else 1 / stiffness(q)
    harmonics = np.fft.fft(np.log(symbol)) / points
    rho = (harmonics * np.exp(-1j * np.pi * np.arange(points) / points)).real
    rho[0] = rho[points // 2 :] = 0
    r, one = float(np.arange(points) @ rho), math.exp(rho.sum())  # one = R(1)
    log = np.fft.fft(rho)
    forward, inverse = (np.fft.ifft(np.exp(sign * log)).real[:count] for sign in (1, -1))

    def product(exponent: float, series: np.ndarray) -> np.ndarray:
        """Coefficients of (1−z)^(−exponent) times a series."""
        n = np.arange(1, count)
        return np.convolve(np.concatenate([[1], np.cumprod((n + exponent - 1) / n)]), series)[:count]

    if stiffness is None:
        powers, shift = (1.5, 2.5), step * (0.25 - r)
        inside = math.sqrt(np.pi * step) / 2 * one  # √s ∼ (√π/2) (1−z)^(−3/2)
        outside = math.sqrt(np.pi) * step**1.5 / one  # (4/3) s^(3/2) ∼ √π (1−z)^(−5/2)
    else:
        powers, shift = (2.0, 2.0), onset(stiffness) - step * r
        inside, outside = step * one, step / one / float(stiffness(np.array([LONG]))[0])
    gap = np.zeros((2, count))
    gap[0, 2:] = outside * product(powers[1], forward)[:-2]
    gap[1, 1:] = outside * product(powers[1] - 1, forward)[:-1]
    return LatticeEdge(
        normal=(m / spacing[0] * step, k / spacing[1] * step),
        step=step,
        shift=shift,
        pressure=inside * np.array([product(powers[0], inverse), product(powers[0] - 1, inverse)]),
        gap=gap,
    )


def onset(stiffness: Stiffness) -> float:
    """X = (1/π) ∫_0^∞ log(K(t)/K₀) dt/t²: far inside, a slab is a Winkler foundation whose edge is at −X."""
    t = np.exp(np.linspace(math.log(LONG), math.log(SHORT), 8000))
    log = np.log(stiffness(t) / stiffness(t[:1]))
    return float(np.trapezoid(log / t, np.log(t)) + (log[-1] + 1) / t[-1]) / math.pi


def _wrap(angle: np.ndarray) -> np.ndarray:
    return angle - 2 * np.pi * np.round(angle / (2 * np.pi))
