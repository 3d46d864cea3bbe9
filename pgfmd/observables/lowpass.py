"""f(q) as solved: the contact area of the surface without its modes beyond q, under the same load."""

import math
from dataclasses import dataclass

import numpy as np

from pgfmd.grid.cell import Cell
from pgfmd.grid.grid_cost import Cost
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.transfer import SubGrid, restrict
from pgfmd.grid.transforms import source
from pgfmd.observables.contact import Contact
from pgfmd.observables.contact_area import RESOLVED, contact_area, line_of
from pgfmd.observables.contact_line import staircase
from pgfmd.observables.observable import Observable
from pgfmd.observables.schema import Dataset, Groups
from pgfmd.options.rules import POSITIVE, many
from pgfmd.options.section import key
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.solution import Solve

POINTS_PER_WAVE = 8
"""Least number of grid points per shortest remaining wavelength.  The area inside the contact line is then within .2 %
of that of an infinitely fine grid."""
FEWEST_POINTS = 4
"""Where POINTS_PER_WAVE needs the full grid, it is still coarsened by 2 if at least so many points per wavelength
remain; the area is then within 1 %."""
TRANSFORMS = 30
"""Work of one of these contacts, in transforms of the grid on which it is solved."""
MEMORY = 60.0
"""Bytes per point of the grid on which one of them is solved, heights, pressure and gap included."""


@dataclass(frozen=True, kw_only=True)
class Lowpass(Observable):
    """Contact areas of the surface low-passed at each q, at the same load, on the coarsest grid that resolves it."""

    needs_period = "heights are filtered by their Fourier modes"
    name = "lowpass"
    attraction = False
    layout = {
        "lowpass_area": {
            "q": Dataset("1/({length})", "cut-off wave number, radians per length", ("q",)),
            "area": Dataset("1", "relative contact area f_c without modes beyond q; NaN: not certified", ("q",)),
            "area_corrected": Dataset("1", "f_c inside the contact line, as contact_area_corrected", ("q",)),
        }
    }

    q: tuple[float, ...] = key(
        many(POSITIVE), (), "cut-offs; empty: doubled from the cell's longest wave to the surface's shortest",
        unit="radians per length",
    )  # fmt: skip

    def cutoffs(self, cell: Cell, highest: float) -> np.ndarray:
        """The wave numbers at which the surface is cut off; `highest`: its own largest."""
        return np.array(self.q) if self.q else octaves(cell, highest)

    def cost(self, cell: Cell, cutoff: float | None) -> Cost:
        """That of the contacts solved on their coarser grids."""
        highest = highest_wave_number(cell) if cutoff is None else cutoff
        cutoffs = self.cutoffs(cell, highest)
        shares = [coarsening(cell, q) ** -2 for q in cutoffs[are_lower(cutoffs, highest)]]
        return Cost(transforms=TRANSFORMS * sum(shares), memory=8 + MEMORY * max(shares, default=0))

    def measure(self, contact: Contact) -> Groups:
        """Solves one contact for each q below the surface's own cut-off.  Collective."""
        surface = contact.surface
        highest = highest_wave_number(surface.cell) if surface.cutoff is None else surface.cutoff
        cutoffs = self.cutoffs(surface.cell, highest)
        areas = np.empty((len(cutoffs), 2))
        areas[:] = contact.area.fraction, contact.area.corrected  # of the surface with all its modes
        lower = are_lower(cutoffs, highest)
        areas[lower] = lowpass_areas(contact, cutoffs[lower])
        return {"lowpass_area": {"q": cutoffs, "area": areas[:, 0], "area_corrected": areas[:, 1]}}


def are_lower(cutoffs: np.ndarray, highest: float) -> np.ndarray:
    """Whether a surface with modes up to `highest` has any beyond each cut-off."""
    return cutoffs < highest * (1 - 1e-9)


def highest_wave_number(cell: Cell) -> float:
    """|q| beyond which a grid has no modes, that of its corners."""
    return math.hypot(*(math.pi / spacing for spacing in cell.spacings))


def octaves(cell: Cell, highest: float) -> np.ndarray:
    """Cut-offs that double from the wave number of the cell's longest wave; the last one is `highest`."""
    lowest = 2 * math.pi / max(cell.lengths)
    if highest <= lowest:
        return np.array([lowest])
    cutoffs = lowest * 2.0 ** np.arange(max(math.ceil(math.log2(highest / lowest) - 1e-9), 0) + 1)
    return np.append(cutoffs[:-1], highest)


