"""`Observable`: base class of the observables (options, datasets, cost, measurement).

Each observable is one file of this folder and one line of `observable_kinds`.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from pgfmd.errors import InputError
from pgfmd.grid.cell import Cell
from pgfmd.grid.domain import Domain
from pgfmd.grid.grid_cost import Cost
from pgfmd.observables.binning import wave_number_bins
from pgfmd.observables.schema import Dataset, GroupLayout, Groups
from pgfmd.options.rules import choice, flag, integer
from pgfmd.options.section import Section, key
from pgfmd.physics.laws.law import ContactLaw
from pgfmd.physics.solids.solid import Solid


@dataclass(frozen=True, kw_only=True)
class Observable(Section):
    """Something that is measured on each solved contact.  Its fields are the keys of the table [output.NAME].

    name: under which a job lists it in `observables`.  layout: the groups of datasets that it may write.  The group
    "loads" stands for columns that it adds to the table of loads: one number per load, NAME_error the error of NAME.
    fields: of `schema.FIELDS`, that it can write.  attraction: whether it can be measured where the wall attracts.
    needs_period: why it is not measured with open boundaries; "" if it is.  needs_double: whether it needs fields
    that are stored in double precision.  usual_cost: what `cost`
    returns unless it is overridden.
    """

    name: ClassVar[str]
    layout: ClassVar[GroupLayout]
    fields: ClassVar[tuple[str, ...]] = ()
    attraction: ClassVar[bool] = True
    needs_period: ClassVar[str] = ""
    needs_double: ClassVar[bool] = False
    usual_cost: ClassVar[Cost] = Cost()

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if "where" not in vars(cls):
            cls.where = f"output.{getattr(cls, 'name', '')}"

    def check_in(self, domain: Domain) -> None:
        """Raises InputError for a domain on which it cannot be measured."""
        if self.needs_period and not domain.wraps:
            why = f'needs a period, not boundary = "open": {self.needs_period}'
            raise InputError(f"output.observables: {self.name} {why}")

    def check_storage(self, double: bool) -> None:
        """Raises InputError if it cannot be measured on fields of that precision."""
        if self.needs_double and not double:
            raise InputError(f'output.observables: {self.name} needs solver.storage = "float64"')

    def cost(self, cell: Cell, cutoff: float | None) -> Cost:
        """What measuring one load costs, at most (what several observables need is computed once).

        cutoff: wave number beyond which the surface has no modes; None: not known, every mode of the grid may count.
        """
        return self.usual_cost

    def check_contact(self, solid: Solid, law: ContactLaw) -> None:
        """Raises InputError if it cannot be measured on contacts of this solid and law."""

    def measure(self, contact: Any) -> Groups:
        """The groups of datasets and columns that it measures on a `Contact`, complete on rank 0.  Collective."""
        raise NotImplementedError


def is_rough(cell: Cell, cutoff: float | None) -> bool:
    """Whether the shortest wave of a surface is below six points, or not known: linear systems then take longer."""
    return cutoff is None or cutoff * max(cell.spacings) > 1


OBSERVABLES: dict[str, type[Observable]] = {}
"""Every observable by name, in the order in which they are measured; `observable_kinds` fills it."""


def layout_of(observables: Iterable[Observable | type[Observable]]) -> GroupLayout:
    """All groups that these observables write."""
    merged: dict[str, dict[str, Dataset]] = {}
    for observable in observables:
        for group, datasets in observable.layout.items():
            merged.setdefault(group, {}).update(datasets)
    return merged


@dataclass(frozen=True, kw_only=True)
class Spectrum(Observable):
    """Means over the modes in bins of |q|."""

    spacing: str = key(choice("log", "linear"), "log", "of the bins of |q|")
    bins: int = key(integer(1, 10**6), 20, "per decade (log), or up to the largest |q| (linear)")
    all_modes: bool = key(flag(), False, "false: bins end at the surface's shortest wave, |q| = 2π/λ_s")

    def edges(self, cell: Cell, cutoff: float | None) -> np.ndarray:
        """Edges of the bins, radians per length; cutoff: |q| of the surface's shortest wave, None: the grid's."""
        q_max = None if self.all_modes else cutoff
        return wave_number_bins(cell.shape, cell.lengths, self.spacing, self.bins, q_max)


def spectrum_layout(unit: str, what: str) -> dict[str, Dataset]:
    """The datasets of a spectrum averaged over direction: q, value, count of the bins that hold modes; all edges."""
    return {
        "q": Dataset("1/({length})", "mean wave number of the bin, radians per length", ("q",)),
        "value": Dataset(unit, f"mean {what}", ("q",)),
        "count": Dataset("1", "modes in the bin, of all directions", ("q",)),
        "edges": Dataset("1/({length})", "edges of all bins", ("edges",)),
    }
