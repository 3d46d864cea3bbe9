"""`Observer`: everything that a job asks to be measured on its solved contacts."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from functools import partial

import numpy as np

from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables import lowpass
from pgfmd.observables.bearing import threshold_for_count
from pgfmd.observables.correlations import Correlator, Measured, lag_bins, wave_number_bins
from pgfmd.observables.histograms import gap_groups, pressure_groups
from pgfmd.observables.lowpass import highest_wave_number, lowpass_areas, octaves
from pgfmd.observables.patches.table import label_patches, patch_table
from pgfmd.observables.staircase import Area, contact_area
from pgfmd.physics.elasticity import Elasticity
from pgfmd.solvers.active_set.nested_iteration import solve_hard_wall
from pgfmd.solvers.solution import ContactSolution

Groups = dict[str, dict[str, np.ndarray]]


class Observer:
    """Measures solved contacts of one rough surface.  Making one costs half a transform; methods are collective.

    grid; heights (nx_local, ny), kept, not copied; elasticity of the solid
    q_max: cut-off q_s of the surface, beyond which spectra are not averaged (None: every mode counts)
    names: which of "histogram", "spectra", "acf", "patches", "bearing", "lowpass" are measured; no other is computed
    histogram_bins; spectra, acf: (spacing, bins); connectivity; lowpass_q: options, see `sections`
    tolerance: certified error of the contacts that "lowpass" solves, if coarser than `lowpass.TOLERANCE`
    relax(grid, heights, mean_pressure=…, start=…): the solver of "lowpass" in place of the hard wall; it may overwrite
        heights

    rms_slope: √Σ q²|h̃|²;  seconds: time spent so far on each observable, for `info`
    """

    def __init__(
        self,
        grid: SlabGrid,
        heights: np.ndarray,
        elasticity: Elasticity,
        *,
        q_max: float | None = None,
        names: Sequence[str] = (),
        histogram_bins: int = 200,
        spectra: tuple[str, int] = ("log", 20),
        acf: tuple[str, int] = ("log", 20),
        connectivity: int = 8,
        lowpass_q: Sequence[float] = (),
        tolerance: float = lowpass.TOLERANCE,
        relax: Callable[..., ContactSolution] | None = None,
    ):
        self.grid, self.heights, self.contact_modulus = grid, heights, elasticity.contact_modulus
        self.names, self.histogram_bins, self.connectivity = frozenset(names), histogram_bins, connectivity
        self.finest = highest_wave_number(grid) if q_max is None else q_max
        self.lowpass_q = np.asarray(lowpass_q, float) if len(lowpass_q) else octaves(grid, self.finest)
        self.relax = relax or partial(
            solve_hard_wall,
            elasticity=elasticity,
            tolerance=max(tolerance, lowpass.TOLERANCE),
            overwrite_heights=True,
        )
        self.seconds: dict[str, float] = {}
        self._correlator = Correlator(grid, wave_number_bins(grid, *spectra, q_max), lag_bins(grid, *acf))
        self._area: tuple[ContactSolution, Area] | None = None
        self.rms_slope, self._height = self._measure_heights()

    def _measure_heights(self) -> tuple[float, Measured]:
        parts, grid = {}, self.grid

        def watch(power: np.ndarray, first: int, stop: int):
            q_squared = grid.q_squared(first, stop)
            parts[first] = float(np.sum(grid.hermitian_weight[first:stop] * q_squared * power))

        measured = self._correlator.measure(_rows(self.heights), "acf" in self.names, watch)
        square = grid.reduction.sum([parts[first] for first in sorted(parts)])
        return math.sqrt(square) / grid.size, measured

    def area(self, solution: ContactSolution) -> Area:
        """Contact area of a solution, counted once.  Collective."""
        if self._area is None or self._area[0] is not solution:
            self._area = solution, contact_area(self.grid, solution.pressure)
        return self._area[1]

    def row(self, solution: ContactSolution) -> dict[str, float]:
        """The numbers of `schema.LOADS`; the same on all ranks.  Collective."""
        area, load = self.area(solution), solution.mean_pressure
        return {
            "mean_pressure": load,
            "contact_area": area.fraction,
            "contact_area_corrected": area.corrected,
            "kappa": area.fraction * self.contact_modulus * self.rms_slope / load if load > 0 else math.nan,
            "mean_gap": solution.mean_gap,
            "elastic_energy": solution.elastic_energy,
            "certified_error": solution.certified_error,
            "max_violation": solution.max_violation,
            "iterations": solution.iterations,
            "transforms": solution.transforms,
            "seconds": solution.seconds,
        }

    def groups(self, solution: ContactSolution) -> Groups:
        """Curves and tables of `schema.GROUPS` that were asked for.  Collective.

        Complete on rank 0; the others have all but the tables of patches.
        """
        grid, out = self.grid, {}
        if "histogram" in self.names:
            with self._timed("histogram"):
                out |= pressure_groups(grid, solution.pressure, self.histogram_bins)
                out |= gap_groups(grid, solution.gap, self.histogram_bins)
        curves = sorted(self.names & {"spectra", "acf"}, reverse=True)
        if curves:
            with self._timed(" and ".join(curves)):  # they share their transforms
                out |= self._correlations(solution)
        if "patches" in self.names:
            with self._timed("patches"):
                out["patches"] = self._patches(solution.pressure > 0, solution.pressure)
        if "bearing" in self.names:
            with self._timed("bearing"):
                out |= self._bearing(solution)
        if "lowpass" in self.names:
            with self._timed("lowpass"):
                out["lowpass_area"] = {"q": self.lowpass_q, "area": self._lowpass(solution)}
        return out

    def label_field(self, solution: ContactSolution) -> np.ndarray:
        """Number of the patch of each pixel (nx_local, ny), 0 outside contact.  Collective."""
        return label_patches(self.grid.comm, solution.pressure > 0, self.grid.starts, self.connectivity).label_field()

    @contextmanager
    def _timed(self, name: str):
        began = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - began

    def _correlations(self, solution: ContactSolution) -> Groups:
        pressure, acf = solution.pressure, "acf" in self.names
        stress = self._correlator.measure(_rows(pressure), acf)
        contact = self._correlator.measure(_mask(pressure, 0.0), acf)
        out = self._curves("stress", stress) | self._curves("contact", contact)
        out |= self._curves("height", self._height, 1 / self.grid.size**2)
        if "spectra" in self.names:
            out["cross_spectrum"] = self._correlator.spectrum(self._cross(pressure, stress))
        return out

    def _cross(self, pressure: np.ndarray, stress: Measured) -> np.ndarray:
        """Sums of Re h̃* σ̃ from |σ̂ + α ĥ|² = |σ̂|² + α²|ĥ|² + 2α Re ĥ* σ̂: one forward transform, and no field is kept.

        α makes both fields equally large, so that little is lost in the difference.
        """
        alpha = math.sqrt(stress.power[1:].sum() / (self._height.power[1:].sum() or math.inf))
        if alpha == 0:
            return np.zeros_like(stress.power)
        heights = self.heights

        def both(first: int, stop: int, rows: np.ndarray):
            np.multiply(heights[first:stop], alpha, out=rows)
            rows += pressure[first:stop]

        power = self._correlator.measure(both).power
        return (power - stress.power - alpha**2 * self._height.power) / (2 * alpha * self.grid.size**2)

    def _curves(self, name: str, measured: Measured, factor: float = 1.0) -> Groups:
        """Spectrum and autocorrelations of one field, those asked for; `factor` on the unnormalised spectrum."""
        out = {}
        if "spectra" in self.names:
            out[f"{name}_spectrum"] = self._correlator.spectrum(measured.power * factor)
        if "acf" in self.names:
            out[f"{name}_acf"] = self._correlator.radial(measured.acf)
            out[f"{name}_acf_x"] = self._correlator.along(measured.acf_x, 0)
            out[f"{name}_acf_y"] = self._correlator.along(measured.acf_y, 1)
        return out

    def _patches(self, mask: np.ndarray, pressure: np.ndarray | None) -> dict[str, np.ndarray]:
        """The table of patches on rank 0, empty elsewhere.  Collective."""
        table = patch_table(label_patches(self.grid.comm, mask, self.grid.starts, self.connectivity),
                            self.grid.spacing, pressure)  # fmt: skip
        return {} if table is None else {name: column for name, column in vars(table).items() if column is not None}

    def _bearing(self, solution: ContactSolution) -> Groups:
        threshold = threshold_for_count(self.grid, self.heights, self.area(solution).pixels)
        out = {"bearing": {"threshold": np.array(threshold)}}
        if self.names & {"spectra", "acf"}:
            measured = self._correlator.measure(_mask(self.heights, threshold), "acf" in self.names)
            out |= self._curves("bearing", measured)
        if "patches" in self.names:
            out["bearing_patches"] = self._patches(self.heights > threshold, None)
        return out

    def _lowpass(self, solution: ContactSolution) -> np.ndarray:
        """Areas at the cut-offs; the surface with all its modes is the one that is solved already.  Collective."""
        areas = np.full(len(self.lowpass_q), self.area(solution).corrected)
        smooth = self.lowpass_q < self.finest * (1 - 1e-9)
        relax = partial(self.relax, mean_pressure=solution.mean_pressure)
        with _folded(self.grid, solution):
            areas[smooth] = lowpass_areas(self.grid, self.heights, self.lowpass_q[smooth], relax, solution.pressure)
        return areas


@contextmanager
def _folded(grid: SlabGrid, solution: ContactSolution):
    """While the block runs, pressure and gap of a hard contact are kept in one array, p − g.  Collective.

    Nothing is lost, as one of them is 0, and the memory of the gap is there for another contact.  For a start, which is
    cut off at 0, p − g serves as p.
    """
    pressure, gap = solution.pressure, solution.gap
    both = any(np.any((p > 0) & (g != 0)) or np.any(g < 0) for p, g in zip(pressure, gap, strict=True))
    if grid.reduction.any(both):
        yield
        return
    np.subtract(pressure, gap, out=pressure)
    del gap
    solution.gap = None
    try:
        yield
    finally:
        solution.gap = np.negative(pressure)
        np.maximum(solution.gap, 0, out=solution.gap)
        np.maximum(pressure, 0, out=pressure)


def _rows(field: np.ndarray):
    def fill(first: int, stop: int, rows: np.ndarray):
        rows[...] = field[first:stop]

    return fill


def _mask(field: np.ndarray, threshold: float):
    def fill(first: int, stop: int, rows: np.ndarray):
        np.greater(field[first:stop], threshold, out=rows)

    return fill
