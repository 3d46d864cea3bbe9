"""Randomly rough, self-affine surfaces."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numba
import numpy as np

from pgfmd.errors import InputError
from pgfmd.grid.cell import Cell
from pgfmd.options.rules import POSITIVE, integer, number
from pgfmd.options.section import key, wrong
from pgfmd.options.text import show
from pgfmd.surfaces.surface import Surface

if TYPE_CHECKING:
    from pgfmd.grid.slab_grid import SlabGrid

@dataclass(frozen=True, kw_only=True)
class SelfAffine(Surface):
    """C(q) ∝ q^(−2(1+H)) in a band of wavelengths, scaled to an exact rms slope.

    Wavelengths are counted in grid spacings (the smaller one, where the two differ).
    """

    kind = "self-affine"
    hurst: float = key(number(low=0, high=1), needed=True)  # C_h ∝ q^(−2(1+H))
    # Shortest wavelength.  1 or less: every mode of the grid, the corners |q| ≤ √2 π/a included.
    lambda_s: float = key(POSITIVE, needed=True)
    lambda_l: float | None = key(number(above=0, infinite=True))  # longest self-affine one; the cell if not given
    # Roll-off: the spectrum is constant from lambda_l up to lambda_r (≥ lambda_l, at most the cell); none if not given.
    lambda_r: float | None = key(number(above=0, infinite=True))
    rms_slope: float = key(number(low=0), needed=True)  # √⟨|∇h|²⟩, exact, spectral
    seed: int = key(integer(0), 1)

    def check(self) -> None:
        longest = math.inf if self.lambda_l is None else self.lambda_l
        if self.lambda_s > longest:
            raise wrong(self, "lambda_s", f"must not exceed lambda_l = {show(longest)}")
        if self.lambda_r is not None and self.lambda_r < longest:
            least = "the cell" if self.lambda_l is None else show(longest)
            raise wrong(self, "lambda_r", f"must not be below lambda_l = {least}")

    def check_in(self, cell: Cell) -> None:
        longest = max(cell.lengths) / min(cell.steps)
        for name in ("lambda_s", "lambda_l", "lambda_r"):
            if (getattr(self, name) or 0) > longest and getattr(self, name) != math.inf:
                raise wrong(self, name, f"must not exceed the cell, {longest:g} grid spacings")

    def wavelengths(self, cell: Cell) -> tuple[float, float, float]:
        """lambda_s, lambda_l and lambda_r as lengths, defaults filled in."""
        step, side = min(cell.steps), max(cell.lengths)
        longest = side if self.lambda_l is None else min(self.lambda_l * step, side)
        rolloff = longest if self.lambda_r is None else min(self.lambda_r * step, side)
        return self.lambda_s * step, longest, rolloff

    def shortest_wavelength(self, cell: Cell) -> float:
        shortest = self.wavelengths(cell)[0]
        return shortest if shortest > min(cell.steps) * (1 + 1e-9) else 0.0

    def heights(self, grid: SlabGrid, length_unit: str | None = None) -> np.ndarray:
        lambda_s, lambda_l, lambda_r = self.wavelengths(Cell(n=grid.shape, length=grid.lengths))
        rolloff = None if self.lambda_r is None else lambda_r
        return self_affine(grid, self.hurst, lambda_s, self.rms_slope, self.seed, lambda_l, rolloff)


_GOLDEN = np.uint64(0x9E3779B97F4A7C15)


@numba.njit(nogil=True, cache=True)
def _mix(z):
    """Finaliser of splitmix64 (Steele, Lea, Flood 2014, doi:10.1145/2714064.2660195): 64 well-mixed bits."""
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@numba.njit(nogil=True, cache=True)
def _mode_noise(seed, kx, ky):
    """Complex Gaussian number of variance 1 that belongs to mode (kx, ky) of that seed, whatever the grid."""
    state = _mix(np.uint64(seed) + _GOLDEN)
    state = _mix(state ^ (np.uint64(np.int64(kx)) * _GOLDEN))
    state = _mix(state + np.uint64(np.int64(ky)) * np.uint64(0xD1342543DE82EF95))
    first = (_mix(state + _GOLDEN) >> np.uint64(11)) + np.uint64(1)
    second = _mix(state + np.uint64(2) * _GOLDEN) >> np.uint64(11)
    modulus = math.sqrt(-math.log(np.float64(first) * 2.0**-53))
    phase = 2 * math.pi * np.float64(second) * 2.0**-53
    return complex(modulus * math.cos(phase), modulus * math.sin(phase))


@numba.njit(nogil=True, cache=True)
def hermitian_noise(seed, nx, ny, first_ky, amplitude, block):
    """block[j, i] = noise · amplitude[j, i] of mode ky = first_ky + j, kx in FFT order, such that its field is real."""
    for j in range(amplitude.shape[0]):
        ky = first_ky + j
        own_mirror = ky == 0 or 2 * ky == ny
        for i in range(nx):
            if amplitude[j, i] == 0:
                block[j, i] = 0
                continue
            kx = i if 2 * i <= nx else i - nx
            if not own_mirror:
                value = _mode_noise(seed, kx, ky)
            elif kx == 0 or 2 * kx == nx:  # real, of the same variance
                value = complex(math.sqrt(2.0) * _mode_noise(seed, kx, ky).real, 0.0)
            elif kx > 0:
                value = _mode_noise(seed, kx, ky)
            else:
                value = _mode_noise(seed, -kx, ky).conjugate()
            block[j, i] = value * amplitude[j, i]


def self_affine_amplitude(q: np.ndarray, hurst: float, q_l: float, q_s: float, q_r: float | None = None) -> np.ndarray:
    """√C(q) up to a factor: q^−(1+H) between q_l (or, with a roll-off, q_r ≤ q_l flat up to q_l) and q_s, both
    included, else 0.
    """
    slack = 1e-9  # a mode that lies on a cut-off belongs to the band on every grid
    low = q_l if q_r is None else q_r
    inside = (q >= low * (1 - slack)) & (q <= q_s * (1 + slack)) & (q > 0)
    return np.where(inside, np.maximum(q, q_l, where=inside, out=np.ones_like(q)) ** (-1 - hurst), 0.0)


def self_affine(
    grid: SlabGrid,
    hurst: float,
    lambda_s: float,
    rms_slope: float,
    seed: int,
    lambda_l: float | None = None,
    lambda_r: float | None = None,
) -> np.ndarray:
    """Isotropic self-affine surface of exactly that spectral rms slope √Σ q²|h̃|², heights (nx_local, ny).  Collective.

    C(q) ∝ q^(−2(1+H)) for 2π/λ_l ≤ q ≤ 2π/λ_s, with a constant plateau up to λ_r ≥ λ_l if given; λ_l is the longer
    side of the cell unless given.  λ_s up to the larger grid spacing means no upper cut-off: every mode of the grid,
    corners included. Amplitudes are Gaussian, and that of mode (kx, ky) depends on (seed, kx, ky) alone: one seed is
    one surface on every rank count and on every grid.  Raises InputError if no mode of the grid lies in the band.
    """
    lambda_l = max(grid.lengths) if lambda_l is None else lambda_l
    q_l, q_s = 2 * np.pi / lambda_l, 2 * np.pi / lambda_s if lambda_s > max(grid.spacing) * (1 + 1e-9) else math.inf
    q_r = None if lambda_r is None else 2 * np.pi / lambda_r
    nx, ny = grid.shape
    squares = []

    def spectrum(block: np.ndarray, first: int, stop: int):
        q = np.hypot(grid.qx, grid.qy[first:stop])
        hermitian_noise(seed, nx, ny, grid.columns.start + first, self_affine_amplitude(q, hurst, q_l, q_s, q_r), block)
        weights = grid.hermitian_weight[first:stop]
        squares.append((first, float(np.sum(weights * q**2 * np.abs(block) ** 2))))

    heights = np.empty(grid.local_shape)

    def keep(first: int, stop: int, rows: np.ndarray):
        heights[first:stop] = rows

    grid.make_field(spectrum, keep)
    slope = math.sqrt(grid.reduction.sum([value for _, value in sorted(squares)]))
    if not slope > 0:
        raise InputError(
            f"surface: no mode of the {nx} x {ny} grid lies between lambda_l = {lambda_l:g} and "
            f"lambda_s = {lambda_s:g}; lambda_l must reach the cell's longest mode and lambda_s must not exceed it"
        )
    heights *= rms_slope / slope
    return heights
