"""Stiffness of the interface at fixed contact, with bounds, and its electrical or thermal conductance."""

import math
from dataclasses import dataclass

import numpy as np

from pgfmd.errors import InputError
from pgfmd.grid.cell import Cell
from pgfmd.grid.domain import Domain
from pgfmd.grid.grid_cost import Cost
from pgfmd.observables.contact import Contact
from pgfmd.observables.discretisation import on_half_grid
from pgfmd.observables.observable import Observable, is_rough
from pgfmd.observables.schema import TABLE, Dataset, Groups
from pgfmd.options.rules import POSITIVE, flag, number, pair
from pgfmd.options.section import key
from pgfmd.physics.laws.law import ContactLaw
from pgfmd.physics.solids.solid import Solid
from pgfmd.solvers.fixed_contact import increment

UNIT, CONDUCTANCE = "{pressure}/({length})", "conductivity/({length})"


@dataclass(frozen=True, kw_only=True)
class Stiffness(Observable):
    """K = −dp̄/dū, pressure per change of the mean gap ū, while the contact stays as it is; bounded from both sides.

    On an open patch K = dp̄/d(approach); times its area, force per length.

    With conductivities σ₁ and σ₂ of the two bodies, the constriction of current in the contact has the conductance
    2K/(E'(1/σ₁ + 1/σ₂)) per area (Barber 2003, doi:10.1098/rspa.2002.1038), in units of a conductivity per length.
    """

    name = "stiffness"
    attraction = False
    fields = ("current_density",)
    layout = {
        TABLE: {
            "stiffness": Dataset(UNIT, "K = −dp̄/d(mean gap) at fixed contact (open: dp̄/d(approach)), middle of bounds"),
            "stiffness_error": Dataset(UNIT, "half the width of its bounds; with half_grid the pixel's error as well"),
            "stiffness_with_bulk": Dataset(UNIT, "dp̄/d(displacement): in series with the mean mode of a slab"),
            "conductance": Dataset(CONDUCTANCE, "of the constriction, per area; NaN without conductivities"),
            "conductance_error": Dataset(CONDUCTANCE, "as of the stiffness"),
        },
        "stiffness": {
            "lower": Dataset(UNIT, "bound of K from below, on this grid"),
            "upper": Dataset(UNIT, "bound of K from above"),
            "transforms": Dataset("1", "work, in transform pairs in double precision"),
        },
    }

    width: float = key(number(above=0, below=1), 1e-3, "relative, asked of the bounds; rounding may widen it", unit="1")
    half_grid: bool = key(
        flag(), False, "also solve a grid with half the points each way; the change counts as error, the value stays"
    )
    conductivities: tuple[float, float] | None = key(
        pair(POSITIVE), about="[of one body, of the other], for the conductance", unit="conductivity"
    )

    def cost(self, cell: Cell, cutoff: float | None) -> Cost:
        """Conjugate gradients on the particle–mesh, as measured at 1024²; a mask, the residual, x, and the mesh."""
        return Cost(transforms=(20.0 if is_rough(cell, cutoff) else 8.0) + 5.0 * self.half_grid, memory=20.0)

    def check_in(self, domain: Domain) -> None:
        """Raises InputError for a half grid of an open patch."""
        if self.half_grid and not domain.wraps:
            raise InputError('output.stiffness.half_grid needs boundary = "periodic": Fourier modes coarsen heights')

    def check_contact(self, solid: Solid, law: ContactLaw) -> None:
        """Raises InputError for walls without a stiffness, and for a conductance of what is no half-space."""
        if law.kind not in ("hard", "hardness", "exponential"):
            raise InputError(f"output.stiffness: of walls hard, hardness and exponential, not {law.kind}")
        if self.conductivities and not math.isinf(getattr(solid, "thickness", 0.0)):
            raise InputError("output.stiffness.conductivities: a conductance follows from the stiffness of half-spaces")

    def measure(self, contact: Contact) -> Groups:
        """Solves for the response at fixed contact.  Collective."""
        problem, grid = contact.problem, contact.grid
        found = increment(problem, contact.pressure, self.width)
        contact.keep("current_density", found.pressure)
        value, error = (found.lower + found.upper) / 2, (found.upper - found.lower) / 2
        if math.isinf(found.lower):
            error = 0.0
        if self.half_grid:
            solve, width = contact.surface.solve, self.width
            other = on_half_grid(problem, solve, lambda coarse, found: increment(coarse, found.pressure, width).lower)
            error += abs(value - (math.nan if other is None else other))
        modulus = problem.solid.contact_modulus
        bulk = problem.solid.mean_stiffness() if grid.domain.wraps else 0.0  # an open approach contains it
        factor = 2 / (modulus * sum(1 / each for each in self.conductivities)) if self.conductivities else math.nan
        columns = {
            "stiffness": value,
            "stiffness_error": error,
            "stiffness_with_bulk": 1 / (1 / value + 1 / bulk) if bulk and value else value,
            "conductance": factor * value,
            "conductance_error": factor * error,
        }
        bounds = {"lower": found.lower, "upper": found.upper, "transforms": found.transforms}
        grid.free()
        return {
            group: {name: np.array(number) for name, number in numbers.items()}
            for group, numbers in ((TABLE, columns), ("stiffness", bounds))
        }
