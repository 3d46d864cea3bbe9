"""`Contact`: a solved contact, to measure, draw and hand on; `pgfmd.solve` returns it, observables measure it."""

from __future__ import annotations

import dataclasses
import logging
import math
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from pgfmd.errors import InputError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.transforms import source
from pgfmd.observables.contact_area import Area, ContactLine, contact_area, line_of
from pgfmd.observables.contact_line import staircase
from pgfmd.observables.observable import OBSERVABLES, Observable
from pgfmd.observables.patch_table import Labels, label_patches, patch_table
from pgfmd.observables.rough_surface import Correlations, RoughSurface, correlate, indicator
from pgfmd.observables.schema import FIELDS, LOADS, TABLE, Groups
from pgfmd.options.section import build
from pgfmd.options.text import counted, guess
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.certify import Projection, certify
from pgfmd.solvers.controls import CONTROLS
from pgfmd.solvers.options import Load
from pgfmd.solvers.solution import ContactSolution
from pgfmd.surfaces.rigid_surface import coordinates

if TYPE_CHECKING:
    import matplotlib.axes
    import xarray

log = logging.getLogger("pgfmd")
TYPICAL = 1.9  # see `Contact.likely_pressure_error`: the median over 825 solutions; largest 3.4


@dataclass(repr=False)
class Contact(ContactSolution):
    """A solved contact: fields (nx_local, ny), numbers that are the same on all ranks, and what is measured on it.

    Nothing is measured before it is asked for; each measurement is collective on first use.  A contact that does not
    share its surface with others (`of`) sets up the transforms of the grid for a measurement, and frees them.

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
    shared: RoughSurface | None = field(default=None, kw_only=True)
    _kept: dict[str, np.ndarray] = field(default_factory=dict, init=False)
    _labels: dict[int, Labels] = field(default_factory=dict, init=False)  # by connectivity
    _lines: dict[int, tuple[np.ndarray, np.ndarray] | None] = field(default_factory=dict, init=False)

    @classmethod
    def of(cls, surface: RoughSurface, solution: ContactSolution, displacement: float = math.nan) -> Contact:
        """A solved contact of a surface on which several are measured."""
        given = {each.name: getattr(solution, each.name) for each in dataclasses.fields(ContactSolution)}
        problem = surface.problem.at(solution.mean_pressure)
        return Contact(**given, problem=problem, displacement=displacement, shared=surface)

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
    def numbers(self) -> dict[str, float]:
        """The numbers that a run writes for each load, by their names in its table.  Collective on first use."""
        area = self.area
        measured = {
            "contact_area": area.fraction,
            "contact_area_corrected": area.corrected,
            "contact_perimeter": area.perimeter / math.prod(self.grid.lengths),
            "contact_line": float(self.line is not None),
        }
        names = [name for name in LOADS if name != "target"]
        found = {name: measured[name] if name in measured else getattr(self, name) for name in names}
        if self.shared is None:
            self.grid.free()
        return found

    @property
    def contact_area(self) -> float:
        """Relative contact area: share of the points in contact.  Collective on first use."""
        return self.numbers["contact_area"]

    @property
    def contact_area_corrected(self) -> float:
        """Relative area inside the contact line; without one, pixels less their staircase.  Collective on first use."""
        return self.numbers["contact_area_corrected"]

    @property
    def contact_area_error(self) -> float:
        """Error bar of `contact_area_corrected`, by the grid and by the solver.  Collective on first use."""
        return self.area_error if self.numbers else math.nan  # numbers first: they free the transforms

    def observables(self, *names: str, **options: Mapping[str, Any]) -> Groups:
        """Curves and tables, group → dataset → array, as `Results` gives those of a load; on rank 0.  Numbers that
        observables add to the table of loads are in the group "loads", on all ranks.  Collective.

        names: observables, as a job lists them; options: further ones with their keys, `spectra={"bins": 10}`.  Raises
        InputError for an unknown observable or key.
        """
        surface = RoughSurface(self.problem, _asked(dict.fromkeys(names, {}) | options))
        groups = Contact.of(surface, self, self.displacement).measure()
        self.grid.free()
        return groups

    def measure(self) -> dict[str, Mapping[str, np.ndarray]]:
        """The groups of all observables that the surface is asked for, as `observables` returns them.  Collective."""
        groups: dict[str, Mapping[str, np.ndarray]] = {}
        columns: dict[str, np.ndarray] = {}
        seconds = self.surface.seconds
        for name, observable in self.surface.asked.items():
            began = time.perf_counter()
            measured = dict(observable.measure(self))
            columns |= measured.pop(TABLE, {})
            groups |= measured
            seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - began
        columns = self.grid.comm.bcast(columns)
        return groups | ({TABLE: columns} if columns else {})

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
        if not grid.domain.wraps:
            lx, ly = grid.lengths
            axes.add_patch(plt.Rectangle((0, 0), lx, ly, fill=False, ec="tab:red", lw=2))
            axes.set(xlim=(-0.04 * lx, 1.04 * lx), ylim=(-0.04 * ly, 1.04 * ly))
        return axes

    def warn_at_border(self) -> None:
        """Warn if points at the border of an open patch touch that was cut out of a larger surface.  Collective."""
        grid = self.problem.grid
        if grid.domain.wraps:
            return
        inner = slice(max(1 - grid.rows.start, 0), len(self.pressure) - (grid.rows.stop == grid.shape[0]))
        touching = self.pressure > self.threshold
        count = int(grid.reduction.sum(np.count_nonzero(touching) - np.count_nonzero(touching[inner, 1:-1])))
        if count and grid.comm.rank == 0:
            log.warning(
                "%s at the border of the patch touch: what lies beyond it would take a part of their load; near the "
                "border pressures are too high", counted(count, "point"),
            )  # fmt: skip

    def to_xarray(self) -> xarray.Dataset:
        """This rank's fields with named axes and coordinates; the numbers as attributes, collective on first use."""
        import xarray

        x, y = coordinates(self.problem.grid)
        fields = {"height": self.heights, "pressure": self.pressure, "gap": self.gap}
        if self.problem.law.highest < math.inf:
            fields["plastic_depth"] = self.plastic_depth
        about = {name: {"description": FIELDS[name].description} for name in fields}
        described = {name: (("x", "y"), values, about[name]) for name, values in fields.items()}
        return xarray.Dataset(described, {"x": x[:, 0], "y": y[0]}, self.numbers)

    # What observables share, each computed at its first use.

    @property
    def grid(self) -> SlabGrid:
        """The grid of the fields."""
        return self.problem.grid

    @cached_property
    def surface(self) -> RoughSurface:
        """What is measured on the surface; shared with other contacts of a run."""
        return self.shared or RoughSurface(self.problem)

    @cached_property
    def contact_pressure(self) -> np.ndarray:
        """The pressure of the points in contact (nx_local, ny), 0 elsewhere."""
        return self.pressure_in_contact()

    @cached_property
    def area(self) -> Area:
        """The contact area: that of the pixels in contact, and that inside the contact line."""
        patches = self.surface.asked.get("patches")
        if patches:  # the lines of the patches add up to the whole line, which then needs no pass
            self.line_of_patches(patches.connectivity)
        steps = staircase(self.problem, self.surface.roughness)
        return contact_area(self.grid, self.contact_pressure, self.line, self.problem.least_area, steps)

    @property
    def correction(self) -> str:
        """How the corrected area is measured: "inside the line", "less the staircase", or "as counted"."""
        if self.line is not None:
            return "inside the line"
        return "less the staircase" if self.problem.law.releases else "as counted"

    @property
    def area_error(self) -> float:
        """Error of the corrected area, by the grid and the solver.  Collective."""
        way = "staircase" if self.line is None else "line on a thin slab" if self.line.is_thin else "line"
        shift = self.likely_pressure_error * math.sqrt(self.area.pixels)  # b the rms pressure in contact
        if way == "line on a thin slab" and self.surface.rms_slope > 0:
            step = math.sqrt(self.grid.pixel_area)
            rise = float(self.problem.solid.stiffness(np.array(math.pi / step))) * step * self.surface.rms_slope
            shift = self.likely_pressure_error * math.sqrt(self.mean_square_pressure * self.grid.size) / rise
        return self.area.error(way, self.surface.roughness, shift)

    @cached_property
    def likely_pressure_error(self) -> float:
        """‖p − p*‖/‖p*‖, estimated by the solver or, where it gives none, from its certified error; NaN if p = 0.

        ‖p − p*‖² is at most the largest stiffness times ‖p − p*‖²_G ≤ 2B, B the certified energy error; the solver's
        estimate is 1/TYPICAL of this bound.
        """
        estimate, energy = self.pressure_error, self.elastic_energy
        if not math.isnan(estimate) or energy == 0:
            return 0.0 if math.isnan(estimate) else estimate
        highest = np.array(math.hypot(*(math.pi / step for step in self.grid.spacing)))
        bound = 4 * energy * self.certified_error * float(self.problem.solid.stiffness(highest))
        return math.sqrt(bound / (self.mean_square_pressure or math.nan)) / TYPICAL

    @cached_property
    def mean_square_pressure(self) -> float:
        """⟨p²⟩."""
        return self.grid.reduction.dot(self.pressure, self.pressure) / self.grid.size

    @cached_property
    def line(self) -> ContactLine | None:
        """The contact line, if there is one."""
        return line_of(self.problem, self, self.surface.is_smooth)

    @property
    def kappa(self) -> float:
        """f_c E' g_rms / p̄ (f_c: relative contact area, g_rms: rms slope); NaN at p̄ = 0."""
        mean, modulus = self.mean_pressure, self.problem.solid.contact_modulus
        return self.area.fraction * modulus * self.surface.rms_slope / mean if mean > 0 else math.nan

    @cached_property
    def stress(self) -> Correlations:
        """Spectrum, and autocorrelation if one is asked for, of the pressure."""
        return self.surface.correlate(source(self.pressure))

    @cached_property
    def indicator(self) -> Correlations:
        """Spectrum, and autocorrelation if asked for, of the contact indicator: 1 in contact, 0 outside."""
        return self.surface.correlate(indicator(self.contact_pressure, 0.0))

    @cached_property
    def cross_power(self) -> np.ndarray:
        """Sums of Re h̃* σ̃ over the bins of wave numbers, from |σ̃ + α h̃|² = |σ̃|² + α²|h̃|² + 2α Re h̃* σ̃, where α makes
        both fields equally large, so that few digits are lost.  One forward transform, and no spectrum is stored.
        """
        stress, height = self.stress.power, self.surface.correlations.power
        alpha = math.sqrt(stress[1:].sum()) / (math.sqrt(height[1:].sum()) or math.inf)
        if alpha == 0:
            return np.zeros_like(stress)
        heights, pressure = self.surface.heights, self.pressure

        def weighted_sum(first: int, stop: int, rows: np.ndarray) -> None:
            np.multiply(heights[first:stop], alpha, out=rows)
            rows += pressure[first:stop]

        both = correlate(self.grid, weighted_sum, self.surface.modes).power
        return (both - stress - alpha * (alpha * height)) / (2 * alpha)

    def labels(self, connectivity: int) -> Labels:
        """The contact patches for that connectivity (4 or 8); computed on the first call for it."""
        if connectivity not in self._labels:
            mask = self.contact_pressure > 0
            self._labels[connectivity] = label_patches(
                self.grid.comm, mask, self.grid.starts, connectivity, self.grid.domain.wraps
            )
        return self._labels[connectivity]

    def line_of_patches(self, connectivity: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Area inside the line less that of the pixels, and its length, of each kept patch; None without a line."""
        if connectivity not in self._lines:
            self._lines[connectivity] = None if self.line is None else self.line.of_patches(self.labels(connectivity))
        return self._lines[connectivity]

    def patches(self, labels: Labels, pressure: np.ndarray | None) -> dict[str, np.ndarray]:
        """The table of patches on rank 0, empty elsewhere; `pressure` None: without columns of pressure and line."""
        line = None if pressure is None else self.line_of_patches(labels.connectivity)
        return patch_table(labels, self.grid.spacing, pressure, line, self.problem.law.highest)

    def keep(self, name: str, values: np.ndarray) -> None:
        """Keeps a field (nx_local, ny) that an observable has made, if it is to be written."""
        if name in self.surface.fields:
            self._kept[name] = values

    def fields(self, names: tuple[str, ...], connectivity: int) -> dict[str, np.ndarray]:
        """The fields (nx_local, ny) of this load, of those in `schema.FIELDS`, that `names` lists."""
        fields = {}
        for name in names:
            if name in ("pressure", "gap", "plastic_depth"):
                fields[name] = getattr(self, name)
            elif name == "displacement":
                position = self.gap + self.surface.heights
                position -= self.plastic_depth
                if self.grid.domain.wraps:
                    position -= self.grid.reduction.sum(position) / self.grid.size
                else:  # absolute: distant points are at rest
                    position += self.approach - self.grid.reduction.max(self.surface.heights)
                fields[name] = position
            elif name == "labels":
                fields[name] = self.labels(connectivity).label_field()
            elif name in self._kept:
                fields[name] = self._kept[name]
        return fields


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
        observable = build(OBSERVABLES[name], dict(keys) if isinstance(keys, Mapping) else keys)
        assert isinstance(observable, Observable)
        yield observable
