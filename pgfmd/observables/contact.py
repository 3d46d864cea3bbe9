"""`Contact`: what `pgfmd.solve` returns, a solved contact that can be measured, drawn and handed on."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from pgfmd.errors import InputError
from pgfmd.observables.observable import Observable
from pgfmd.observables.observable_kinds import OBSERVABLES
from pgfmd.observables.observer import Observer
from pgfmd.observables.schema import FIELDS, LOADS, Groups
from pgfmd.options.section import build
from pgfmd.options.text import guess
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.certify import Projection, certify
from pgfmd.solvers.controls import CONTROLS
from pgfmd.solvers.options import Load
from pgfmd.solvers.solution import ContactSolution
from pgfmd.surfaces.surface import coordinates

if TYPE_CHECKING:
    import matplotlib.axes
    import xarray


@dataclass(repr=False)
class Contact(ContactSolution):
    """A solved contact: fields (nx_local, ny), numbers that are the same on all ranks, and what is measured on it.

    Nothing is measured before it is asked for.  A measurement sets up the transforms of the grid, and frees them.

    >>> import numpy as np, pgfmd
    >>> wave = np.cos(2 * np.pi * np.arange(64) / 64)
    >>> contact = pgfmd.solve(wave[:, None] * wave, 0.01)
    >>> contact
    contact of 64 × 64 points: mean pressure 0.01, mean gap 0.287, contact area 0.2622 (corrected 0.2567)
    >>> histogram = contact.observables("histogram")["pressure_histogram"]
    >>> float(histogram["count"].sum()) == contact.contact_area * 64**2
    True
    """

    problem: ContactProblem = field(kw_only=True)
    displacement: float = field(kw_only=True)

    def __repr__(self) -> str:
        nx, ny = self.problem.grid.shape
        text = f"contact of {nx} × {ny} points: mean pressure {self.mean_pressure:.4g}, mean gap {self.mean_gap:.4g}"
        if self.problem.grid.comm.size > 1:  # one rank alone cannot measure
            return text
        return f"{text}, contact area {self.contact_area:.4g} (corrected {self.contact_area_corrected:.4g})"

    @property
    def heights(self) -> np.ndarray:
        """The surface (nx_local, ny), as it was given."""
        return self.problem.heights

    @property
    def force(self) -> float:
        """Total force: mean pressure times the area of the cell."""
        return self.mean_pressure * math.prod(self.problem.grid.lengths)

    @cached_property
    def _measured(self) -> tuple[dict[str, float], float]:
        """The numbers, and the error of the area."""
        observer = Observer(self.problem)
        contact = observer.contact(self)
        row = {"displacement": self.displacement} | observer.row(contact)
        self.problem.grid.free()
        return {name: row[name] for name in LOADS if name in row}, contact.area_error

    @property
    def numbers(self) -> dict[str, float]:
        """The numbers that a run writes for each load, by their names in its table.  Collective on first use."""
        return self._measured[0]

    @property
    def contact_area(self) -> float:
        """Relative contact area: share of the points in contact.  Collective on first use."""
        return self.numbers["contact_area"]

    @property
    def contact_area_corrected(self) -> float:
        """Relative area inside the contact line between pixels; where the grid does not resolve the surface, that of
        the pixels less their staircase (`numbers["contact_line"]` is then 0).  Collective on first use.
        """
        return self.numbers["contact_area_corrected"]

    @property
    def contact_area_error(self) -> float:
        """Error bar of `contact_area_corrected`, by the grid and by the solver.  Collective on first use."""
        return self._measured[1]

    def observables(self, *names: str, **options: Mapping[str, Any]) -> Groups:
        """Curves and tables, group → dataset → array, as `Results` gives those of a load; on rank 0.  Numbers that
        observables add to the table of loads are in the group "loads", on all ranks.  Collective.

        names: observables, as a job lists them; options: further ones with their keys, `spectra={"bins": 10}`.  Raises
        InputError for an unknown observable or key.
        """
        observer = Observer(self.problem, _asked(dict.fromkeys(names, {}) | options))
        groups = observer.groups(observer.contact(self))
        self.problem.grid.free()
        return groups

    def plot(self, axes: matplotlib.axes.Axes | None = None) -> matplotlib.axes.Axes:
        """Draw the surface in grey, and the pressure where it touches; x to the right, y upwards.  For one process.

        axes: of matplotlib, to draw in; new ones if not given.  Returns them.
        """
        import matplotlib.pyplot as plt

        grid = self.problem.grid
        if grid.comm.size > 1:
            raise InputError("plot: this process holds a part of the contact; solve in one process, or draw a run")
        axes = plt.subplots()[1] if axes is None else axes
        extent = (0.0, grid.lengths[0], 0.0, grid.lengths[1])
        pressure = np.ma.masked_less_equal(self.pressure_in_contact(), 0.0)
        axes.imshow(self.heights.T, cmap="gray", origin="lower", extent=extent)
        image = axes.imshow(pressure.T, cmap="inferno", origin="lower", extent=extent, interpolation="nearest", vmin=0)
        plt.colorbar(image, ax=axes, label="pressure")
        axes.set(xlabel="x", ylabel="y", title=f"contact on {100 * self.contact_area:.2g} % of the surface")
        return axes

    def to_xarray(self) -> xarray.Dataset:
        """The fields of this rank with named axes and coordinates, the numbers as attributes.  Collective on first use
        of the numbers.
        """
        import xarray

        x, y = coordinates(self.problem.grid)
        fields = {"height": self.heights, "pressure": self.pressure, "gap": self.gap}
        if self.problem.law.highest < math.inf:
            fields["plastic_depth"] = self.plastic_depth
        about = {name: {"description": FIELDS[name].description} for name in fields}
        described = {name: (("x", "y"), values, about[name]) for name, values in fields.items()}
        return xarray.Dataset(described, {"x": x[:, 0], "y": y[0]}, self.numbers)


@dataclass(repr=False)
class Certified(Contact):
    """A pressure from anywhere, certified: `certified_error` bounds the energy error of what its projection gives.

    projection: how it was made feasible.  Pressures that are traces beside the contact, certified too, are then 0.
    """

    projection: Projection = field(kw_only=True)

    def summary(self) -> dict[str, float]:
        """The numbers of the certificate, and the contact area.  Collective on first use."""
        return {
            "certified_error": self.certified_error,
            "pressure_error": self.pressure_error,
            "mean_pressure": self.mean_pressure,
            "contact_area": self.contact_area,
            "contact_area_corrected": self.contact_area_corrected,
            "contact_area_error": self.contact_area_error,
            "given_mean_pressure": self.projection.given_mean,
            "projection": self.projection.change,
            "load_outside": self.projection.outside,
        }


def certified(problem: ContactProblem, given: np.ndarray, mean_pressure: float | None = None) -> Certified:
    """`solvers.certify.certify`, as a contact to be measured.  Collective."""
    with problem.grid.freed():
        found, projection = certify(problem, given, mean_pressure)
        problem = problem.at(found.mean_pressure)
        displacement = CONTROLS["pressure"](problem, Load(pressure=(found.mean_pressure,))).displacement(found)
    return Certified(**vars(found), problem=problem, displacement=displacement, projection=projection)


def _asked(options: Mapping[str, Mapping[str, Any]]) -> Iterable[Observable]:
    """The observables of those names with those keys; raises InputError."""
    for name, keys in options.items():
        if name not in OBSERVABLES:
            raise InputError(f"observable {name!r} is not known{guess(name, list(OBSERVABLES))}")
        observable = build(OBSERVABLES[name], dict(keys))
        assert isinstance(observable, Observable)
        yield observable
