"""The power spectrum of the gap, averaged over direction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from pgfmd.grid.cell import Cell
from pgfmd.grid.cost import Cost
from pgfmd.observables.observable import Spectrum, spectrum_layout
from pgfmd.observables.schema import Groups

if TYPE_CHECKING:
    from pgfmd.observables.measured_contact import MeasuredContact


@dataclass(frozen=True, kw_only=True)
class GapSpectrum(Spectrum):
    """Mean of |g̃(q)|² over the modes in each bin of |q|, g̃(q) = (1/N) Σ g(r) exp(−iq·r) over the N points.

    With all_modes, the means times the counts add up to ⟨g²⟩ − ⟨g⟩².
    """

    name = "gap_spectrum"
    where = "output.gap_spectrum"
    layout = {"gap_spectrum": spectrum_layout("{length}^2", "|g̃|² of the gap")}

    def cost(self, cell: Cell, cutoff: float | None) -> Cost:
        """One forward transform."""
        return Cost(transforms=0.5)

    def measure(self, contact: MeasuredContact) -> Groups:
        """One forward transform.  Collective."""
        from pgfmd.grid.callbacks import source
        from pgfmd.observables.statistics.correlations import correlate

        surface = contact.surface
        modes = surface.rings(self.edges(surface.cell, surface.cutoff))
        found = correlate(surface.grid, source(contact.solution.gap), modes)
        return {"gap_spectrum": modes.means(found.power, "q")}
