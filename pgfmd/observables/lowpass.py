"""f(q) as solved: the contact area of the surface without its modes beyond q, under the same load."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pgfmd.grid.cell import Cell
from pgfmd.grid.cost import Cost
from pgfmd.observables.observable import Observable
from pgfmd.observables.schema import Dataset, Groups
from pgfmd.options.rules import POSITIVE, many
from pgfmd.options.section import key

if TYPE_CHECKING:
    from pgfmd.observables.measured_contact import MeasuredContact

POINTS_PER_WAVE = 8
"""Least number of grid points per shortest remaining wavelength.  The area inside the contact line is then within .2 %
of that of an infinitely fine grid."""
FEWEST_POINTS = 4
"""Where POINTS_PER_WAVE needs the full grid, it is still coarsened by 2 if at least so many points per wavelength
remain; the area is then within 1 %."""
LOWPASS_TOLERANCE = 1e-6
"""Certified error of the contacts that are solved: their area is then within .1 % of the converged one, mostly within
.03 %.  Measured on eight surfaces of 256² and 1024² points; with 1e-5 areas were up to .3 % too small, with 1e-4
up to .9 %."""
TRANSFORMS = 30
"""Work of one of these contacts, in transforms of the grid on which it is solved."""
MEMORY = 60.0
"""Bytes per point of the grid on which one of them is solved, heights, pressure and gap included."""


@dataclass(frozen=True, kw_only=True)
class Lowpass(Observable):
    """Contact areas of the surface low-passed at each q, at the same load, each solved on the coarsest grid that
    resolves it.
    """

    name = "lowpass"
    attraction = False
    where = "output.lowpass"
    layout = {
        "lowpass_area": {
            "q": Dataset("1/({length})", "cut-off wave number, radians per length", ("q",)),
            "area": Dataset("1", "relative contact area f_c without modes beyond q; NaN: not certified", ("q",)),
            "area_corrected": Dataset("1", "f_c inside the contact line, as contact_area_corrected", ("q",)),
        }
    }

    q: tuple[float, ...] = key(
        many(POSITIVE),
        (),
        "cut-offs; empty: doubled from the cell's longest wave to the surface's shortest",
        unit="radians per length",
    )

    def cutoffs(self, cell: Cell, highest: float) -> np.ndarray:
        """The wave numbers at which the surface is cut off; `highest`: its own largest."""
        return np.array(self.q) if self.q else octaves(cell, highest)

    def cost(self, cell: Cell, cutoff: float | None) -> Cost:
        """That of the contacts solved on their coarser grids."""
        highest = highest_wave_number(cell) if cutoff is None else cutoff
        shares = [coarsening(cell, q) ** -2 for q in self.cutoffs(cell, highest) if is_lower(q, highest)]
        return Cost(transforms=TRANSFORMS * sum(shares), memory=8 + MEMORY * max(shares, default=0))

    def measure(self, contact: MeasuredContact) -> Groups:
        """Solves one contact for each q below the surface's own cut-off.  Collective."""
        from pgfmd.observables.statistics.lowpass import lowpass_areas

        surface, solution = contact.surface, contact.solution
        highest = highest_wave_number(surface.cell) if surface.cutoff is None else surface.cutoff
        cutoffs = self.cutoffs(surface.cell, highest)
        areas = np.empty((len(cutoffs), 2))
        areas[:] = contact.area.fraction, contact.area.corrected  # of the surface with all its modes
        lower = [index for index, q in enumerate(cutoffs) if is_lower(q, highest)]
        coarse = [(coarsening(surface.cell, cutoffs[index]), cutoffs[index]) for index in lower]
        areas[lower] = lowpass_areas(contact.problem, coarse, contact.solve, solution.pressure)
        return {"lowpass_area": {"q": cutoffs, "area": areas[:, 0], "area_corrected": areas[:, 1]}}


def is_lower(cutoff: float, highest: float) -> bool:
    """Whether a surface with modes up to `highest` has any beyond the cut-off."""
    return cutoff < highest * (1 - 1e-9)


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
