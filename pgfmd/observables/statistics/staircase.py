"""The contact area, raw and corrected for the staircase that pixels make of its edge."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables.statistics.kernels import count_edges

STAIRCASE = (math.pi - 1 + math.log(2)) / 24
"""Area per pixel edge, in pixels, by which counting pixels errs on average: Yastrebov, Anciaux, Molinari (2017),
doi:10.1016/j.triboint.2017.04.023."""


@dataclass(frozen=True)
class Area:
    """Contact area of a pressure field; the same on all ranks."""

    pixels: int  # with p > 0
    edges_x: int  # between contact and non-contact pixels that are neighbours along x
    edges_y: int
    fraction: float  # relative contact area f_c
    corrected: float  # f_c without the staircase
    perimeter: float  # S_d, length of all these edges


def contact_area(grid: SlabGrid, pressure: np.ndarray) -> Area:
    """Count contact pixels of a slab (nx_local, ny) and the edges around them.  Collective.

    The correction is A = A_num − STAIRCASE S_d a.  Where ax ≠ ay each edge counts with the pixel area, its length times
    the spacing across it: then the relative area is unchanged by stretching the cell.
    """
    above = grid.fetch(pressure, grid.rows.start - 1, grid.rows.start)
    parts = grid.threads.collect(lambda a, b: count_edges(pressure, above, a, b), grid.local_shape[0])
    pixels, edges_x, edges_y = (int(total) for total in grid.reduction.sums(*np.sum(parts, axis=0)))
    ax, ay = grid.spacing
    fraction = pixels / grid.size
    corrected = fraction - STAIRCASE * (edges_x + edges_y) / grid.size
    return Area(pixels, edges_x, edges_y, fraction, corrected, edges_x * ay + edges_y * ax)
