"""The rms slope of the gap."""

import math
from dataclasses import dataclass

import numpy as np

from pgfmd.grid.grid_cost import Cost
from pgfmd.grid.transforms import source
from pgfmd.observables.contact import Contact
from pgfmd.observables.observable import Observable
from pgfmd.observables.rough_surface import squared
from pgfmd.observables.schema import Dataset, Groups


@dataclass(frozen=True, kw_only=True)
class GapSlope(Observable):
    """√⟨|∇g|²⟩ = √Σ q²|g̃(q)|² over all modes of the gap, points in contact included."""

    name = "gap_slope"
    usual_cost = Cost(transforms=0.5)  # one forward transform
    needs_period = "from the modes of the gap"
    layout = {"loads": {"gap_rms_slope": Dataset("1", "rms slope of the gap over the cell, from its modes")}}

    def measure(self, contact: Contact) -> Groups:
        """One forward transform.  Collective."""
        grid, parts = contact.grid, dict[int, tuple[float]]()
        unit = min(grid.spacing)  # of lengths here, so that no square overflows
        along, across = (unit * grid.qx[0]) ** 2, (unit * grid.qy[:, 0]) ** 2
        weight = grid.hermitian_weight[:, 0]

        def add(block: np.ndarray, first: int, stop: int) -> None:
            power = squared(block)
            parts[first] = (float(weight[first:stop] @ (power @ along + across[first:stop] * power.sum(axis=1))),)

        grid.read_spectrum(source(contact.gap), add)
        (total,) = grid.reduction.sums_of_blocks(parts, 1)
        return {"loads": {"gap_rms_slope": np.array(math.sqrt(total) / grid.size / unit)}}
