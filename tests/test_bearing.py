"""The bearing area: exact selection of its height, and the theory of Gaussian surfaces."""

import numpy as np
import pytest
from contacts import rough_on, solution_of, under_hard_wall

from pgfmd import theory
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables.bearing_area import threshold_for_count
from pgfmd.observables.contact import Contact
from pgfmd.observables.observable_kinds import OBSERVABLES
from pgfmd.observables.rough_surface import RoughSurface

pytestmark = [pytest.mark.mpi, pytest.mark.uneven]


def kinds():
    """Whole fields (23, 17) of several kinds, none with equal values."""
    rng = np.random.default_rng(3)
    normal = rng.normal(size=(23, 17))
    return {
        "both signs": normal,
        "offset": 1e9 + normal,
        "negative": normal - 50,
        "many scales": normal * 10.0 ** rng.integers(-300, 300, normal.shape),
        "denormal": rng.permutation(normal.size).reshape(normal.shape) * 5e-324,
        "neighbours": 1 + rng.permutation(normal.size).reshape(normal.shape) * 2.0**-52,
    }


@pytest.mark.parametrize("kind", list(kinds()))
def test_exact_to_the_pixel(comm, kind):
    """Exactly as many points lie above the threshold as asked for, none, one, all but one and all included."""
    grid, whole = SlabGrid(comm, (23, 17)), kinds()[kind]
    heights = whole[grid.rows].copy()
    for count in (0, 1, 2, 100, 200, grid.size // 2, grid.size - 1, grid.size):
        threshold = threshold_for_count(grid, heights, count)
        assert np.count_nonzero(whole > threshold) == count
        if count < grid.size:
            assert threshold == np.sort(whole.ravel())[grid.size - count - 1]


def test_equal_heights(comm):
    """Of equal heights none counts if all would be too many: fewer points lie above, with the next lower one more."""
    grid = SlabGrid(comm, (12, 10))
    whole = np.random.default_rng(1).integers(-2, 3, (12, 10)) * np.where(np.arange(10) % 2, 1.0, -1.0)
    for count in range(grid.size):
        threshold = threshold_for_count(grid, whole[grid.rows].copy(), count)
        below = whole[whole <= threshold].max()
        assert np.count_nonzero(whole > threshold) <= count < np.count_nonzero(whole >= below)


def bearing(comm, n, hurst, seed, fraction, lambda_s=1.0, names=("bearing", "spectra", "acf")):
    """Groups of a surface whose contact, whatever it is, has the given relative area."""
    grid, heights = rough_on(comm, (n, n), hurst, lambda_s, 0.031, seed)
    pressure = np.zeros(grid.local_shape)
    pixels = round(fraction * grid.size)
    index = np.arange(grid.rows.start * n, grid.rows.stop * n).reshape(pressure.shape)
    pressure[index < pixels] = 1.0
    solution = solution_of(pressure, pressure, fraction)
    cutoff = 2 * np.pi / lambda_s if lambda_s > 1 else None
    problem = under_hard_wall(grid, heights)
    surface = RoughSurface(problem, [OBSERVABLES[name]() for name in names], cutoff)
    return grid, heights, Contact.of(surface, solution).measure()


def test_area_and_curves(comm):
    """The bearing mask has the contact's area to the pixel; its spectrum and autocorrelation are those of the mask."""
    grid, heights, groups = bearing(comm, 64, 0.5, 1, 0.1, names=("bearing", "spectra", "acf", "patches"))
    whole = grid.fetch(heights, 0, 64)
    mask = (whole > float(groups["bearing"]["threshold"])) * 1.0
    assert mask.sum() == round(0.1 * grid.size)
    assert groups["bearing_acf"]["value"][0] == pytest.approx(mask.mean(), rel=1e-13, abs=0)
    power = np.abs(np.fft.fft2(mask, norm="forward")) ** 2
    spectrum = groups["bearing_spectrum"]
    assert np.sum(spectrum["value"] * spectrum["count"]) == pytest.approx(power.sum() - power[0, 0], rel=1e-12, abs=0)
    along = [np.mean(mask * np.roll(mask, lag, 0)) for lag in range(33)]
    np.testing.assert_allclose(groups["bearing_acf_x"]["value"], along, atol=1e-14)
    patches = comm.bcast(groups["bearing_patches"])
    assert patches["area"].sum() == mask.sum() and "load" not in patches


def test_autocorrelation_of_a_gaussian_surface(comm):
    """⟨ΘΘ'⟩ follows from the height autocorrelation alone (Owen's T function) on a surface of many independent bumps.
    The cell holds 64² correlation areas, so that averages scatter by a few per cent of f_c."""
    grid, heights = rough_on(comm, (512, 512), 0.5, 8, 0.031, 2, lambda_l=16)
    pressure = (np.arange(grid.rows.start, grid.rows.stop) < 128)[:, None] * np.ones((1, 512))
    solution = solution_of(pressure, pressure, 0.25)
    problem = under_hard_wall(grid, heights)
    surface = RoughSurface(problem, [OBSERVABLES[name]() for name in ("bearing", "acf")])
    groups = Contact.of(surface, solution).measure()
    rho = groups["height_acf"]["value"] / groups["height_acf"]["value"][0]
    expected = theory.bearing.autocorrelation(rho, 0.25)
    assert rho.min() < -0.2  # the law is tested at both signs
    np.testing.assert_allclose(groups["bearing_acf"]["value"], expected, atol=0.005)


def exponent(spectrum, n, low=8, high=128):
    """−d ln C̃/d ln q between wave numbers low and high of the cell, each octave with the same weight."""
    k = spectrum["q"] * n / (2 * np.pi)
    inside = (k >= low) & (k <= high)
    return -np.polyfit(np.log(k[inside]), np.log(spectrum["value"][inside]), 1)[0]


@pytest.mark.long
@pytest.mark.parametrize("hurst", [0.3, 0.8])
def test_exponent(comm, hurst):
    """C̃_c ∝ q^−(2+H) in the self-affine range: n = 2048, λ_s = a, f_c = 0.09, k = 8 … 128, mean of 4 seeds, ± 0.15."""
    found = [exponent(bearing(comm, 2048, hurst, seed, 0.09)[2]["bearing_spectrum"], 2048) for seed in (1, 2, 3, 4)]
    if comm.rank == 0:
        print(hurst, np.round(found, 3), round(float(np.mean(found)), 3))
    assert np.mean(found) == pytest.approx(2 + hurst, abs=0.15)
