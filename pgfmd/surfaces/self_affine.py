"""Randomly rough, self-affine surfaces."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pgfmd.grid.cell import Cell
from pgfmd.options.rules import POSITIVE, number, seeds
from pgfmd.options.section import key, wrong
from pgfmd.options.text import show
from pgfmd.surfaces.random_modes import RandomModes
from pgfmd.surfaces.rigid_surface import SEED, SLACK, Surface, single

if TYPE_CHECKING:
    from pgfmd.grid.slab_grid import SlabGrid

LONGEST = 16  # `known_height` sums over modes −16 … 16 along each axis, and integrates over the rest
HIGHEST = 1e150  # wave number of a wavelength 0 or tiny: its square is finite
log = logging.getLogger("pgfmd")


@dataclass(frozen=True, kw_only=True)
class SelfAffine(Surface):
    """Isotropic roughness, scaled to an exact rms slope: C(q) is constant for 2π/λ_l ≤ q < 2π/λ_r, ∝ q^(−2(1+H)) up to
    2π/λ_s, and zero elsewhere.

    Wavelengths are counted in grid spacings (the smaller one, where the two differ).
    """

    kind = "self-affine"
    cut_out = True
    centred = True
    hurst: float = key(number(low=0, high=1), None, "H of C ∝ q^(−2(1+H))", unit="1", needed=True, example=0.8)
    lambda_s: float = key(
        POSITIVE, None,
        "shortest wavelength; up to a pixel's longer side (1): every mode, corners |q| ≤ √2 π/a included",
        unit="grid spacings", needed=True, example=16.0,
    )  # fmt: skip
    lambda_l: float | None = key(
        number(above=0, infinite=True), None, "longest wavelength; the cell if not given", unit="grid spacings"
    )
    lambda_r: float | None = key(
        POSITIVE, None, "roll-off, from lambda_s to lambda_l; lambda_l if not given", unit="grid spacings"
    )
    rms_slope: float = key(
        number(low=0), None, "√⟨|∇h|²⟩ = √Σ q²|h̃|², exact, spectral", unit="1", needed=True, example=0.1
    )
    seed: int | tuple[int, ...] = key(seeds(), 1, SEED)

    def check(self) -> None:
        longest = math.inf if self.lambda_l is None else self.lambda_l
        if self.lambda_s > longest:
            raise wrong(self, "lambda_s", f"must not exceed lambda_l = {show(longest)}")
        if self.lambda_r is not None and self.lambda_r < self.lambda_s:
            raise wrong(self, "lambda_r", f"must not be below lambda_s = {show(self.lambda_s)}")
        if self.lambda_l is not None and self.lambda_r is not None and self.lambda_r > self.lambda_l:
            # Jobs for results of format_version 1 had the names of the two exchanged.
            log.warning(
                "surface: lambda_r = %g exceeds lambda_l = %g: the smaller is taken for the roll-off, the larger for "
                "the longest wavelength", self.lambda_r, self.lambda_l,
            )  # fmt: skip
            roll_off, longest = self.lambda_l, self.lambda_r
            object.__setattr__(self, "lambda_r", roll_off)
            object.__setattr__(self, "lambda_l", longest)

    def check_in(self, cell: Cell) -> None:
        longest = max(cell.lengths) / min(cell.spacings)
        for name in ("lambda_s", "lambda_l", "lambda_r"):
            if (getattr(self, name) or 0) > longest and getattr(self, name) != math.inf:
                raise wrong(self, name, f"must not exceed the cell, {longest:g} grid spacings")

    def wavelengths(self, cell: Cell) -> tuple[float, float, float]:
        """lambda_s, lambda_l and lambda_r as lengths, defaults filled in."""
        spacing, side = min(cell.spacings), max(cell.lengths)
        longest = side if self.lambda_l is None else min(self.lambda_l * spacing, side)
        return self.lambda_s * spacing, longest, longest if self.lambda_r is None else self.lambda_r * spacing

    def shortest_wavelength(self, cell: Cell) -> float:
        shortest = self.wavelengths(cell)[0]
        return shortest if shortest > max(cell.spacings) * (1 + SLACK) else 0.0

    def known_slope(self) -> float | None:
        return self.rms_slope

    def known_height(self, cell: Cell) -> float | None:
        shortest, longest, roll_off = (max(length, 2 * min(cell.spacings)) for length in self.wavelengths(cell))
        k_s, k_r = max(longest / shortest, 1.0), longest / roll_off  # in units of 2π/λ_l: squares do not overflow
        steps = [min(longest / side, HIGHEST) for side in cell.lengths]
        first = max(1.0, (LONGEST + 0.5) * min(steps))  # from here on the sum over modes is nearly an integral
        index = np.arange(LONGEST + 1)
        square = np.add.outer(*((step * index) ** 2 for step in steps)).ravel()
        weight = np.multiply.outer(*[np.where(index > 0, 2.0, 1.0)] * 2).ravel() * (square < first**2)
        if k_s > first:
            waves = np.geomspace(first, k_s, 256)
            between = 2 * math.pi * waves**2 * math.log(waves[1] / waves[0]) / math.prod(steps)
            square, weight = np.append(square, waves**2), np.append(weight, between)
        power = self_affine_variance(self.hurst, 1.0, k_r, k_s)(square) * weight
        total = float((power * square).sum())
        return self.rms_slope * math.sqrt(power.sum() / total) * longest / (2 * math.pi) if total else None

    def heights(self, grid: SlabGrid, length_unit: str | None = None) -> np.ndarray:
        wavelengths = self.wavelengths(Cell(n=grid.shape, length=grid.lengths))
        return _heights(grid, self.hurst, wavelengths, self.rms_slope, single(self.seed))


def self_affine(
    grid: SlabGrid, hurst: float, lambda_s: float, rms_slope: float, seed: int, lambda_l: float | None = None
) -> np.ndarray:
    """Heights (nx_local, ny) of a `SelfAffine` without roll-off, wavelengths given as lengths.  Collective.

    Raises InputError if no mode of the grid lies in the band.
    """
    longest = max(grid.lengths) if lambda_l is None else lambda_l
    return _heights(grid, hurst, (lambda_s, longest, longest), rms_slope, seed)


def self_affine_variance(hurst: float, k_l: float, k_r: float, k_s: float) -> Callable[[np.ndarray], np.ndarray]:
    """C from k², up to a factor: constant for k_l ≤ k < k_r, ∝ k^(−2(1+H)) up to k_s, both ends included, else 0."""

    def variance(k_squared: np.ndarray) -> np.ndarray:
        inside = (k_squared >= (k_l * (1 - SLACK)) ** 2) & (k_squared <= (k_s * (1 + SLACK)) ** 2)
        return np.maximum(k_squared / k_r**2, 1.0) ** -(1 + hurst) * inside

    return variance


def _heights(
    grid: SlabGrid, hurst: float, wavelengths: tuple[float, float, float], rms_slope: float, seed: int
) -> np.ndarray:
    """Heights (nx_local, ny) for the wavelengths λ_s, λ_l, λ_r as lengths.  If λ_s is at most the larger grid
    spacing, there is no upper cut-off: every mode of the grid counts, corners included.  Collective.
    """
    side = max(grid.lengths)
    k_s, k_l, k_r = (min(side / length, HIGHEST) if length else HIGHEST for length in wavelengths)
    if wavelengths[0] <= max(grid.spacing) * (1 + SLACK):
        k_s = math.inf

    if_none = (
        f"surface: no mode of the {grid.shape[0]} x {grid.shape[1]} grid lies between lambda_l = "
        f"{wavelengths[1]:g} and lambda_s = {wavelengths[0]:g}; the longest wavelength is {side:g}"
    )
    variance = self_affine_variance(hurst, k_l, k_r, k_s)
    return RandomModes(grid, seed, variance, k_s * (1 + SLACK)).heights(if_none, rms_slope)
