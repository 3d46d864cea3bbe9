"""Autocorrelations of stress, contact and heights."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pgfmd.grid.cell import Cell
from pgfmd.grid.cost import Cost
from pgfmd.observables.observable import Observable, correlation_layout
from pgfmd.observables.schema import Groups
from pgfmd.observables.statistics.spectra import lag_bins
from pgfmd.options.rules import choice, integer
from pgfmd.options.section import key

if TYPE_CHECKING:
    from pgfmd.observables.measured_contact import MeasuredContact


def acf_layout(name: str, unit: str, what: str) -> dict:
    """The three groups of one autocorrelation."""
    ways = {"": "averaged over direction", "_x": "along x", "_y": "along y"}
    return {f"{name}_acf{way}": correlation_layout(unit, f"{what}, {how}") for way, how in ways.items()}


@dataclass(frozen=True, kw_only=True)
class Acf(Observable):
    """⟨f(r) f(r + Δr)⟩ over all points r, for the pressure, the contact (1 in contact, 0 outside) and the heights: mean
    over the Δr of each bin of |Δr|, and along both axes.
    """

    name = "acf"
    where = "output.acf"
    layout = {
        **acf_layout("stress", "{pressure}^2", "stress autocorrelation ⟨σ(r) σ(r')⟩"),
        **acf_layout("contact", "1", "contact autocorrelation ⟨Θ(r) Θ(r')⟩"),
        **acf_layout("height", "{length}^2", "height autocorrelation ⟨h(r) h(r')⟩"),
    }

    spacing: str = key(choice("log", "linear"), "log", "of the bins of |Δr|")
    bins: int = key(integer(1, 10**6), 20, "per decade (log), or up to half the shorter side of the cell (linear)")

    def edges(self, cell: Cell) -> np.ndarray:
        """Edges of the bins of |Δr|."""
        return lag_bins(cell.shape, cell.lengths, self.spacing, self.bins)

    def cost(self, cell: Cell, cutoff: float | None) -> Cost:
        """A transform each for the pressure and the contact."""
        return Cost(transforms=2.0)

    def measure(self, contact: MeasuredContact) -> Groups:
        """Shares its transforms with the spectra.  Collective."""
        found = {"stress": contact.stress, "contact": contact.indicator, "height": contact.surface.correlations}
        groups: dict = {}
        for name, correlations in found.items():
            groups |= contact.surface.acf_groups(name, correlations)
        return groups
