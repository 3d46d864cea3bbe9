"""What a contact is measured by: the columns of the table of loads, the fields, and types that describe datasets.

What an observable writes is described in its own file (`observables/NAME.py`).  Units are written with {length} and
{pressure}, which stand for the names of units that a job gives.
"""

from collections.abc import Container, Mapping
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Dataset:
    """One dataset of a group: its unit, what it is, and the datasets that hold the coordinates along its axes."""

    unit: str
    description: str
    axes: tuple[str, ...] = ()


GroupLayout = Mapping[str, Mapping[str, Dataset]]
"""What the groups of one load may hold: group → dataset → description."""
Groups = Mapping[str, Mapping[str, np.ndarray]]
"""The groups of one load: group → dataset → values."""

TABLE = "loads"
"""The table of loads, one row per load: a group of its own in observables.h5.  An observable that has this group in its
layout adds columns to the table: one number per load.  NAME_error is the error of NAME."""


def is_error(name: str, columns: Container[str]) -> bool:
    """Whether a column holds the errors of another one."""
    return name.endswith("_error") and name.removesuffix("_error") in columns


# The columns of the table of loads that every run has, in this order.
LOADS: dict[str, Dataset] = {
    "target": Dataset("as asked", "what was asked for: the entry of the list in [load], in its unit"),
    "mean_pressure": Dataset("{pressure}", "mean pressure p̄"),
    "contact_area": Dataset(
        "1", "relative contact area f_c: share of points in contact, as the law defines it (hard: p > 0)"
    ),
    "contact_area_corrected": Dataset("1", "area inside the contact line; without one, of pixels less their staircase"),
    "contact_perimeter": Dataset(
        "1/({length})", "length of the contact line, or of the pixels' edges, per area of the cell"
    ),
    "contact_line": Dataset(
        "1", "1: there is a contact line; 0: none, as roughness reaches the pixel or all is touched"
    ),
    "kappa": Dataset("1", "f_c E' g_rms / p̄, with g_rms the rms slope"),
    "mean_gap": Dataset("{length}", "mean gap"),
    "mean_plastic_depth": Dataset(
        "{length}", "volume by which a wall of limited hardness has yielded, per area of the cell"
    ),
    "displacement": Dataset(
        "{length}", "approach of the solid's far side from where the flat solid touches the summit"
    ),
    "elastic_energy": Dataset(
        "{pressure}*{length}", "elastic energy per area of the cell, without a periodic slab's mean compression"
    ),
    "certified_error": Dataset("1", "upper bound of the energy error over twice the elastic energy"),
    "pressure_error": Dataset("1", "estimated rms error of the pressure over its rms value; NaN: none is known"),
    "max_violation": Dataset("1", "largest of |gap| in contact and penetration outside, over the rms height"),
    "iterations": Dataset("1", "iterations of the solver"),
    "transforms": Dataset("1", "work, in forward + backward transforms of the full grid in double precision"),
    "seconds": Dataset("s", "wall time of the solution"),
}

FIELDS = {
    "height": Dataset("{length}", "heights of the rigid surface, peaks positive"),
    "pressure": Dataset("{pressure}", "contact pressure"),
    "gap": Dataset("{length}", "gap between solid and surface"),
    "plastic_depth": Dataset("{length}", "depth by which the surface has yielded, under limited hardness"),
    "displacement": Dataset("{length}", "displacement of the solid's surface"),
    "labels": Dataset("1", "number of the contact patch, counted from 1; 0: no contact"),
    "current_density": Dataset("1", "current through the contact over its mean, at fixed contact (stiffness)"),
    "flux_x": Dataset("{length}^3", "x component of the flow, × 12 viscosity/mean gradient, balanced (leakage)"),
    "flux_y": Dataset("{length}^3", "y component of that flow"),
    "von_mises": Dataset("{pressure}", "von Mises stress at the depth where it is largest (subsurface)"),
    "traction": Dataset("{pressure}", "tangential traction along x (partial_slip)"),
}
