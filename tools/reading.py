"""Loads of result folders as the tools see them: numbers, and curves, made from the fields where none were kept."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import rowblocks

from pgfmd.errors import InputError
from pgfmd.io.results import Results
from pgfmd.job import job

log = logging.getLogger("pgfmd")

FIELD_OF = {"stress": "pressure", "contact": "pressure", "height": "height", "gap": "gap"}


@dataclass(frozen=True)
class Case:
    """One load of one run."""

    results: Results
    index: int

    @cached_property
    def config(self):
        """The job."""
        return job.parse(self.results.provenance["effective_toml"], str(self.results.directory))

    @cached_property
    def groups(self):
        """Curves and tables that the run kept: name → {dataset: array}."""
        return self.results.load(self.index)

    @property
    def title(self) -> str:
        """Folder and contact area, for messages and legends."""
        return f"{self.results.directory.name}, f_c = {self.area:.3g}"

    def number(self, name: str) -> float:
        """A column of the table of loads."""
        return float(self.results.loads[name][self.index])

    @property
    def area(self) -> float:
        """f_c, fraction of grid points in contact."""
        return self.number("contact_area")

    @property
    def corrected_area(self) -> float:
        """f_c without the pixel staircase."""
        return self.number("contact_area_corrected")

    @property
    def load(self) -> float:
        """p̄."""
        return self.number("mean_pressure")

    @property
    def contact_pressure(self) -> float:
        """σ_c = p̄/f_c."""
        return self.load / self.area

    @property
    def modulus(self) -> float:
        """E'."""
        return self.config.solid.contact_modulus

    @property
    def hurst(self) -> float | None:
        """H of a self-affine surface."""
        return getattr(self.config.surface, "hurst", None)

    @property
    def seed(self) -> int | None:
        """Seed of a self-affine surface."""
        return getattr(self.config.surface, "seed", None)

    @cached_property
    def rms_slope(self) -> float:
        """√⟨|∇h|²⟩, spectral."""
        if self.config.surface.rms_slope is not None:
            return self.config.surface.rms_slope
        q, power, count = self.spectrum("height")
        return float(np.sqrt(np.sum(q**2 * power * count)))

    @property
    def full_contact_std(self) -> float:
        """E' g/2, the standard deviation of the pressure in full contact."""
        return self.modulus * self.rms_slope / 2

    @property
    def wavelengths(self) -> tuple[float, float]:
        """λ_s and λ_l as lengths."""
        return self.config.surface.wavelengths(self.config.grid)[:2]

    @property
    def q_limits(self) -> tuple[float, float]:
        """q_l and the highest wave number: q_s, or the corner of the grid's spectrum where there is no cut-off."""
        shortest, longest = self.wavelengths
        steps = self.config.grid.steps
        if shortest <= max(steps) * (1 + 1e-9):
            return 2 * np.pi / longest, np.pi * np.hypot(*(1 / step for step in steps))
        return 2 * np.pi / longest, 2 * np.pi / shortest

    @property
    def wave_unit(self) -> float:
        """2π/lx: q in this unit counts the waves in the cell."""
        return 2 * np.pi / self.results.lengths[0]

    @cached_property
    def normalised_second_moment(self) -> float:
        """m₂ = ⟨σ²⟩_c/σ_c²."""
        moments = self.groups["pressure_moments"]
        return float(moments["value"][np.flatnonzero(moments["order"] == 2)[0]])

    def has(self, group: str) -> bool:
        """Whether the run kept this group."""
        return group in list(self.groups)

    def spectrum(self, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """q, |f̃|² averaged over direction (f̃ the Fourier coefficient: sums over modes are means), count of modes.

        name : "stress", "contact", "height", "bearing"; from the fields if the run did not keep it.
        """
        if not self.has(f"{name}_spectrum"):
            q_max = None if name == "gap" else self.q_limits[1]
            return rowblocks.radial_spectrum(self._blocks(name), *self._cell, q_max=q_max)
        kept = self.groups[f"{name}_spectrum"]
        return kept["q"], kept["value"], kept["count"]

    def correlation(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """r and ⟨f(0) f(r)⟩ averaged over direction; from the fields if the run did not keep it."""
        if not self.has(f"{name}_acf"):
            return rowblocks.radial_autocorrelation(self._blocks(name), *self._cell)[:2]
        kept = self.groups[f"{name}_acf"]
        return kept["r"], kept["value"]

    @property
    def _cell(self):
        return self.results.shape, self.results.lengths

    def _blocks(self, name: str) -> Iterable:
        if name not in FIELD_OF:
            raise InputError(f"{self.results.directory}: no {name} spectrum was kept, and the fields do not give it")
        field = FIELD_OF[name]
        log.info("%s: %s from the field in row blocks", self.title, name)
        blocks = self.results.blocks(field, None if field == "height" else self.index)
        return rowblocks.mapped(blocks, lambda values: values > 0) if name == "contact" else blocks


def cases(folders: Iterable[Path | str]) -> list[Case]:
    """Every completed load of the folders, in their order.  Raises InputError if there is none."""
    found = [Case(results, index) for results in map(Results, folders) for index in range(len(results))]
    if not found:
        raise InputError("no load was completed in the folders given")
    return found


def nearest(found: Iterable[Case], area: float, slack: float = 0.1) -> list[Case]:
    """Of each folder the load whose contact area is nearest to `area`, if it is within `slack` relatively."""
    best: dict[Path, Case] = {}
    for case in found:
        old = best.get(case.results.directory)
        if old is None or abs(case.area - area) < abs(old.area - area):
            best[case.results.directory] = case
    chosen = [case for case in best.values() if abs(case.area / area - 1) <= slack]
    if not chosen:
        raise InputError(f"no load with a contact area near {area:g} in the folders given")
    return chosen


def by_hurst(found: Iterable[Case]) -> dict[float, list[Case]]:
    """The cases of each H, ascending."""
    sorted_cases = sorted(found, key=lambda case: case.hurst if case.hurst is not None else -1.0)
    groups: dict[float, list[Case]] = {}
    for case in sorted_cases:
        groups.setdefault(case.hurst, []).append(case)
    return groups


def common_bins(curves: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Curves (x, y) of equal grids as x (m,) and y (curves, m).  Raises InputError if the grids differ."""
    x = curves[0][0]
    if any(other.shape != x.shape or not np.allclose(other, x) for other, _ in curves):
        raise InputError("the folders hold curves on different bins; give runs of one grid")
    return x, np.array([y for _, y in curves])
