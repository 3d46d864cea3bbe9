"""Whether contact and gap percolate, the narrowest place of the widest path through the gap, and the
load at which the gap ceases to percolate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pgfmd.errors import InputError
from pgfmd.grid.cell import Cell
from pgfmd.grid.grid_cost import Cost
from pgfmd.observables.observable import Observable
from pgfmd.observables.schema import TABLE, Dataset, Groups

if TYPE_CHECKING:
    from pgfmd.observables.contact import Contact


@dataclass(frozen=True, kw_only=True)
class Percolation(Observable):
    """Whether a path in the contact, over edges and corners, or one in the gap, over edges, winds around the periodic
    cell.  The critical constriction is the least gap on the path along which the least gap is largest.
    """

    name = "percolation"
    needs_period = "paths wind around the cell"
    layout = {
        TABLE: {
            **{
                f"{part}_percolates_{axis}": Dataset("1", f"1: a path in the {part} winds around the cell along {axis}")
                for part in ("contact", "gap")
                for axis in "xy"
            },
            **{
                f"constriction_{axis}": Dataset("{length}", f"critical constriction of paths along {axis}; 0: no path")
                for axis in "xy"
            },
        },
        "percolation": {
            **{
                f"constriction_{axis}_{place}": Dataset("1", f"its {place}, of paths along {axis}; −1: no path")
                for axis in "xy"
                for place in ("row", "column")
            },
            "labellings": Dataset("1", "labellings of the grid that both constrictions took"),
        },
    }

    def cost(self, cell: Cell, cutoff: float | None) -> Cost:
        """Some labellings, fields of labels and shifts, and what is gathered, as measured at 512² … 2048²."""
        gathered = min(1.0, 1e5 / math.prod(cell.n))
        return Cost(transforms=17.0 + 100 * gathered, memory=70.0 + 400 * gathered)

    def measure(self, contact: Contact) -> Groups:
        """Labels the contact and the gap.  Collective."""
        from pgfmd.observables.bottleneck import bottlenecks, percolates

        found = bottlenecks(contact.grid, contact.gap, contact.contact_pressure <= 0)
        touching = percolates(contact.labels(8))
        numbers: dict[str, float] = {}
        at: dict[str, np.ndarray] = {"labellings": np.array(found[0].labellings)}
        for axis, solid, open_ in zip("xy", touching, found, strict=True):
            numbers |= {f"contact_percolates_{axis}": solid, f"gap_percolates_{axis}": open_.value > 0}
            numbers[f"constriction_{axis}"] = open_.value
            for place, index in zip(("row", "column"), open_.point, strict=True):
                at[f"constriction_{axis}_{place}"] = np.array(index)
        return {TABLE: {name: np.array(float(value)) for name, value in numbers.items()}, "percolation": at}


COLUMNS = {
    "closing_pressure_lower": Dataset("{pressure}", "highest mean pressure found at which the gap percolates"),
    "closing_pressure_upper": Dataset("{pressure}", "lowest mean pressure found at which it does not"),
}


@dataclass(frozen=True, kw_only=True)
class ClosingLoad(Observable):
    """The loads between which the gap ceases to percolate; in every run that imposes load.percolation."""

    name = "closing_load"
    needs_period = "paths wind around the cell"
    layout = {TABLE: COLUMNS}

    def measure(self, contact: Contact) -> Groups:
        """As the search found."""
        if not contact.details.keys() >= COLUMNS.keys():
            raise InputError("output.observables: closing_load needs load.percolation")
        return {TABLE: {name: np.array(contact.details[name]) for name in COLUMNS}}
