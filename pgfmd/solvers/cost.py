"""What each method costs, for `pgfmd check`.  No MPI here.

Memory: bytes per grid point at the peak, measured (peak of the resident memory less that of a 16² run, 1024² and 2048²
points, one to four ranks).  Work: transforms of a solve to the default tolerance; other work counts as the transforms
that would take as long.  Each number is the geometric mean of processor times at 512² on surfaces with λ_s = 4a and
16a at contact areas of 0.06 and 0.54; single times are within a factor of 2 of it.  For an exponential wall, ζ was .03
and .3 of the rms height; there they are within a factor of 4.  The `effort` of laws was measured likewise, with ζ of
.1; the formula was that of an exponential wall.  Surfaces that are rough down to the grid take up to three times as
long.
"""

from __future__ import annotations

import math

from pgfmd.grid.cost import Cost

SCALED = 8.0  # heights about their mean, over their rms value
SINGLE = 8.0  # saved by a hard wall's pressure and gap in single precision
MODERATE = 1e6  # largest rms height, and inverse of the smallest, that is solved without a scaled copy
SINGLE_TO = 2e-12  # tolerance over the side of the grid in points down to which rounding in single precision is unseen
# Per unknown of the active set, which is the pressure of a point in contact or, where these are the majority, the gap
# of one that is not: its column, now and before (8), direction, image, residual, preconditioned one, change (20), and
# for pressures the residual without means of blocks, columns near the contact and the change there, with halos (15).
PER_PRESSURE, PER_GAP = 43.0, 28.0
# The mesh of half as many points each way (strips, field, influence), means over blocks, their response (5); the rest
# as measured.
MESH = 12.0
# Newton's pressure as its root, residual, direction, image, change, response (24), targets (25), rows of the coarse
# grid (6): single precision where that serves.
NEWTON = 55.0
DYNAMICS = 42.0  # displacement, force, modes and their mobility (28); the rest as measured
GAPS_FROM = 0.65  # contact area above which the active set's unknowns are the gaps outside; there it needs most memory



def cost(
    method: str, area: float, slabs: int = 1, effort: float = 1.0, scaled: bool = True, single: bool = False
) -> Cost:
    """One contact of that relative area by that method; memory of the fullest of so many slabs.

    effort: time of dynamics under the law over that under a hard wall.  scaled: whether heights are scaled in an array
    of their own.  single: whether the active set can keep pressure and gap in single precision.
    """
    heights = SCALED * scaled
    if method == "newton":
        return Cost(70, heights + NEWTON)
    if method == "gfmd":
        return Cost(110 * effort, heights + DYNAMICS)
    by_pressures = area <= GAPS_FROM
    most = fullest(area if by_pressures else 1 - area, slabs)
    unknowns = most * (PER_PRESSURE if by_pressures else PER_GAP)
    return Cost(18, heights + MESH + unknowns - SINGLE * single)


def fullest(area: float, slabs: int) -> float:
    """The part in contact of the fullest of so many slabs, of which `area` is the mean.

    1 − (1 − area)^k with k = 1 + log₂(slabs)/2 up to 3: the mean over four surfaces whose longest wave is the cell, of
    areas .01 … .8 and 2 … 128 slabs, within .06.  Shorter waves spread contact more evenly.
    """
    return float(1 - (1 - area) ** (1 + min(math.log2(slabs) / 2, 2)))
