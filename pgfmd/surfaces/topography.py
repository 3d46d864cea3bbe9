"""Surface heights on a `SlabGrid`: self-affine, sinusoidal, paraboloidal, or an array that is given.

Heights are float64 of shape (nx_local, ny) in units of length; peaks are positive and touch first.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from pgfmd.errors import InputError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.parallel.collectives import Reduction

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
    slope = math.sqrt(Reduction(grid.comm).sum([value for _, value in sorted(squares)]))
    if not slope > 0:
        raise InputError(
            f"surface: no mode of the {nx} x {ny} grid lies between lambda_l = {lambda_l:g} and "
            f"lambda_s = {lambda_s:g}; lambda_l must reach the cell's longest mode and lambda_s must not exceed it"
        )
    heights *= rms_slope / slope
    return heights


def coordinates(grid: SlabGrid) -> tuple[np.ndarray, np.ndarray]:
    """Positions x (nx_local, 1) and y (1, ny) of the grid points, from 0 on."""
    x = grid.spacing[0] * np.arange(grid.rows.start, grid.rows.stop)[:, None]
    return x, grid.spacing[1] * np.arange(grid.shape[1])[None, :]


def sinusoid(grid: SlabGrid, amplitude: float, waves: tuple[int, int] = (1, 0)) -> np.ndarray:
    """Δ cos(2π m x/lx) cos(2π n y/ly) with waves = (m, n): a 1-D wave for n = 0, the 2-D sinusoid for (1, 1)."""
    x, y = coordinates(grid)
    (lx, ly), (m, n) = grid.lengths, waves
    return amplitude * np.cos(2 * np.pi * m / lx * x) * np.cos(2 * np.pi * n / ly * y)


def paraboloid(grid: SlabGrid, radius: float) -> np.ndarray:
    """−r²/2R about the centre of the cell, r the distance to it."""
    x, y = coordinates(grid)
    return -((x - grid.lengths[0] / 2) ** 2 + (y - grid.lengths[1] / 2) ** 2) / (2 * radius)
