"""The contact area, by counting pixels and from the line between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables.contact_line.line import ContactLine


@dataclass(frozen=True)
class Area:
    """Contact area of a pressure field; the same on all ranks."""

    pixels: int  # with p > 0
    edges_x: int  # between contact and non-contact pixels that are neighbours along x
    edges_y: int
    fraction: float  # relative contact area f_c
    edge_length: float  # S_d, length of all these edges
    corrected: float  # f_c inside the contact line, at least p̄/σ_Y; `fraction` where there is none
    perimeter: float  # length of the contact line; `edge_length` where there is none


def contact_area(grid: SlabGrid, pressure: np.ndarray, line: ContactLine | None, least: float = 0.0) -> Area:
    """Count contact pixels of a slab (nx_local, ny) and the edges around them, and measure the line.  Collective.

    least: p̄/σ_Y, the least area of a contact whose pressures are at most σ_Y.  Where most of an edge bears σ_Y, the
    line, that of an elastic edge, lies too far inside: at λ_s = 8a by up to 5 % of the area, which is then near p̄/σ_Y.
    """
    above = grid.fetch(pressure, grid.rows.start - 1, grid.rows.start)
    parts = grid.threads.collect(lambda a, b: _count_edges(pressure, above, a, b), grid.local_shape[0])
    pixels, edges_x, edges_y = (int(total) for total in grid.reduction.sums(*np.sum(parts, axis=0)))
    ax, ay = grid.spacing
    fraction, edge_length = pixels / grid.size, edges_x * ay + edges_y * ax
    beyond, perimeter = (0.0, edge_length) if line is None else line.total()
    corrected = fraction + beyond / (grid.size * grid.pixel_area)
    if corrected <= 0:  # a contact of a pixel or two has no line
        corrected, perimeter = fraction, edge_length
    return Area(pixels, edges_x, edges_y, fraction, edge_length, max(corrected, least), perimeter)


def _count_edges(pressure: np.ndarray, above: np.ndarray, first: int, stop: int) -> tuple[int, ...]:
    """(points p > 0, contact/non-contact edges to the row before, and to the column before) of rows first … stop−1.

    `above` (1, ny) is the row before row 0; column 0 follows the last one.
    """
    rows = np.concatenate([above, pressure[:stop]]) if first == 0 else pressure[first - 1 : stop]
    inside = rows > 0
    here = inside[1:]
    counts = here, here != inside[:-1], here != np.roll(here, 1, axis=1)
    return tuple(int(np.count_nonzero(each)) for each in counts)
