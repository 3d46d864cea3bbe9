"""The distributions of pressure and gap."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from pgfmd.observables.observable import Observable
from pgfmd.observables.schema import Dataset, Groups
from pgfmd.options.rules import integer
from pgfmd.options.section import key

if TYPE_CHECKING:
    from pgfmd.observables.measured_contact import MeasuredContact


def _layout(unit: str, what: str) -> dict[str, Dataset]:
    return {
        "edges": Dataset(unit, f"bin edges of {what}", ("edges",)),
        "center": Dataset(unit, "middle of each bin", ("center",)),
        "density": Dataset(f"1/({unit})", f"probability density of {what}", ("center",)),
        "count": Dataset("1", "points in each bin", ("center",)),
    }


@dataclass(frozen=True, kw_only=True)
class Histogram(Observable):
    """Histograms of the pressure over the contact (bins even in the pressure, and in its logarithm), with its moments
    and the fit of Persson's distribution; histogram of the gap over the points out of contact, whose density integrates
    to 1 − f_c.
    """

    name = "histogram"
    where = "output.histogram"
    layout = {
        "pressure_histogram": _layout("{pressure}", "the pressure over the contact"),
        "pressure_histogram_log": _layout("{pressure}", "the pressure over the contact, bins even in its logarithm"),
        "pressure_moments": {
            "order": Dataset("1", "n of ⟨σⁿ⟩_c / σ_c^n", ("order",)),
            "value": Dataset("1", "moments over the contact, σ_c = p̄/f_c", ("order",)),
        },
        "persson_fit": {
            "width": Dataset("{pressure}", "s of the distribution N(σ; p̄, s) − N(σ; −p̄, s) that fits best"),
            "residual": Dataset("1", "rms deviation of the fit over the rms density"),
        },
        "gap_histogram": _layout("{length}", "the gap over all points, those where it is 0 left out"),
    }

    bins: int = key(
        integer(1, 10**7), 200, "number of bins of pressure and of gap; logarithmic bins: a tenth of it per decade"
    )

    def measure(self, contact: MeasuredContact) -> Groups:
        """Two passes over each field, no transform.  Collective."""
        from pgfmd.observables.statistics.distributions import gap_groups, pressure_groups

        groups = pressure_groups(contact.grid, contact.pressure, self.bins)
        return groups | gap_groups(contact.grid, contact.solution.gap, self.bins)
