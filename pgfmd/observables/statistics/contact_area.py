"""The contact area, by counting pixels, from the line between them, or less the staircase of their edges; its error.

The error has two parts.  In pixels, with n edges between pixels in and out of contact:

The grid: where the line lies between two pixels is wrong at random, and by a little with one sign,

    inside the line √n s and n s,    without it √n and n,

s the roughness of the surface in radians per pixel (`rough_surface`): lines turn on the scale of its waves.

The solver: an error e of the pressure moves the line by e over the rise of the pressure in one pixel at the edge, b.
Σ |e| over the n edges is at most √n ‖e‖ = √n η ‖p‖, η the relative error of the pressure.  On a half-space b is of the
order of the rms pressure in contact, on a thin slab K(π/a) a g_rms: the pressure follows the slope of the surface.  The
more is in contact, the more does a change of the pressure open or close: 1/(1 − f_c).

FACTORS: so that errors are large enough in 19 cases of 20; from 400 contacts (`tools/bench/error_bars.py held`, seeds
77 and 78), and tested on others.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables.contact_line.line import ContactLine

FACTORS = {"line": (0.25, 0.0035, 0.8), "line on a thin slab": (0.2, 0.003, 0.15), "staircase": (0.75, 0.005, 0.8)}
"""Of the random and the systematic part by the grid, and of the part by the solver, for each way to correct an area."""


@dataclass(frozen=True)
class Area:
    """Contact area of a pressure field; the same on all ranks."""

    pixels: int  # with p > 0
    edges_x: int  # between contact and non-contact pixels that are neighbours along x
    edges_y: int
    fraction: float  # relative contact area f_c
    edge_length: float  # S_d, length of all these edges
    corrected: float  # f_c inside the contact line; less the staircase where there is none; at least p̄/σ_Y
    perimeter: float  # length of the contact line; `edge_length` where there is none

    @property
    def edges(self) -> int:
        """Number of edges between contact and non-contact pixels."""
        return self.edges_x + self.edges_y

    def error(self, way: str, roughness: float, shift: float) -> float:
        """Error of `corrected`, which is larger in one case of 20.

        way: to correct the area, of FACTORS;  roughness: s, radians per pixel;  shift: η ‖p‖/b
        """
        edges = self.edges
        if not edges:  # full contact, or none: to one pixel
            return self.fraction / max(self.pixels, 1)
        random, systematic, solver = FACTORS[way]
        scale = 1.0 if way == "staircase" else roughness
        parts = random * scale * math.sqrt(edges), systematic * scale * edges, solver * shift * math.sqrt(edges)
        pixel = self.fraction / self.pixels
        return math.hypot(parts[0], parts[1], parts[2] / (1 - self.fraction + edges * pixel)) * pixel


def contact_area(
    grid: SlabGrid, pressure: np.ndarray, line: ContactLine | None, least: float = 0.0, staircase: float = 0.0
) -> Area:
    """Count contact pixels of a slab (nx_local, ny) and the edges around them, and measure the line.  Collective.

    staircase: by how much pixels overestimate an area, per length of their edges (`contact_line.table.staircase`)
    least: p̄/σ_Y, the least area of a contact whose pressures are at most σ_Y.  Where most of an edge bears σ_Y, the
    line, that of an elastic edge, lies too far inside: at λ_s = 8a by up to 5 % of the area, which is then near p̄/σ_Y.
    """
    above = grid.fetch(pressure, grid.rows.start - 1, grid.rows.start)
    parts = grid.threads.collect(lambda a, b: _count_edges(pressure, above, a, b), grid.local_shape[0])
    pixels, edges_x, edges_y = (int(total) for total in grid.reduction.sums(*np.sum(parts, axis=0)))
    ax, ay = grid.spacing
    fraction, edge_length = pixels / grid.size, edges_x * ay + edges_y * ax
    beyond, perimeter = (0.0, 0.0) if line is None else line.total()
    corrected = fraction + beyond / (grid.size * grid.pixel_area)
    if line is None or corrected <= 0:  # a contact of a pixel or two has no line
        corrected, perimeter = fraction - staircase * edge_length / (grid.size * grid.pixel_area), edge_length
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
