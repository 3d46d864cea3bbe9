"""Randomly rough surfaces with an isotropic spectrum, given as a table."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pgfmd.grid.cell import Cell
from pgfmd.options.rules import seeds
from pgfmd.options.section import key, path_key
from pgfmd.parallel.collectives import from_root
from pgfmd.surfaces.random_modes import RandomModes
from pgfmd.surfaces.readers import read_curve
from pgfmd.surfaces.rigid_surface import SEED, SLACK, Surface, single

if TYPE_CHECKING:
    from pgfmd.grid.slab_grid import SlabGrid


@dataclass(frozen=True, kw_only=True)
class FromSpectrum(Surface):
    """Isotropic roughness whose spectrum C(q) is a table: a power law between its entries, zero beyond its ends.

    C is the two-dimensional spectrum C^2D = A₀ ⟨|h̃|²⟩ = ⟨|∫ h exp(−iq·r) d²r|²⟩/A₀ (length⁴), h̃ the Fourier coefficient
    and A₀ the area of the cell: ⟨h²⟩ = ∫ C d²q/(2π)² (Jacobs, Junge, Pastewka 2017,
    doi:10.1088/2051-672X/aa51f8).  Amplitudes are Gaussian: C is the mean over seeds, not that of each surface.
    """

    kind = "spectrum"
    cut_out = True
    centred = True
    path: str = path_key(
        "text of two columns, or .npy (m, 2): q (radians per length), increasing, and C (length⁴), all > 0",
        "spectrum.csv",
    )
    seed: int | tuple[int, ...] = key(seeds(), 1, f'{SEED}; random numbers as for "self-affine"')

    def table(self) -> tuple[np.ndarray, np.ndarray]:
        """q and C, each (m,).  Raises InputError if the file holds no such table."""
        return read_curve(self.path, "C(q)")

    def check_inputs(self, cell: Cell, length_unit: str | None) -> str:
        q, _ = self.table()
        return f"table of {len(q)} entries, q from {q[0]:.6g} to {q[-1]:.6g}"

    def shortest_wavelength(self, cell: Cell) -> float:
        shortest = 2 * math.pi / float(self.table()[0][-1])
        return shortest if shortest > min(cell.spacings) * (1 + SLACK) else 0.0

    def heights(self, grid: SlabGrid, length_unit: str | None = None) -> np.ndarray:
        q, spectrum = from_root(grid.comm, self.table)
        unit = 2 * math.pi / max(grid.lengths)
        places, logarithms = np.log(q / unit), np.log(spectrum / (grid.lengths[0] * grid.lengths[1]))

        def variance(k_squared: np.ndarray) -> np.ndarray:
            place = np.log(k_squared, where=k_squared > 0, out=np.full(len(k_squared), -np.inf)) / 2
            inside = (place >= places[0] - SLACK) & (place <= places[-1] + SLACK)
            return np.exp(np.interp(place, places, logarithms)) * inside

        if_none = (
            f"{self.path}: no mode of the {grid.shape[0]} x {grid.shape[1]} grid lies between q = {q[0]:g} and "
            f"{q[-1]:g}; its lowest is {unit:g}"
        )
        return RandomModes(grid, single(self.seed), variance, q[-1] / unit * (1 + SLACK)).heights(if_none)
