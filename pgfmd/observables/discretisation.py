"""Error bars: how far the numbers of a load are from those of an exact solution on an infinitely fine grid."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pgfmd.grid.cell import Cell
from pgfmd.grid.cost import Cost
from pgfmd.observables.observable import Observable
from pgfmd.observables.schema import Dataset, Groups

if TYPE_CHECKING:
    from pgfmd.observables.measured_contact import MeasuredContact


@dataclass(frozen=True, kw_only=True)
class Discretisation(Observable):
    """Estimated errors of the numbers of a load, by the grid and by the solver.

    That of the area follows from the contact itself (`statistics.contact_area`).  The grid's part of the others comes
    from a second contact on a grid with half as many points each way or, where the grid does not resolve the surface,
    from its spectrum (`statistics.grid_error`).  An estimate is no bound.  On surfaces with many contacts it is at
    least as large as the true error in nine cases of ten (area: 19 of 20), and the median ratio is about three.  With
    a single contact, both grids may agree by chance.
    """

    name = "discretisation"
    attraction = False
    where = "output.discretisation"
    layout = {
        "discretisation": {
            "contact_area_corrected_error": Dataset("1", "estimated error of contact_area_corrected"),
            "contact_perimeter_error": Dataset("1/({length})", "estimated error of contact_perimeter"),
            "kappa_error": Dataset("1", "estimated error of kappa, which counts pixels"),
            "mean_gap_error": Dataset("{length}", "estimated error of mean_gap"),
            "elastic_energy_error": Dataset("{pressure}*{length}", "estimated error of elastic_energy"),
            "mean_square_pressure": Dataset("{pressure}^2", "⟨p²⟩"),
            "mean_square_pressure_error": Dataset("{pressure}^2", "estimated error of mean_square_pressure"),
        }
    }

    def cost(self, cell: Cell, cutoff: float | None) -> Cost:
        """A contact on a quarter of the points: up to 20 transforms and 60 bytes per point there."""
        return Cost(transforms=5.0, memory=15.0)

    def measure(self, contact: MeasuredContact) -> Groups:
        """Solves the second contact, if there is one to compare with.  Collective."""
        from pgfmd.observables.statistics.grid_error import band_errors, grid_errors, solver_errors

        problem, solution, area, square = contact.problem, contact.solution, contact.area, contact.mean_square_pressure
        if contact.surface.is_smooth:
            errors = grid_errors(problem, solution, contact.line, contact.solve)
        else:
            errors = band_errors(problem.grid, solution, area, contact.surface.roughness, square)
        others = solver_errors(problem, solution, area, contact.pressure_error, square)
        both = {name: math.hypot(error, others[name]) for name, error in errors.items()}
        per_area = contact.kappa / (area.fraction or math.nan)
        found = {
            "contact_area_corrected_error": contact.area_error,
            "contact_perimeter_error": both["perimeter"],
            "kappa_error": per_area * (abs(area.fraction - area.corrected) + contact.area_error),
            "mean_gap_error": both["mean_gap"],
            "elastic_energy_error": both["elastic_energy"],
            "mean_square_pressure": square,
            "mean_square_pressure_error": both["mean_square_pressure"],
        }
        return {"discretisation": {name: np.array(value) for name, value in found.items()}}
