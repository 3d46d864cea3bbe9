"""Where the contact line crosses the pairs of neighbours of which one is in contact, from the exact edge of
`theory.lattice_edge`, tabulated.

`signed` is the pressure of a pixel in contact and minus its gap, as the pressure kg, outside: k is E'/a on a half-space
(a: the spacing), see `EdgeTable` for thin slabs.  `around` (8, pairs)
are the values about each pair of neighbours, a contact pixel and an open one:

    around[0 … 3]    along the pair, outward: the pixel before the contact pixel, the pair, the pixel after the open one
    around[4 … 7]    left and right of the contact pixel, left and right of the open one

All in NumPy: compiled, this would be a sixth of what a first run compiles, and hardly faster.
"""

import math
from dataclasses import dataclass
from fractions import Fraction
from functools import cache

import numpy as np

from pgfmd.physics.problem import ContactProblem
from pgfmd.physics.solids.solid import Solid
from pgfmd.theory.lattice_edge import LONG, LatticeEdge, Stiffness, lattice_edge

OFFSET, COSINE, PLACE, INNER, OUTER = range(5)  # last axis of a table, see `EdgeTable`
_ROUNDS = 8  # of `locate`, at most; more of them change the area that the line adds by .1 % where λ_s = 4a
_LARGEST = 1e6  # of pressures and gaps over those of a pair, which may vanish both: keeps squares finite


def _distance(relative: np.ndarray) -> np.ndarray:
    """Roughly linear in the distance to the edge on both sides: p² inside, −(¾E'g/a)^(2/3) outside."""
    x = np.clip(relative, -_LARGEST, _LARGEST)
    found = 0.75 * x
    np.cbrt(np.square(found, out=found), out=found)
    np.negative(found, out=found)
    return np.multiply(x, x, out=found, where=x > 0)


def describe(around: np.ndarray, ratio: np.ndarray | float, linear: bool) -> tuple[np.ndarray, np.ndarray]:
    """(share of the pressure in p + kg at the pair, angle between the pair and the apparent normal, 0 … π/2).

    ratio: spacing across the pair over that along it.  linear: whether pressures and gaps are linear in the distance to
    the edge, as on a thin slab.
    """
    scale = around[1] - around[2]
    with np.errstate(over="ignore"):  # of what is clipped
        far = around / scale if linear else _distance(around / scale)
    along = far[1] - far[2] + (far[4] - far[6]) + (far[5] - far[7])
    across = np.abs((far[5] + far[7]) - (far[4] + far[6])) / (4 * ratio)
    return around[1] / scale, np.arctan2(across, np.maximum(along / 3, 1e-9))


