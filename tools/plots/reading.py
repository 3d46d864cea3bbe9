"""Loads of result folders, for the figures: numbers, spectra, correlations, fields.

No MPI.  Spectra and correlations that a run did not write are computed from its fields, in row blocks.
"""

import logging
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import rowblocks

from pgfmd.application import ensemble
from pgfmd.application.results import Results
from pgfmd.errors import InputError
from pgfmd.observables import binning
from pgfmd.options.section import build
from pgfmd.options.text import printable
from pgfmd.physics.solids.kinds import SOLIDS

log = logging.getLogger("pgfmd")

FIELD_OF = {"stress": "pressure", "contact": "pressure", "height": "height", "gap": "gap"}
CONTROLS = {"contact_area": "f_c", "pressure": "p̄", "mean_gap": "mean gap", "displacement": "displacement"}
CONTROLS |= {"percolation": "constriction"}


@dataclass(frozen=True)
class Load:
    """One load of one run."""

    results: Results
    index: int

    @cached_property
    def job(self) -> dict[str, dict]:
        """The job as nested tables, defaults included."""
        return self.results.job

    @cached_property
    def groups(self):
        """Curves and tables that the run kept: name → {dataset: array}."""
        return self.results.load(self.index)

    @cached_property
    def kept(self) -> frozenset[str]:
        """Names of the groups."""
        return frozenset(self.groups)

    @cached_property
    def fields(self) -> frozenset[str]:
        """Names of the fields that were written, of the run and of this load."""
        return frozenset([*self.results.fields(), *self.results.fields(self.index)])

    def unit(self, name: str) -> str:
        """Unit of "length" or "pressure" as the job names it; else the grid spacing, or a modulus, that is 1 in the
        job; "" if none is.
        """
        named = str(self.job.get("output", {}).get(f"{name}_unit", name))
        if named != name:
            return printable(named, 20)
        if name == "length":
            return "grid spacings" if set(self.spacings) == {1.0} else ""
        symbols = {"contact_modulus": "E′", "lame_mu": "μ", "young": "E"}
        return next((symbol for key, symbol in symbols.items() if self.job["solid"].get(key) == 1.0), "")

    @property
    def folder(self) -> str:
        """Name of the result folder."""
        return self.results.directory.name

    def number(self, name: str) -> float:
        """A column of the table of loads; NaN where the run has none.

        NaN also for contact areas under an exponential wall in old results, without contact lines: they count all
        points where exp(−gap/ζ) does not underflow, which is no contact area.
        """
        old = "contact_line" not in self.results.loads
        if old and self.law == "exponential" and (name == "kappa" or name.startswith("contact_area")):
            return math.nan
        return float(self.results.loads[name][self.index]) if name in self.results.loads else math.nan

    @property
    def area(self) -> float:
        """f_c, fraction of grid points in contact; NaN where it has no meaning."""
        return self.number("contact_area")

    @property
    def corrected_area(self) -> float:
        """f_c without the pixel staircase."""
        return self.number("contact_area_corrected")

    @property
    def area_error(self) -> float:
        """Estimated error of the corrected area by the grid; NaN where the run did not estimate it."""
        if "discretisation" not in self.kept:
            return math.nan
        return float(np.ravel(self.groups["discretisation"]["contact_area_corrected_error"])[0])

    @property
    def mean_pressure(self) -> float:
        """p̄."""
        return self.number("mean_pressure")

    @property
    def contact_pressure(self) -> float:
        """σ_c = p̄/f_c."""
        return self.mean_pressure / self.area if self.area > 0 else math.nan

    @property
    def target(self) -> tuple[str, float]:
        """Which quantity the job imposed, and its value at this load."""
        for control in CONTROLS:
            values = self.job["load"].get(control)
            if values is not None:
                values = values if isinstance(values, list) else [0.0 if control == "percolation" else values]
                return control, float(values[self.index]) if self.index < len(values) else math.nan
        return "pressure", self.mean_pressure

    @property
    def law(self) -> str:
        """Kind of the wall: "hard", "exponential", …"""
        return self.job.get("wall", {}).get("kind", "hard")

    @property
    def releases(self) -> bool:
        """Whether points of the wall that do not touch bear nothing."""
        return self.law not in ("exponential", "formula")

    @property
    def zeta(self) -> float | None:
        """ζ of an exponential wall."""
        return self.job.get("wall", {}).get("zeta")

    @property
    def modulus(self) -> float:
        """E'."""
        return float(self.job["solid"]["contact_modulus"])

    def stiffness(self, q: np.ndarray) -> np.ndarray:
        """Pressure per displacement of modes |q| > 0 (rad/length)."""
        return build(SOLIDS, self.job["solid"]).stiffness(q)

    @property
    def hurst(self) -> float | None:
        """H of a self-affine surface."""
        return self.job["surface"].get("hurst")

    @property
    def seed(self) -> int | None:
        """Seed of a random surface."""
        return self.job["surface"].get("seed")

    @cached_property
    def rms_slope(self) -> float:
        """√⟨|∇h|²⟩, spectral: what the job says, else from κ = f_c E' g/p̄, else from the spectrum of the heights."""
        asked = self.job["surface"].get("rms_slope")
        if asked is not None:
            return float(asked)
        kappa = self.number("kappa")
        if self.area > 0 and math.isfinite(kappa):
            return kappa * self.mean_pressure / (self.area * self.modulus)
        q, power, count = self.spectrum("height")
        return float(np.sqrt(np.sum(q**2 * power * count)))

    @property
    def full_contact_std(self) -> float:
        """E' g/2, the standard deviation of the pressure in full contact."""
        return self.modulus * self.rms_slope / 2

    @property
    def open(self) -> bool:
        """Whether fields end at the border."""
        return self.job["grid"].get("boundary") == "open"

    @property
    def spacings(self) -> tuple[float, float]:
        """Grid spacings (ax, ay)."""
        (nx, ny), (lx, ly) = self.results.shape, self.results.lengths
        return lx / nx, ly / ny

    @property
    def wavelengths(self) -> tuple[float, float]:
        """Shortest and longest wavelength (λ_s, λ_l) of the heights as lengths.

        Of a self-affine surface as the job says, of others those of the grid: two spacings, and the cell.
        """
        surface, spacing, cell = self.job["surface"], min(self.spacings), max(self.results.lengths)
        if surface.get("lambda_s") is None:
            return 2 * max(self.spacings), cell
        given = [surface[name] * spacing for name in ("lambda_l", "lambda_r") if surface.get(name) is not None]
        return surface["lambda_s"] * spacing, min(max(given, default=cell), cell)

    @property
    def q_limits(self) -> tuple[float, float]:
        """q_l and the highest wave number: q_s, or the corner of the grid's spectrum where there is no cut-off."""
        shortest, longest = self.wavelengths
        if self.hurst is None or shortest <= max(self.spacings) * (1 + 1e-9):
            return 2 * np.pi / longest, np.pi * np.hypot(*(1 / spacing for spacing in self.spacings))
        return 2 * np.pi / longest, 2 * np.pi / shortest

    @property
    def q_unit(self) -> float:
        """q_l = 2π/λ_l, the unit in which wave numbers are drawn."""
        return self.q_limits[0]

    @cached_property
    def normalised_second_moment(self) -> float:
        """m₂ = ⟨σ²⟩_c/σ_c²; NaN where the run did not keep it."""
        if "pressure_moments" not in self.kept:
            return math.nan
        moments = self.groups["pressure_moments"]
        return float(moments["value"][np.flatnonzero(moments["order"] == 2)[0]])

    def spectrum(self, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """q, |f̃|² averaged over direction (f̃ the Fourier coefficient: sums over modes are means), count of modes.

        name : "stress", "contact", "height", "bearing", …; from the fields if the run did not keep it.
        """
        if f"{name}_spectrum" not in self.kept:
            return rowblocks.radial_spectrum(self.blocks(name), *self._cell, edges=self.edges)
        kept = self.groups[f"{name}_spectrum"]
        return kept["q"], kept["value"], kept["count"]

    @cached_property
    def edges(self) -> np.ndarray:
        """Edges of the bins of this load's spectra: those of the file, or 20 to a decade up to the cut-off."""
        for name in self.kept:
            if name.endswith("_spectrum") and "edges" in self.groups[name]:
                return self.groups[name]["edges"]
        return binning.bin_edges(*self._cell, q_max=self.q_limits[1])

    def weighted_spectrum(
        self, name: str, weight: Callable[[np.ndarray], np.ndarray], edges: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """q, mean of weight(|q|) |f̃|², weighed mode by mode, and modes, of the bins that `spectrum` returns: (m,)
        each.

        From the field; raises InputError if the run did not keep it.
        """
        edges = self.edges if edges is None else edges
        return rowblocks.radial_spectrum(self.blocks(name), *self._cell, edges=edges, weight=weight)

    def full_contact(self) -> np.ndarray:
        """(stiffness |h̃|)², the stress spectrum in full contact, per bin of `spectrum`: (m,).

        Mode by mode as the run kept it, or from its heights; else with the mean q of each bin.
        """
        if "full_contact_spectrum" in self.kept:
            return self.groups["full_contact_spectrum"]["value"]
        if "height" in self.fields:
            return self.weighted_spectrum("height", lambda q: self.stiffness(q) ** 2)[1]
        q, power, _ = self.spectrum("height")
        return self.stiffness(q) ** 2 * power

    def correlation(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """r and ⟨f(0) f(r)⟩ averaged over direction; from the fields if the run did not keep it."""
        if f"{name}_acf" not in self.kept:
            return rowblocks.radial_autocorrelation(self.blocks(name), *self._cell)[:2]
        kept = self.groups[f"{name}_acf"]
        return kept["r"], kept["value"]

    def blocks(self, name: str) -> Iterable:
        """A field ("stress", "contact", "height", "gap") in row blocks."""
        field = FIELD_OF.get(name, name)
        if field not in self.fields:
            raise InputError(f"{self.folder}: no {name} spectrum was kept, and no field {field} to make it from")
        log.info("%s: %s from the field in row blocks", self.folder, name)
        if name == "contact" and self.law != "hard":
            raise InputError(f"{self.folder}: no contact spectrum was kept, and here pressures do not define it")
        blocks = self.results.blocks(field, None if field == "height" else self.index)
        return rowblocks.mapped(blocks, lambda values: values > 0) if name == "contact" else blocks

    @property
    def _cell(self):
        return self.results.shape, self.results.lengths


def loads(folders: Iterable[Path | str]) -> list[Load]:
    """Every completed load of the folders, in their order; for an ensemble those of each seed.  Raises InputError if
    there is none.
    """
    runs = [Results(run) for folder in folders for run in ensemble.folders(folder)]
    found = [Load(results, index) for results in runs for index in range(len(results))]
    if not found:
        raise InputError("no load was completed in the folders given")
    return found
