"""Power spectra of stress, contact, heights and gap, and autocorrelations, averaged over direction."""

from dataclasses import dataclass

import numpy as np

from pgfmd.grid.cell import Cell
from pgfmd.grid.grid_cost import Cost
from pgfmd.grid.transforms import source
from pgfmd.observables.binning import lag_bins
from pgfmd.observables.contact import Contact
from pgfmd.observables.observable import Observable, Spectrum, spectrum_layout
from pgfmd.observables.rough_surface import correlate
from pgfmd.observables.schema import Dataset, Groups
from pgfmd.options.rules import choice, integer
from pgfmd.options.section import key


@dataclass(frozen=True, kw_only=True)
class Spectra(Spectrum):
    """Mean of |f̃(q)|² over the modes in each bin of |q|, for the pressure, the contact (1 in contact, 0 outside) and
    the heights, of the pressure were the contact full, and of Re h̃* σ̃.

    With open boundaries the field counts as 0 outside, on a torus of twice the points each way; of the heights, which
    do not vanish at the border, there is no spectrum.

    Fourier coefficients are f̃(q) = (1/N) Σ f(r) exp(−iq·r) over the N points, so that Σ |f̃|² over all modes is ⟨f²⟩.
    """

    name = "spectra"
    usual_cost = Cost(transforms=1.5)  # a forward one for the pressure, the contact, and both heights and pressure
    layout = {
        "stress_spectrum": spectrum_layout("{pressure}^2", "|σ̃|² of the pressure"),
        "contact_spectrum": spectrum_layout("1", "|Θ̃|² of the contact"),
        "height_spectrum": spectrum_layout("{length}^2", "|h̃|² of the heights"),
        "full_contact_spectrum": spectrum_layout("{pressure}^2", "|σ̃|² of the pressure were the contact full"),
        "cross_spectrum": spectrum_layout("{pressure}*{length}", "Re h̃* σ̃ of heights and pressure"),
    }

    def measure(self, contact: Contact) -> Groups:
        """Shares its transforms with the autocorrelations.  Collective."""
        surface, modes = contact.surface, contact.surface.modes
        power = {"stress": contact.stress.power, "contact": contact.indicator.power}
        if contact.grid.domain.wraps:
            power |= {"height": surface.correlations.power, "full_contact": surface.full_contact}
            power |= {"cross": contact.cross_power}
        return {f"{name}_spectrum": modes.means(sums, "q") for name, sums in power.items()}


@dataclass(frozen=True, kw_only=True)
class GapSpectrum(Spectrum):
    """Mean of |g̃(q)|² over the modes in each bin of |q|, g̃(q) = (1/N) Σ g(r) exp(−iq·r) over the N points.

    With all_modes, the means times the counts add up to ⟨g²⟩ − ⟨g⟩².
    """

    name = "gap_spectrum"
    usual_cost = Cost(transforms=0.5)  # one forward transform
    needs_period = "the gap does not vanish at the border"
    layout = {"gap_spectrum": spectrum_layout("{length}^2", "|g̃|² of the gap")}

    def measure(self, contact: Contact) -> Groups:
        """One forward transform.  Collective."""
        surface = contact.surface
        modes = surface.rings(self.edges(surface.cell, surface.cutoff))
        found = correlate(surface.grid, source(contact.gap), modes)
        return {"gap_spectrum": modes.means(found.power, "q")}


def acf_layout(name: str, unit: str, what: str) -> dict:
    """The three groups of one autocorrelation: r, value and count of the bins that hold points, edges of all bins."""
    ways = {"": "averaged over direction", "_x": "along x", "_y": "along y"}
    return {
        f"{name}_acf{way}": {
            "r": Dataset("{length}", "mean distance of the points in the bin", ("r",)),
            "value": Dataset(unit, f"{what}, {how}", ("r",)),
            "count": Dataset("1", "points in the bin", ("r",)),
            "edges": Dataset("{length}", "edges of all bins", ("edges",)),
        }
        for way, how in ways.items()
    }


@dataclass(frozen=True, kw_only=True)
class Acf(Observable):
    """⟨f(r) f(r + Δr)⟩ over all points r, for the pressure, the contact (1 in contact, 0 outside) and the heights: mean
    over the Δr of each bin of |Δr|, and along both axes.
    """

    name = "acf"
    usual_cost = Cost(transforms=2.0)  # one each for the pressure and the contact
    needs_period = "mean over all pairs of points at one distance"
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

    def measure(self, contact: Contact) -> Groups:
        """Shares its transforms with the spectra.  Collective."""
        found = {"stress": contact.stress, "contact": contact.indicator, "height": contact.surface.correlations}
        groups: dict = {}
        for name, correlations in found.items():
            groups |= contact.surface.acf_groups(name, correlations)
        return groups
