"""The contact area, by counting pixels, from the line between them, or less the staircase of their edges; its error.

**Line.** Each pair of neighbouring pixels of which one is in contact gives, from the exact solution of the
straight edge on the grid (`theory.lattice_edge`), the place t at which the line crosses it and the angle θ to the
line's normal.  Then

    area = pixels + Σ (t − ½) cos²θ + b χ,    perimeter = Σ cos θ (spacing across the pair) − χ ∮ δ dθ,

cos²θ sharing the area between crossings of rows and of columns.  This is exact for straight lines.  Along a curved
line the sums err by a constant times its turning; χ, the number of patches less that of their holes, is the total
turning over 2π.  Around a circle, the pairs straddle the line at distance δ outside the true one, so that Σ cos θ
is the length of that outer line.  The sum of the areas is too small by b = π(ax² + ay²)/32 + ½ ∮ δ² dθ.

**Error.** With n edges between pixels in and out of contact: by the grid √n s and n s inside the line, √n and n without
it, s the roughness in radians per pixel; by the solver √n η ‖p‖/d/(1 − f_c), η the relative error of
the pressure, d its rise in one pixel at the edge.  FACTORS: see NUMERICS.md.
"""

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables.contact_line import EdgeTable, Tables, edge_tables, hardening, locate
from pgfmd.observables.patch_table import Labels
from pgfmd.physics.problem import ContactProblem
from pgfmd.physics.solids.solid import Solid
from pgfmd.solvers.solution import ContactSolution

RESOLVED = 2.0
"""Largest wave number times the spacing, along x and along y, that the contact line resolves: λ = π pixels.  At λ_s = 3
pixels, errors of areas are alike inside the line and without it; at 2.5 they are smaller without, at 4 larger."""

LARGEST_RATIO = 5.0
"""`bound` of `locate`: the ratio of two neighbouring pressures (or gaps) over its value at a straight edge of
an unbounded contact is clipped to 1/LARGEST_RATIO … LARGEST_RATIO.  Where contacts or openings are about a pixel wide,
this ratio says little about the edge.  Of 2, 3, 5, 10 and 30, this value gives the smallest error on exact waves whose
contacts and openings are at least one pixel wide: `tools/bench/contact_line.py limit`."""

WINKLER = 0.25
"""`hardening` below which there is a line on any surface.  At λ_s = 1 … 2.5 pixels, its rms error in pixels, per
edge of a pixel, is .004 where this is below .05, .009 up to .25, and .015 above; without the line it is .01."""


