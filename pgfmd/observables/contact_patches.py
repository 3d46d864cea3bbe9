"""The contact patches: connected sets of grid points in contact."""

from dataclasses import dataclass

from pgfmd.grid.grid_cost import Cost
from pgfmd.observables.contact import Contact
from pgfmd.observables.observable import Observable
from pgfmd.observables.schema import Dataset, Groups
from pgfmd.options.rules import choice
from pgfmd.options.section import key

PATCH = ("patch",)
SHAPES = {
    "patch": Dataset("1", "number of the patch, as in the field labels", PATCH),
    "area": Dataset("{length}^2", "area", PATCH),
    "perimeter": Dataset("{length}", "perimeter along pixel edges", PATCH),
    "extent_x": Dataset("{length}", "extent in x, periodic", PATCH),
    "extent_y": Dataset("{length}", "extent in y, periodic", PATCH),
    "percolates_x": Dataset("1", "1 if connected to its own periodic image along x", PATCH),
    "percolates_y": Dataset("1", "1 if connected to its own periodic image along y", PATCH),
}
LOADS = {
    "load": Dataset("{pressure}*{length}^2", "load", PATCH),
    "mean_pressure": Dataset("{pressure}", "mean pressure", PATCH),
    "peak_pressure": Dataset("{pressure}", "peak pressure", PATCH),
}
LINES = {
    "area_corrected": Dataset("{length}^2", "area inside the contact line between pixels; area if none", PATCH),
    "perimeter_corrected": Dataset("{length}", "length of the contact line; as perimeter if it holds none", PATCH),
}


@dataclass(frozen=True, kw_only=True)
class ContactPatches(Observable):
    """A table of the contact patches, one entry each, in the order of the numbers in the field `labels`."""

    name = "patches"
    usual_cost = Cost(memory=2.0)  # a mask and the runs of points in contact in each row
    layout = {"patches": {**SHAPES, **LOADS, **LINES}}

    connectivity: int = key(choice(8, 4), 8, "8: points are neighbours over edges and corners; 4: over edges")

    def measure(self, contact: Contact) -> Groups:
        """The table on rank 0, empty elsewhere.  Collective."""
        return {"patches": contact.patches(contact.labels(self.connectivity), contact.pressure)}
