"""The error bar of the grid: how far the numbers of a load are from those of an infinitely fine grid."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pgfmd.grid.cell import Cell
from pgfmd.grid.cost import Cost
from pgfmd.io.schema import Dataset, Groups
from pgfmd.observables.observable import Observable

if TYPE_CHECKING:
    from pgfmd.observables.measured_contact import MeasuredContact


@dataclass(frozen=True, kw_only=True)
class Discretisation(Observable):
    """Estimated discretisation errors of the numbers of a load, from a second contact on a grid with half as many
    points each way.

    An estimate is no bound.  On surfaces with many contacts it is at least as large as the true error in nine cases of
    ten, and the median ratio is about three (`statistics.grid_error`).  With a single contact, both grids may agree by
    chance.  NaN where roughness goes down to the pixel: there is no limit of fine grids.
    """

    name = "discretisation"
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
        from pgfmd.observables.statistics.grid_error import FACTORS, grid_errors

        problem, solution, area = contact.problem, contact.solution, contact.area
        errors = dict.fromkeys(FACTORS, math.nan)
        if contact.surface.is_smooth:
            errors = grid_errors(problem, solution, contact.line, contact.solve)
        pressure, grid = solution.pressure, problem.grid
        square = grid.reduction.dot(pressure, pressure) / grid.size
        per_area = contact.kappa / (area.fraction or math.nan)
        found = {
            "contact_area_corrected_error": errors["area"],
            "contact_perimeter_error": errors["perimeter"],
            "kappa_error": per_area * (abs(area.fraction - area.corrected) + errors["area"]),
            "mean_gap_error": errors["mean_gap"],
            "elastic_energy_error": errors["elastic_energy"],
            "mean_square_pressure": square,
            "mean_square_pressure_error": errors["mean_square_pressure"],
        }
        return {"discretisation": {name: np.array(value) for name, value in found.items()}}
