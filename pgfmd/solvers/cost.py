"""What each method costs, for `pgfmd check`.  No MPI here.

Memory: bytes per grid point at the peak, measured (peak of the resident memory less that of a 64² run; 1024² … 8192²
points, one and two ranks).  Work: processor time of a solve to the default tolerance, in transforms (1.4e-8 s per
point).  Of a hard wall it was measured on self-affine surfaces at 2048² … 16384² and areas of .05, .2, .5 and .7: with
λ_s = 16a single times are within 25 % of the formula, those of H = .3 above and of H = .8 below it; rougher surfaces
take up to twice as long.  Other methods: geometric means at 512², single times within a factor of 2, with an
exponential wall (ζ of .03 and .3 of the rms height) within 4.  The `effort` of laws was measured likewise, with ζ of
.1; the formula was that of an exponential wall.
"""

from __future__ import annotations

import math

from pgfmd.grid.grid_cost import Cost

SCALED = 8.0  # heights about their mean, over their rms value
SINGLE = 8.0  # saved by a hard wall's pressure and gap in single precision
MODERATE = 1e6  # largest rms height, and inverse of the smallest, that is solved without a scaled copy
SINGLE_TO = 1.2e-13  # tolerance over points per side down to which rounding in single precision is unseen
# Per unknown of the active set, which is the pressure of a point in contact or, where these are the majority, the gap
# of one that is not: its column, now and before (8), direction, image, residual, preconditioned one, change (20), and
# for pressures the residual without means of blocks, columns near the contact and the change there, with halos (18).
PER_PRESSURE, PER_GAP = 46.0, 28.0
MESH = 4.5  # meshes, means over blocks, and what is measured of every contact, as measured
# Newton's pressure as its root, residual, direction, image, change, response (24), targets (25), rows of the coarse
# grid (6): single precision where that serves.
NEWTON = 55.0
LAW = 24.0  # gaps of a law without closed form, its slopes, and temporary ones
ADHESIVE = 100.0  # gaps and stresses of three states (48), five fields in single precision (20), temporary ones
DYNAMICS = 42.0  # displacement, force, modes and their mobility (28); the rest as measured
GAPS_FROM = 0.8  # contact area above which the active set's unknowns are the gaps outside; there it needs most memory


def cost(
    method: str, area: float, slabs: int = 1, effort: float = 1.0, scaled: bool = True, single: bool = False
) -> Cost:
    """One contact of that relative area by that method; memory of the fullest of so many slabs.

    effort: time under the law over that under a hard wall (dynamics) or an exponential one (Newton).  scaled: whether
    heights are scaled in an array of their own.  single: whether the active set can keep pressure and gap in single
    precision.
    """
    heights = SCALED * scaled
    if method == "adhesive":
        return Cost(70, ADHESIVE)
    if method == "newton":
        return Cost(70 * effort, heights + NEWTON + LAW * (effort > 1))
    if method == "gfmd":
        return Cost(110 * effort, heights + DYNAMICS)
    by_pressures = area <= GAPS_FROM
    most = fullest(area if by_pressures else 1 - area, slabs)
    work, unknowns = (6.5 + 22 * area, PER_PRESSURE) if by_pressures else (13.5 - 7 * area, PER_GAP)
    # Solved, the fields are in double precision.
    return Cost(work, heights + MESH + max(most * unknowns - SINGLE * single, 0))


def fullest(area: float, slabs: int) -> float:
    """The part in contact of the fullest of so many slabs, of which `area` is the mean.

    1 − (1 − area)^k with k = 1 + log₂(slabs)/2 up to 3: the mean over four surfaces whose longest wave is the cell, of
    areas .01 … .8 and 2 … 128 slabs, within .06.  Shorter waves spread contact more evenly.
    """
    return float(1 - (1 - area) ** (1 + min(math.log2(slabs) / 2, 2)))
