"""Surfaces: spectrum, slope, and the same surface on every rank count and grid."""

import numpy as np
import pytest
from mpi4py import MPI

from pgfmd.errors import InputError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.transfer import restrict
from pgfmd.surfaces.paraboloid import paraboloid
from pgfmd.surfaces.self_affine import hermitian_noise, self_affine, self_affine_amplitude
from pgfmd.surfaces.sinusoid import sinusoid
from pgfmd.surfaces.surface import coordinates

pytestmark = pytest.mark.mpi


def modes(grid, heights):
    """|h̃|² (Fourier coefficients) and |q| of this rank."""
    return np.abs(grid.forward(heights) / grid.size) ** 2, np.sqrt(grid.q_squared())


@pytest.mark.parametrize("shape", [(64, 64), (45, 64), (37, 41)])
def test_slope_is_exact(comm, shape):
    """√Σ q²|h̃|² is the rms slope asked for, to rounding."""
    grid = SlabGrid(comm, shape, (shape[0] * 0.5, shape[1] * 2.0))
    power, q = modes(grid, self_affine(grid, 0.7, 1.0, 0.031, 3))
    assert np.sqrt(grid.reduction.sum(grid.hermitian_weight * q**2 * power)) == pytest.approx(0.031, rel=1e-12)


def test_modes_lie_between_the_cut_offs(comm):
    """No power below 2π/λ_l or above 2π/λ_s; λ_s = a keeps every mode, corners included."""
    grid = SlabGrid(comm, (64, 64))
    power, q = modes(grid, self_affine(grid, 0.5, 8.0, 1.0, 1, lambda_l=32.0))
    inside = (q > 2 * np.pi / 32 * (1 - 1e-9)) & (q < 2 * np.pi / 8 * (1 + 1e-9))
    largest = grid.reduction.max(power)
    assert grid.reduction.max(power[~inside]) < 1e-28 * largest
    assert grid.reduction.min(power[inside]) > 0
    power, q = modes(grid, self_affine(grid, 0.5, 1.0, 1.0, 1))
    assert grid.reduction.min(power[q > 0]) > 1e-12 * grid.reduction.max(power[q > 3])


@pytest.mark.parametrize("hurst", [0.0, 0.3, 1.0])
def test_spectrum_falls_as_a_power_law(comm, hurst):
    """⟨|h̃|²⟩ q^(2+2H) is constant: in two bands of thousands of modes their means agree within 5 standard errors."""
    grid = SlabGrid(comm, (256, 256))
    power, q = modes(grid, self_affine(grid, hurst, 1.0, 1.0, 7))
    flat = power * np.where(q > 0, q, 1) ** (2 + 2 * hurst)
    bands = [(q > low) & (q < 2 * low) for low in (0.3, 1.2)]
    means = [grid.reduction.sum(flat[band]) / grid.reduction.sum(band) for band in bands]
    error = np.sqrt(sum(1 / grid.reduction.sum(band) for band in bands))
    assert abs(np.log(means[0] / means[1])) < 5 * error


def test_roll_off_is_flat(comm):
    """Between λ_l and λ_r the spectrum is a plateau at its value at λ_l."""
    q = np.array([0.05, 0.1, 0.3, 0.5, 1.0, 4.0])
    found = self_affine_amplitude(q, 0.5, q_l=0.5, q_s=3.0, q_r=0.1)
    assert np.allclose(found, [0, 0.5**-1.5, 0.5**-1.5, 0.5**-1.5, 1, 0])


def test_noise_is_bitwise_the_same_on_any_rank_count(comm):
    """Noise depends on (seed, kx, ky) alone: a rank's modes are bit for bit those of one process."""
    shape = (31, 26)
    grid, alone = SlabGrid(comm, shape), SlabGrid(MPI.COMM_SELF, shape)
    mine, whole = np.empty(grid.spectral_shape, complex), np.empty(alone.spectral_shape, complex)
    hermitian_noise(4, *shape, grid.columns.start, np.ones(grid.spectral_shape), mine)
    hermitian_noise(4, *shape, 0, np.ones(alone.spectral_shape), whole)
    assert np.array_equal(mine, whole[grid.columns])


def test_noise_is_gaussian_of_variance_one():
    """Moments ⟨|z|²⟩ = 1, ⟨|z|⁴⟩ = 2, ⟨z²⟩ = 0 within 5 standard errors, and different seeds are independent."""
    block = np.empty((2, 200, 201), complex)
    for seed in (0, 1):
        hermitian_noise(seed, 401, 400, 1, np.ones((199, 401)), np.empty((199, 401), complex))
        wide = np.empty((199, 401), complex)
        hermitian_noise(seed, 401, 400, 1, np.ones((199, 401)), wide)
        block[seed, :199] = wide[:, :201]
    z = block[:, :199]
    error = 5 / np.sqrt(z[0].size)
    assert abs(np.mean(np.abs(z[0]) ** 2) - 1) < error
    assert abs(np.mean(np.abs(z[0]) ** 4) - 2) < error * np.sqrt(20)
    assert abs(np.mean(z[0] ** 2)) < error * np.sqrt(2)
    assert abs(np.mean(z[0] * np.conj(z[1]))) < error


def test_same_surface_on_a_finer_grid(comm):
    """A band-limited surface on twice the points is the same function: its restriction is the coarse one."""
    for shape in ((64, 64), (40, 56)):
        coarse = SlabGrid(comm, shape, (64.0, 64.0))
        fine = SlabGrid(comm, (2 * shape[0], 2 * shape[1]), (64.0, 64.0))
        heights = self_affine(fine, 0.8, 8.0, 0.5, 2)
        expected = self_affine(coarse, 0.8, 8.0, 0.5, 2)
        assert np.abs(restrict(fine, coarse, heights) - expected).max() < 1e-12 * np.abs(expected).max()


def test_an_empty_band_is_refused(comm):
    """No mode between the cut-offs: an error on all ranks, not a flat surface."""
    with pytest.raises(InputError, match="no mode"):
        self_affine(SlabGrid(comm, (16, 16)), 0.5, 12.0, 1.0, 1, lambda_l=13.0)


def test_simple_shapes(comm):
    """Sinusoids have their amplitude at the origin, the paraboloid its curvature about the centre."""
    grid = SlabGrid(comm, (16, 12), (8.0, 6.0))
    x, y = coordinates(grid)
    assert np.allclose(sinusoid(grid, 2.0, (1, 1)), 2 * np.cos(np.pi * x / 4) * np.cos(np.pi * y / 3))
    expected = -((x - 4) ** 2 + (y - 3) ** 2) / 20
    assert np.allclose(paraboloid(grid, 10.0), expected)
