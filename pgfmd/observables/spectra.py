"""Power spectra of stress, contact and heights, averaged over direction."""

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
class Spectra(Spectrum):
    """Mean of |f̃(q)|² over the modes in each bin of |q|, for the pressure, the contact (1 in contact, 0 outside) and
    the heights, and of Re h̃* σ̃.

    Fourier coefficients are f̃(q) = (1/N) Σ f(r) exp(−iq·r) over the N points, so that Σ |f̃|² over all modes is ⟨f²⟩.
    """

    name = "spectra"
    where = "output.spectra"
    layout = {
        "stress_spectrum": spectrum_layout("{pressure}^2", "|σ̃|² of the pressure"),
        "contact_spectrum": spectrum_layout("1", "|Θ̃|² of the contact"),
        "height_spectrum": spectrum_layout("{length}^2", "|h̃|² of the heights"),
        "cross_spectrum": spectrum_layout("{pressure}*{length}", "Re h̃* σ̃ of heights and pressure"),
    }

    def cost(self, cell: Cell, cutoff: float | None) -> Cost:
        """A forward transform each for the pressure, the contact, and both heights and pressure."""
        return Cost(transforms=1.5)

    def measure(self, contact: MeasuredContact) -> Groups:
        """Shares its transforms with the autocorrelations.  Collective."""
        modes = contact.surface.modes
        power = {
            "stress": contact.stress.power,
            "contact": contact.indicator.power,
            "height": contact.surface.correlations.power,
            "cross": contact.cross_power,
        }
        return {f"{name}_spectrum": modes.means(sums, "q") for name, sums in power.items()}