def coarsening(cell: Cell, cutoff: float) -> int:
    """The largest power of two by which the grid may be coarsened so that waves up to `cutoff` are resolved."""
    points = 2 * math.pi / (cutoff * max(cell.spacings)) * (1 + 1e-9)  # of the full grid per shortest wavelength
    factor = 1
    while points >= 2 * factor * POINTS_PER_WAVE and min(cell.shape) >= 2 * factor * POINTS_PER_WAVE:
        factor *= 2
    return 2 if factor == 1 and points >= 2 * FEWEST_POINTS and min(cell.shape) >= 2 * POINTS_PER_WAVE else factor


BANDWIDTH = 2.0
"""Assumed ratio of the highest wave number to √(Σ q⁴|h̃|² / Σ q²|h̃|²).  For broad self-affine spectra it is
√((4−2H)/(2−2H)): 1.6 for H = .3, 2.4 for H = .8."""


def lowpass_areas(contact: Contact, cutoffs: np.ndarray) -> np.ndarray:
    """Relative contact area, of the pixels and inside the line, without modes |q| > each cutoff: (cutoffs, 2), NaN
    where the contact cannot be solved.  Contacts on the full grid start from the given one.  Collective.
    """
    problem, solve, areas = contact.problem, contact.surface.solve, np.empty((len(cutoffs), 2))
    factors = np.array([coarsening(contact.surface.cell, q) for q in cutoffs])
    for factor in np.unique(factors):
        chosen = factors == factor
        if factor == 1:
            areas[chosen] = _areas(problem, cutoffs[chosen], solve, contact.pressure)
        else:
            areas[chosen] = _on_coarser(problem, cutoffs[chosen], solve, int(factor))
    return areas


def _on_coarser(problem: ContactProblem, cutoffs: np.ndarray, solve: Solve, factor: int) -> np.ndarray:
    """The areas on the grid that is coarsened by `factor`, a power of 2.  Collective."""
    coarse = SubGrid.coarse(problem.grid, factor)
    heights = restrict(problem.grid, coarse, problem.heights)
    areas = coarse.on_all(lambda grid: _areas(problem.on(grid, heights), cutoffs, solve))
    coarse.free()
    return areas


def _areas(
    problem: ContactProblem, cutoffs: np.ndarray, solve: Solve, start: np.ndarray | None = None
) -> np.ndarray:
    """Those of one grid, (cutoffs, 2); each contact starts from `start`, else from the one before.  Collective."""
    grid, areas, before = problem.grid, np.ones((len(cutoffs), 2)), start
    for index, cutoff in enumerate(cutoffs):
        smooth = problem.on(grid, lowpass(grid, problem.heights, cutoff))
        if touches_fully(smooth):
            continue
        solution = solve(smooth, start=before)
        if solution is None:
            areas[index] = np.nan
            continue
        per_pixel = cutoff * max(grid.spacing)
        line = line_of(smooth, solution, per_pixel <= RESOLVED)
        steps = staircase(smooth, per_pixel / BANDWIDTH)
        area = contact_area(grid, solution.pressure_in_contact(), line, smooth.least_area, steps)
        areas[index] = area.fraction, area.corrected
        before = solution.pressure if start is None else start
    return areas


def touches_fully(problem: ContactProblem) -> bool:
    """Whether the pressure of full contact, p̄ + Kh, is nowhere negative: contact is then full.  Collective.

    One transform.  Solvers need not treat a surface that is flat up to rounding, whose energy they cannot certify.
    """
    grid, least = problem.grid, dict[int, float]()

    def keep(first: int, stop: int, rows: np.ndarray) -> None:
        least[first] = float(rows.min())

    stiffness = problem.solid.apply_stiffness(grid, np.float64, 1 / grid.size)
    grid.convolve(source(problem.heights), stiffness, keep)
    return problem.mean_pressure + grid.reduction.min(list(least.values())) >= 0


def lowpass(grid: SlabGrid, field: np.ndarray, cutoff: float) -> np.ndarray:
    """The field (nx_local, ny) without its modes |q| > cutoff.  One transform.  Collective."""
    out, limit = np.empty(grid.local_shape), (cutoff * (1 + 1e-9)) ** 2

    def cut(block: np.ndarray, first: int, stop: int) -> None:
        block[grid.q_squared(first, stop) > limit] = 0

    def keep(first: int, stop: int, rows: np.ndarray) -> None:
        np.divide(rows, float(grid.size), out=out[first:stop])

    grid.convolve(source(field), cut, keep)
    return out