def _bracket(at: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """First of the two of `count` points, evenly from 0 to 1, about each of `at`, and the weight of the other."""
    x = np.minimum(at, 1.0) * (count - 1)
    i = np.minimum(x.astype(np.intp), count - 2)
    return i, x - i


class Tables:
    """Two tables (angles, shares, quantities), for pairs along x and along y, to look up in."""

    def __init__(self, tables: tuple[np.ndarray, np.ndarray], linear: bool = False) -> None:
        self.linear = linear
        self.angles, self.shares, _ = tables[0].shape
        self.flat = np.moveaxis(np.stack(tables), -1, 0).reshape(tables[0].shape[-1], -1)

    def rows(self, axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
        """(index of the first entry of the lower row, weight of the other) about an angle: (2, pairs)."""
        j, y = _bracket(angle * (2 / math.pi), self.angles)
        return np.stack([(axis * self.angles + j) * self.shares, y])

    def look(self, names: tuple[int, ...], rows: np.ndarray, share: np.ndarray) -> list[np.ndarray]:
        """Those quantities by bilinear interpolation."""
        i, x = _bracket(share, self.shares)
        at, y = rows[0].astype(np.intp) + i, rows[1]
        z, w = 1 - x, 1 - y
        corners = (at, z * w), (at + 1, x * w), (at + self.shares, z * y), (at + self.shares + 1, x * y)
        return [sum(self.flat[name].take(place) * weight for place, weight in corners) for name in names]


def locate(
    around: np.ndarray, axis: np.ndarray, ratio: np.ndarray, tables: Tables, bound: float
) -> tuple[np.ndarray, np.ndarray]:
    """(area between the line and the middle of each pair, in pixels; |cosine| of the line's normal to the pair).

    axis: of each pair, 0 along x, 1 along y;  ratio: as in `describe`, of each

    Near the edge p = K√d (1 + αd + βd²) and g = (4K/3E') |d|^1.5 (1 − ⅗α|d| + 3/7 β|d|²).  The table is exact for
    α = β = 0.  g/p at the pair is first reduced to this case: it is multiplied by P^a G^b, where P and G are p₂/p and
    g₂/g over their values at α = β = 0.  a and b cancel the terms of first and second order.  P and G are clipped to
    1/bound … bound.  On a thin slab p = k(d + αd² + βd³), g = |d| − αd² + β|d|³, and a = −b = ½.
    """
    share, angle = describe(around, ratio, tables.linear)
    rows, pressure, gap = tables.rows(axis, angle), around[1], -around[2]
    with np.errstate(over="ignore"):  # of what is clipped
        inward, outward = np.maximum(around[0], 0.0) / pressure, np.maximum(-around[3], 0.0) / np.maximum(gap, 1e-300)
    known = np.vstack([pressure, gap, inward, outward, rows])  # of the pairs whose share still changes
    moving = np.arange(len(share))
    for _ in range(_ROUNDS):
        before, (p, g, inward, outward) = share[moving], known[:4]
        t, inner, outer = tables.look((PLACE, INNER, OUTER), known[4:], before)
        with np.errstate(over="ignore"):
            inner, outer = (np.log(np.clip(x * y, 1 / bound, bound)) for x, y in ((inner, inward), (outer, outward)))
        if tables.linear:
            change = (inner - outer) / 2
        else:
            t = np.clip(t, -0.2, 1.0)
            first = 0.6 + 0.4 * t
            b = (t * t - 3 / 7 * (1 - t) ** 2 - first * (2 * t + 1)) / (0.6 * (2 * t + 1) + 3 / 7 * (3 - 2 * t))
            change = (first + 0.6 * b) * inner + b * outer
        now = p / (p + g * np.exp(change))
        share[moving] = now
        open_yet = np.abs(now - before) >= 1e-4
        moving, known = moving[open_yet], known[:, open_yet]
        if not len(moving):
            break
    offset, cosine = tables.look((OFFSET, COSINE), rows, share)
    return offset, cosine


POINTS = 65  # of the table in each direction; 257 change the area that the line adds by .03 %, the perimeter by 4e-5
_SAMPLES = 400  # positions of the edge between two lines of the grid, for each direction; 1600 change areas by 5e-6
THIN = 0.75
"""A slab is thin if `hardening` is below this: thinner than about a pixel.  The edge of a half-space is .0003 to .006
pixels off at .6 to 1 pixel (λ_s ≥ 4 pixels), that of a slab at most .0005 up to 1 pixel, more beyond 1.2."""
NEARLY_HALF_SPACE = 0.98  # the same for the mean of δ: nearer to 1, δ is that of a half-space
ROUGHNESS = 0.048
"""Where roughness reaches the pixel, so do the curvatures of contacts, and counts exceed areas by more than along
straight lines.  Fitted to 137 contacts on half-spaces (λ_s = 1 … 3 pixels, H = .3 … .95, s = .8 … 2.3),
where .1017 (1 + .048 s²) is .105 to .128.  The rms residual is .4 pixels times the root of the number of edges.
Geometry alone gives .118, doi:10.1016/j.triboint.2017.04.023."""
_SLOPES = (
    Fraction(0), *(Fraction(1, n) for n in (64, 32, 20, 16, 12, 10, 8)), *(Fraction(k, 16) for k in range(3, 17)),
)  # fmt: skip
"""Tangents of the directions that are solved, and their inverses: close together near the axes, where δ has a cusp."""


@dataclass(frozen=True)
class EdgeTable:
    """For pairs of pixels along one axis.

    values: (POINTS, POINTS, 5), over the apparent angle from 0 to π/2 and the share p/(p + kg) from 0 to 1 (see
    `describe`).  The five are: the area (t − ½) cos²θ in pixels between the line and the middle of the pair;
    cos θ, θ the angle between the pair and the normal; t, the distance from the contact pixel to the line along the
    pair, in spacings; p/p₂ and g/g₂, where p₂ is the pressure one pixel farther in and g₂ the gap one farther out
    shift, square: ∮ δ dθ and ∮ δ² dθ, δ as in `theory.lattice_edge`
    scale: of a thin slab, whose pressures and gaps are linear in the distance: its k in units of E'/a; None: a
    half-space, with k = E'/a
    """

    values: np.ndarray
    shift: float
    square: float
    scale: float | None


@cache
def edge_table(ratio: float, solid: Solid | None = None, step: float = 1.0) -> EdgeTable:
    """The table for pairs along x of a grid with spacing (step, ratio · step).  A few hundredths of a second.

    solid: a thin slab; None: a half-space.
    """
    shares, angles = np.linspace(0, 1, POINTS), np.linspace(0, math.pi / 2, POINTS)
    found, shifts, directions = [], [], []
    stiffness = None if solid is None else per_pixel(solid, step)
    scale = None if stiffness is None else mean_stiffness(stiffness)
    for m, k in _directions():
        edge = lattice_edge(m, k, (1.0, ratio), count=3 * (m + k) + 2, stiffness=stiffness)
        directions.append(math.atan2(edge.normal[1], edge.normal[0]))
        shifts.append(edge.shift)
        if m:
            found.append(_along_shares(edge, (m, k), ratio, shares, scale))
    last = np.array(found[-1])  # along the line: no pair straddles it
    last[0], last[1], last[2] = math.pi / 2, 0.0, 0.0
    columns = np.array([*found, last])  # (directions, 1 + 5, shares)
    values = np.empty((POINTS, POINTS, 5))
    for i in range(POINTS):
        for which in range(5):
            values[:, i, which] = np.interp(angles, columns[:, 0, i], columns[:, 1 + which, i])
    shift = np.array(shifts)
    around = [4 * float(np.trapezoid(power, directions)) for power in (shift, shift**2)]
    return EdgeTable(values, around[0], around[1], scale)


def staircase(problem: ContactProblem, roughness: float) -> float:
    """By how much counting pixels overestimates an area, per length of pixel edges between contact and non-contact:
    that of isotropic straight lines, ∮ δ dθ / ∮ (|cos θ| + |sin θ|) dθ, times 1 + ROUGHNESS s²; 0 under a
    law by which everything touches.

    roughness: s, radians per pixel (`rough_surface`).
    """
    if not problem.law.releases:
        return 0.0
    table = edge_tables(problem.grid.spacing, problem.solid, NEARLY_HALF_SPACE)[0]
    return table.shift / 8 * problem.grid.spacing[0] * (1 + ROUGHNESS * roughness**2)


def edge_tables(spacing: tuple[float, float], solid: Solid, thin: float = THIN) -> tuple[EdgeTable, EdgeTable]:
    """The tables for pairs along x and along y: those of a slab if its `hardening` is below `thin`."""
    ax, ay = spacing
    if hardening(solid, min(spacing)) < thin:
        return edge_table(ay / ax, solid, ax), edge_table(ax / ay, solid, ay)
    return edge_table(ay / ax), edge_table(ax / ay)


def hardening(solid: Solid, step: float) -> float:
    """d ln K/d ln q at the shortest wave of pixels of that side: 1 for a half-space, 0 for a Winkler foundation.
    Also 1 where the stiffness K vanishes with q.
    """
    longest, below, above = per_pixel(solid, step)(np.array([LONG, math.pi / 1.01, math.pi * 1.01]))
    return math.log(above / below) / (2 * math.log(1.01)) if longest > below / 100 else 1.0


def mean_stiffness(stiffness: Stiffness) -> float:
    """exp of the mean of ln K over the modes along an axis: with this k, a line across it has the share 1 − β."""
    return math.exp(np.mean(np.log(stiffness(np.pi * (np.arange(64) + 0.5) / 64))))


def per_pixel(solid: Solid, step: float) -> Stiffness:
    """The stiffness of a solid in units of E' and pixels of that side."""
    return lambda q: solid.stiffness(q / step) * (step / solid.surface_modulus)


def _directions() -> list[tuple[int, int]]:
    """Pairs (m, k) without common factor, from (1, 0) to (0, 1) with rising angle."""
    flat = [(slope.denominator, slope.numerator) for slope in _SLOPES]
    return flat + [(k, m) for m, k in reversed(flat[:-1])]


def _along_shares(
    edge: LatticeEdge, direction: tuple[int, int], ratio: float, shares: np.ndarray, scale: float | None
) -> np.ndarray:
    """Apparent angle and the five quantities at the given shares: (6, shares).  scale: see `EdgeTable`."""
    m, k = direction
    contact = np.repeat(np.arange(m), -(-_SAMPLES // m))[:, None]  # line s of the contact pixel; the open one's: s − m
    beta = np.tile(np.linspace(1 - 1e-9, 1e-9, -(-_SAMPLES // m)), m)[:, None]
    lines = contact + np.array([m, 0, -m, -2 * m, -k, k, -k - m, k - m])
    around = edge.signed(lines, beta)
    around[around < 0] *= scale or 1.0
    share, angle = describe(around.T, ratio, scale is not None)
    place = edge.distance(contact, beta)[:, 0] / edge.normal[0]
    cosine = np.full(len(around), edge.normal[0])
    columns = [
        angle, (place - 0.5) * cosine**2, cosine, place, around[:, 1] / around[:, 0], around[:, 2] / around[:, 3],
    ]  # fmt: skip
    return np.array([np.interp(shares, share, column) for column in columns])
