"""The skewness of the pressure."""

import math
from dataclasses import dataclass

import numpy as np

from pgfmd.observables.contact import Contact
from pgfmd.observables.observable import Observable
from pgfmd.observables.schema import Dataset, Groups

NARROWEST = 1e-12  # standard deviation over mean below which differences from the mean (rounded to 1e-16) say nothing


@dataclass(frozen=True, kw_only=True)
class PressureSkewness(Observable):
    """⟨(p − σ_c)³⟩_c / ⟨(p − σ_c)²⟩_c^(3/2) over the points in contact, σ_c = ⟨p⟩_c; NaN if all bear the same."""

    name = "pressure_skewness"
    layout = {"loads": {"pressure_skewness": Dataset("1", "skewness of the pressure over the contact")}}

    def measure(self, contact: Contact) -> Groups:
        """Two passes over the pressure.  Collective."""
        grid, pressure, points = contact.grid, contact.contact_pressure, contact.area.pixels
        mean = grid.reduction.sum(pressure) / points if points else math.nan

        def central(first: int, stop: int) -> tuple[float, float]:
            rows = pressure[first:stop]
            x = rows[rows > 0] / mean - 1
            return float(np.sum(x**2)), float(np.sum(x**3))

        parts = grid.threads.collect(central, len(pressure))
        second, third = grid.reduction.sums(*np.sum(parts, axis=0)) / max(points, 1)
        skewness = third / second**1.5 if second > NARROWEST**2 else math.nan
        return {"loads": {"pressure_skewness": np.array(skewness)}}
