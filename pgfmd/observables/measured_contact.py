"""`MeasuredContact`: quantities of one solved contact that observables share, each computed at its first use."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from pgfmd.grid.callbacks import source
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables.contact_area import Area, ContactLine, contact_area, line_of
from pgfmd.observables.contact_line import staircase
from pgfmd.observables.labelling import Labels, label_patches
from pgfmd.observables.patch_table import patch_table
from pgfmd.observables.rough_surface import Correlations, RoughSurface, correlate, indicator
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.solution import ContactSolution, Solve

TYPICAL = 1.9  # see `MeasuredContact.pressure_error`: the median over 825 solutions; largest 3.4


@dataclass(frozen=True)
class MeasuredContact:
    """One load of a run, as observables see it.  Every property and method is collective on first use.

    problem: what was solved;  asked: the observables that are measured, by name;  solve: solves further contacts;
    wanted: fields that observables are to keep
    """

    problem: ContactProblem
    surface: RoughSurface
    solution: ContactSolution
    asked: Mapping[str, Any]
    solve: Solve
    wanted: Collection[str] = ()
    _kept: dict[str, np.ndarray] = field(default_factory=dict, init=False)
    _labels: dict[int, Labels] = field(default_factory=dict, init=False)  # by connectivity
    _lines: dict[int, tuple[np.ndarray, np.ndarray] | None] = field(default_factory=dict, init=False)

    @property
    def grid(self) -> SlabGrid:
        """The grid of the fields."""
        return self.surface.grid

    @cached_property
    def pressure(self) -> np.ndarray:
        """The pressure of the points in contact (nx_local, ny), 0 elsewhere."""
        return self.solution.pressure_in_contact()

    @cached_property
    def area(self) -> Area:
        """The contact area: that of the pixels in contact, and that inside the contact line."""
        if "patches" in self.asked:  # the lines of the patches add up to the whole line, which then needs no pass
            self.line_of_patches(self.asked["patches"].connectivity)
        releases, roughness = self.problem.law.releases, self.surface.roughness
        steps = staircase(self.grid.spacing, self.problem.solid, roughness) if releases else 0.0
        return contact_area(self.grid, self.pressure, self.line, self.problem.least_area, steps)

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
        shift = self.pressure_error * math.sqrt(self.area.pixels)  # b the rms pressure in contact
        if way == "line on a thin slab" and shift:
            step = math.sqrt(self.grid.pixel_area)
            rise = float(self.problem.solid.stiffness(np.array(math.pi / step))) * step * self.surface.rms_slope
            shift = self.pressure_error * math.sqrt(self.mean_square_pressure * self.grid.size) / rise
        return self.area.error(way, self.surface.roughness, shift)

    @cached_property
    def pressure_error(self) -> float:
        """‖p − p*‖/‖p*‖, estimated by the solver or, where it gives none, from its certified error.

        ‖p − p*‖² is at most the largest stiffness times ‖p − p*‖²_G ≤ 2B, B the certified energy error; the solver's
        estimate is 1/TYPICAL of this bound.
        """
        estimate, energy = self.solution.pressure_error, self.solution.elastic_energy
        if not math.isnan(estimate) or energy == 0:
            return 0.0 if math.isnan(estimate) else estimate
        highest = np.array(math.hypot(*(math.pi / step for step in self.grid.spacing)))
        bound = 4 * energy * self.solution.certified_error * float(self.problem.solid.stiffness(highest))
        return math.sqrt(bound / self.mean_square_pressure) / TYPICAL

    @cached_property
    def mean_square_pressure(self) -> float:
        """⟨p²⟩."""
        return self.grid.reduction.dot(self.solution.pressure, self.solution.pressure) / self.grid.size

    @cached_property
    def line(self) -> ContactLine | None:
        """The contact line, if there is one."""
        return line_of(self.problem, self.solution, self.surface.is_smooth)

    @property
    def kappa(self) -> float:
        """f_c E' g_rms / p̄ (f_c: relative contact area, g_rms: rms slope); NaN at p̄ = 0."""
        mean, modulus = self.solution.mean_pressure, self.problem.solid.contact_modulus
        return self.area.fraction * modulus * self.surface.rms_slope / mean if mean > 0 else math.nan

    @cached_property
    def stress(self) -> Correlations:
        """Spectrum, and autocorrelation if one is asked for, of the pressure."""
        return self.surface.correlate(source(self.solution.pressure))

    @cached_property
    def indicator(self) -> Correlations:
        """Spectrum, and autocorrelation if asked for, of the contact indicator: 1 in contact, 0 outside."""
        return self.surface.correlate(indicator(self.pressure, 0.0))

    @cached_property
    def cross_power(self) -> np.ndarray:
        """Sums of Re h̃* σ̃ over the bins of wave numbers, from |σ̃ + α h̃|² = |σ̃|² + α²|h̃|² + 2α Re h̃* σ̃.  This
        takes one forward transform and stores no spectrum.

        α makes both fields equally large, so that the difference loses few digits.
        """
        stress, height = self.stress.power, self.surface.correlations.power
        alpha = math.sqrt(stress[1:].sum()) / (math.sqrt(height[1:].sum()) or math.inf)
        if alpha == 0:
            return np.zeros_like(stress)
        heights, pressure = self.surface.heights, self.solution.pressure

        def weighted_sum(first: int, stop: int, rows: np.ndarray) -> None:
            np.multiply(heights[first:stop], alpha, out=rows)
            rows += pressure[first:stop]

        both = correlate(self.grid, weighted_sum, self.surface.modes).power
        return (both - stress - alpha * (alpha * height)) / (2 * alpha)

    def labels(self, connectivity: int) -> Labels:
        """The contact patches for that connectivity (4 or 8); computed on the first call for it."""
        if connectivity not in self._labels:
            mask = self.pressure > 0
            self._labels[connectivity] = label_patches(
                self.grid.comm, mask, self.grid.starts, connectivity, self.grid.domain.wraps
            )
        return self._labels[connectivity]

    def line_of_patches(self, connectivity: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Area inside the line less that of the pixels, and length of the line, of each patch that this rank keeps;
        None without a line.  Computed on the first call.
        """
        if connectivity not in self._lines:
            self._lines[connectivity] = None if self.line is None else self.line.of_patches(self.labels(connectivity))
        return self._lines[connectivity]

    def patches(self, labels: Labels, pressure: np.ndarray | None) -> dict[str, np.ndarray]:
        """The table of patches on rank 0, empty elsewhere; without columns of pressure and line if `pressure` is None.
        """
        line = None if pressure is None else self.line_of_patches(labels.connectivity)
        table = patch_table(labels, self.grid.spacing, pressure, line, self.problem.law.highest)
        if table is None:
            return {}
        columns = {name: column for name, column in vars(table).items() if column is not None}
        return {"patch": np.arange(1, len(table.area) + 1), **columns}

    def keep(self, name: str, values: np.ndarray) -> None:
        """Keeps a field (nx_local, ny) that an observable has made, if it is to be written."""
        if name in self.wanted:
            self._kept[name] = values

    def fields(self, names: tuple[str, ...], connectivity: int) -> dict[str, np.ndarray]:
        """The fields (nx_local, ny) of this load, of those in `schema.FIELDS`, that `names` lists."""
        fields = {}
        for name in names:
            if name in ("pressure", "gap", "plastic_depth"):
                fields[name] = getattr(self.solution, name)
            elif name == "displacement":
                position = self.solution.gap + self.surface.heights
                position -= self.solution.plastic_depth
                if self.grid.domain.wraps:
                    position -= self.grid.reduction.sum(position) / self.grid.size
                else:  # absolute: distant points are at rest
                    position += self.solution.approach - self.grid.reduction.max(self.surface.heights)
                fields[name] = position
            elif name == "labels":
                fields[name] = self.labels(connectivity).label_field()
            elif name in self._kept:
                fields[name] = self._kept[name]
        return fields
