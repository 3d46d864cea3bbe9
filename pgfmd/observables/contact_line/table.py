"""Where the line crosses a pair of neighbouring pixels, tabulated from the exact edge of `theory.lattice_edge`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from functools import cache

import numpy as np

from pgfmd.observables.contact_line.pairs import describe
from pgfmd.theory.lattice_edge import LatticeEdge, lattice_edge

POINTS = 65  # of the table in each direction; 257 change the area that the line adds by .03 %, the perimeter by 4e-5
_SAMPLES = 400  # positions of the edge between two lines of the grid, for each direction; 1600 change areas by 5e-6
_SLOPES = (
    Fraction(0), *(Fraction(1, n) for n in (64, 32, 20, 16, 12, 10, 8)), *(Fraction(k, 16) for k in range(3, 17)),
)  # fmt: skip
"""Tangents of the directions that are solved, and their inverses: close together near the axes, where δ has a cusp."""


@dataclass(frozen=True)
class EdgeTable:
    """For pairs of pixels along one axis.

    values: (POINTS, POINTS, 5), over the apparent angle from 0 to π/2 and the share p/(p + E'g/a) from 0 to 1 (see
    `pairs.describe`).  The five are: the area (t − ½) cos²θ in pixels between the line and the middle of the pair;
    cos θ, θ the angle between the pair and the normal; t, the distance from the contact pixel to the line along the
    pair, in spacings; p/p₂ and g/g₂, where p₂ is the pressure one pixel farther in and g₂ the gap one farther out
    shift, square: ∮ δ dθ and ∮ δ² dθ, δ as in `theory.lattice_edge`
    """

    values: np.ndarray
    shift: float
    square: float


@cache
def edge_table(ratio: float) -> EdgeTable:
    """The table for pairs along x of a grid with spacing (1, ratio).  A few hundredths of a second."""
    shares, angles = np.linspace(0, 1, POINTS), np.linspace(0, math.pi / 2, POINTS)
    found, shifts, directions = [], [], []
    for m, k in _directions():
        edge = lattice_edge(m, k, (1.0, ratio), count=3 * (m + k) + 2)
        directions.append(math.atan2(edge.normal[1], edge.normal[0]))
        shifts.append(edge.shift)
        if m:
            found.append(_along_shares(edge, m, k, ratio, shares))
    last = np.array(found[-1])  # along the line: no pair straddles it
    last[0], last[1], last[2] = math.pi / 2, 0.0, 0.0
    columns = np.array([*found, last])  # (directions, 1 + 5, shares)
    values = np.empty((POINTS, POINTS, 5))
    for i in range(POINTS):
        for which in range(5):
            values[:, i, which] = np.interp(angles, columns[:, 0, i], columns[:, 1 + which, i])
    shift = np.array(shifts)
    return EdgeTable(values, 4 * np.trapezoid(shift, directions), 4 * np.trapezoid(shift**2, directions))


def _directions() -> list[tuple[int, int]]:
    """Pairs (m, k) without common factor, from (1, 0) to (0, 1) with rising angle."""
    flat = [(slope.denominator, slope.numerator) for slope in _SLOPES]
    return flat + [(k, m) for m, k in reversed(flat[:-1])]


def _along_shares(edge: LatticeEdge, m: int, k: int, ratio: float, shares: np.ndarray) -> np.ndarray:
    """Apparent angle and the five quantities at the given shares: (6, shares)."""
    contact = np.repeat(np.arange(m), -(-_SAMPLES // m))[:, None]  # line s of the contact pixel; the open one's: s − m
    beta = np.tile(np.linspace(1 - 1e-9, 1e-9, -(-_SAMPLES // m)), m)[:, None]
    lines = contact + np.array([m, 0, -m, -2 * m, -k, k, -k - m, k - m])
    around = edge.signed(lines, beta)
    share, angle = describe(around.T, ratio)
    place = edge.distance(contact, beta)[:, 0] / edge.normal[0]
    cosine = np.full(len(around), edge.normal[0])
    columns = [
        angle, (place - 0.5) * cosine**2, cosine, place, around[:, 1] / around[:, 0], around[:, 2] / around[:, 3],
    ]  # fmt: skip
    return np.array([np.interp(shares, share, column) for column in columns])
