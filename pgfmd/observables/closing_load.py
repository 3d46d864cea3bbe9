"""The loads between which the gap ceases to percolate, as the search for them found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pgfmd.errors import InputError
from pgfmd.observables.observable import Observable
from pgfmd.observables.schema import TABLE, Dataset, Groups

if TYPE_CHECKING:
    from pgfmd.observables.contact import Contact

COLUMNS = {
    "closing_pressure_lower": Dataset("{pressure}", "highest mean pressure found at which the gap percolates"),
    "closing_pressure_upper": Dataset("{pressure}", "lowest mean pressure found at which it does not"),
}


@dataclass(frozen=True, kw_only=True)
class ClosingLoad(Observable):
    """The loads between which the gap ceases to percolate; in every run that imposes load.percolation."""

    name = "closing_load"
    where = "output.closing_load"
    needs_period = "paths wind around the cell"
    layout = {TABLE: COLUMNS}

    def measure(self, contact: Contact) -> Groups:
        """As the search found."""
        if not contact.details.keys() >= COLUMNS.keys():
            raise InputError("output.observables: closing_load is that of load.percolation, which is not imposed")
        return {TABLE: {name: np.array(contact.details[name]) for name in COLUMNS}}