@dataclass
class ContactLine:
    """The line of a contact.  `fields`: pressure and gap (nx_local, ny) and the two rows of each before and after."""

    grid: SlabGrid
    fields: tuple[np.ndarray, np.ndarray, np.ndarray]
    solid: Solid
    tables: tuple[EdgeTable, EdgeTable]  # for pairs along x, along y
    bound: float = LARGEST_RATIO
    _of_rows: np.ndarray | None = field(default=None, init=False)  # sums of `of_pixels`, (nx_local, 4)

    @cached_property
    def _lookup(self) -> Tables:
        return Tables((self.tables[0].values, self.tables[1].values), self.is_thin)

    @property
    def is_thin(self) -> bool:
        """Whether it is that of a thin slab."""
        return self.tables[0].scale is not None

    @property
    def _band(self) -> int:
        """Rows at a time: pairs take more memory than fields do."""
        return max(1, min(4 * self.grid.band, self.grid.local_shape[0] // 32))

    def _finish(self, sums: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(area beyond that of the pixels, perimeter) from sums (…, 4) of `of_pixels`."""
        ax, ay = self.grid.spacing
        offset, length_x, length_y, corners = np.moveaxis(sums, -1, 0)
        table = self.tables[0]
        curved = math.pi / 32 * (ax**2 + ay**2) + table.square * ax**2 / 2
        return offset * (ax * ay) + curved * corners, length_x * ay + length_y * ax - table.shift * ax * corners

    def of_pixels(self, first: int, stop: int) -> tuple[np.ndarray, np.ndarray]:
        """Contact pixels i·ny + j of rows first ≤ i < stop that have an open neighbour, and what the line adds at each
        (4, pixels): area in pixels beyond the pixel itself, Σ cos θ over its open neighbours along x, the same along y,
        corners.  Each cosine is a length in spacings across the pair.

        corners: a quarter for each convex corner of the contact's outline, minus a quarter for each concave one; their
        sum over a patch is the number of its outer outlines less that of its holes.
        """
        domain, (ax, ay) = self.grid.domain, self.grid.spacing  # at the border of a patch a pixel is its own neighbour
        stiffness = self.solid.surface_modulus * np.array([self.tables[0].scale or 1.0, self.tables[1].scale or 1.0])
        scales, ratios = stiffness / (ax, ay), np.array([ay / ax, ax / ay])  # k of `contact_line`; steps across
        pressure, gap = (_with_margin(*each, first, stop) for each in zip(self.fields[:2], self.fields[2], strict=True))
        inside, ny = pressure > 0, pressure.shape[1]
        here, closed = inside[2:-2], inside[1:-3] & inside[2:-2] & inside[3:-1]
        left, right = (domain.indices(np.arange(ny) + shift, ny) for shift in (-1, 1))
        pixel = np.flatnonzero(here & ~(closed & closed[:, left] & closed[:, right]))
        i, j = np.divmod(pixel, ny)
        columns = [domain.indices(j + shift, ny) for shift in range(-2, 3)]
        sides = np.array([(-1, 0), (1, 0), (0, -1), (0, 1)])
        opened = [np.flatnonzero(~inside[i + 2 + di, columns[2 + dj]]) for di, dj in sides]
        pairs, side = np.concatenate(opened), np.repeat(np.arange(4), [len(pairs) for pairs in opened])
        along_y, row, column, (di, dj) = side // 2, i[pairs] + 2, j[pairs], sides[side].T
        around, found = np.empty((8, len(pairs))), np.zeros((4, len(pixel)))
        for k in range(8):
            along, across = (k - 1, 0) if k < 4 else ((k - 4) // 2, 2 * (k % 2) - 1)
            at = (row + along * di + across * dj) * ny + domain.indices(column + along * dj + across * di, ny)
            p = pressure.take(at)
            around[k] = np.where(p > 0, p, -scales[along_y] * np.maximum(gap.take(at), 0.0))
        offset, cosine = locate(around, along_y, ratios[along_y], self._lookup, self.bound)
        np.add.at(found[0], pairs, offset)
        np.add.at(found[1:3], (along_y, pairs), cosine)
        for di in (-1, 1):
            one = inside[i + 2 + di, j]
            for dj in (-1, 1):
                other, across_both = inside[i + 2, columns[2 + dj]], inside[i + 2 + di, columns[2 + dj]]
                found[3] += np.where((one == other) & ~across_both, np.where(one, -0.25, 0.25), 0.0)
        return first * ny + pixel, found

    def _sums(self) -> np.ndarray:
        if self._of_rows is None:
            sums, ny = np.zeros((self.grid.local_shape[0], 4)), self.grid.shape[1]

            def part(_: int, first: int, stop: int) -> None:
                pixel, found = self.of_pixels(first, stop)
                _add(sums, pixel // ny, found)

            self.grid.threads.share(part, len(sums), self._band)
            self._of_rows = sums
        return self._of_rows

    def total(self) -> tuple[float, float]:
        """Area beyond that of the pixels, and perimeter.  Collective."""
        area, perimeter = self._finish(self.grid.reduction.sums(*self._sums().sum(axis=0)))
        return float(area), float(perimeter)

    def of_rows(self) -> tuple[np.ndarray, np.ndarray]:
        """The same of the pixels of each of this rank's rows, without communication."""
        return self._finish(self._sums())

    def of_patches(self, labels: Labels) -> tuple[np.ndarray, np.ndarray]:
        """The same of each patch that this rank keeps; called first, it spares the others their pass.  Collective."""
        (rows, ny), patch = self.fields[0].shape, labels.patch[labels.fragment]
        sums, of_rows = np.zeros((labels.kept + len(labels.foreign), 4)), np.zeros((rows, 4))
        run_starts = np.repeat(np.arange(-1, rows) * ny, np.diff(labels.first)) + labels.runs[:, 0]
        for first in range(0, rows, self._band):
            pixel, found = self.of_pixels(first, min(first + self._band, rows))
            _add(of_rows, pixel // ny, found)
            _add(sums, patch[np.searchsorted(run_starts, pixel, side="right") - 1], found)
        self._of_rows = of_rows
        np.add.at(sums, labels.returned, labels.to_keepers(sums[labels.kept :]))
        return self._finish(sums[: labels.kept])


def _with_margin(field: np.ndarray, more: np.ndarray, first: int, stop: int) -> np.ndarray:
    """Rows first − 2 … stop + 1 of a slab; more (4, ny): the two before it and the two after."""
    rows, low, high = len(field), first - 2, stop + 2
    if low >= 0 and high <= rows:
        return field[low:high]
    parts = more[2 + min(low, 0) : 2], field[max(low, 0) : min(high, rows)], more[2 : 2 + max(high - rows, 0)]
    return np.concatenate(parts)


def _add(sums: np.ndarray, which: np.ndarray, found: np.ndarray) -> None:
    """sums[which[k]] += found[:, k] for each k in turn."""
    for column, values in zip(sums.T, found, strict=True):
        np.add.at(column, which, values)


def line_of(problem: ContactProblem, solution: ContactSolution, smooth: bool) -> ContactLine | None:
    """The line of a contact.  smooth: whether the grid resolves the surface.  Collective.

    None where it does not, unless the solid is nearly a Winkler foundation, whose pressures and gaps are as smooth as
    the surface; and under a law by which everything touches.
    """
    grid = problem.grid
    if not problem.law.releases or not (smooth or hardening(problem.solid, min(grid.spacing)) < WINKLER):
        return None
    return contact_line(grid, solution.pressure, solution.gap, problem.solid)


def contact_line(grid: SlabGrid, pressure: np.ndarray, gap: np.ndarray, solid: Solid) -> ContactLine:
    """The line of a hard contact with this pressure and gap (nx_local, ny).  Collective."""
    first, stop = grid.rows.start, grid.rows.stop
    halo = np.array(
        [
            np.concatenate([grid.fetch(field, first - 2, first), grid.fetch(field, stop, stop + 2)])
            for field in (pressure, gap)
        ]
    )
    return ContactLine(grid, (pressure, gap, halo), solid, edge_tables(grid.spacing, solid))


FACTORS = {
    "line": (0.225, 0.0032, 0.72), "line on a thin slab": (0.18, 0.0027, 0.135), "staircase": (0.675, 0.0045, 0.72),
}  # fmt: skip
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

    staircase: by how much pixels overestimate an area, per length of their edges (`staircase`)
    least: p̄/σ_Y, the least area of a contact whose pressures are at most σ_Y.  Where most of an edge bears σ_Y, the
    line, that of an elastic edge, lies too far inside: at λ_s = 8a by up to 5 % of the area, which is then near p̄/σ_Y.
    """
    above = grid.fetch(pressure, grid.rows.start - 1, grid.rows.start)
    left = grid.domain.indices(np.arange(grid.shape[1]) - 1, grid.shape[1])

    def count(first: int, stop: int) -> tuple[int, ...]:
        """Points in contact, and those that differ from the row before, and from the column before."""
        rows = np.concatenate([above, pressure[:stop]]) if first == 0 else pressure[first - 1 : stop]
        inside = rows > 0
        here = inside[1:]
        return tuple(int(np.count_nonzero(each)) for each in (here, here != inside[:-1], here != here[:, left]))

    parts = grid.threads.collect(count, grid.local_shape[0])
    pixels, edges_x, edges_y = (int(total) for total in grid.reduction.sums(*np.sum(parts, axis=0)))
    ax, ay = grid.spacing
    fraction, edge_length = pixels / grid.size, edges_x * ay + edges_y * ax
    beyond, perimeter = (0.0, 0.0) if line is None else line.total()
    corrected = fraction + beyond / (grid.size * grid.pixel_area)
    if line is None or corrected <= 0:  # a contact of a pixel or two has no line
        corrected, perimeter = fraction - staircase * edge_length / (grid.size * grid.pixel_area), edge_length
    return Area(pixels, edges_x, edges_y, fraction, edge_length, max(corrected, least), perimeter)
