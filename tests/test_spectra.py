"""Spectra, autocorrelations and their averages against explicit sums, point by point and mode by mode."""

import itertools

import numpy as np
import pytest
from whole_fields import autocorrelation, power_spectrum, radial_autocorrelation, radial_average, rowblocks

from pgfmd.errors import InputError
from pgfmd.observables import binning

# Square, odd, stretched, and a cell whose shorter side has fewer points
GRIDS = [
    ((24, 24), (24.0, 24.0)),
    ((24, 17), (3.0, 5.0)),
    ((15, 20), (30.0, 7.0)),
    ((1, 6), (1.0, 6.0)),
    ((5, 1), (2.0, 1.0)),
]


def fields(shape):
    """A height-like field and a pressure-like one, with exact zeros."""
    rng = np.random.default_rng(7)
    height = rng.normal(size=shape)
    return height, np.maximum(height - 0.5, 0)


def all_modes(field, lengths):
    """Every Fourier coefficient by its defining sum: list of (|q|, coefficient)."""
    (nx, ny), (lx, ly) = field.shape, lengths
    x, y = np.arange(nx)[:, None] / nx, np.arange(ny)[None, :] / ny
    modes = []
    for kx, ky in itertools.product(range(-((nx - 1) // 2), nx // 2 + 1), range(-((ny - 1) // 2), ny // 2 + 1)):
        coefficient = np.mean(field * np.exp(-2j * np.pi * (kx * x + ky * y)))
        modes.append((2 * np.pi * np.hypot(kx / lx, ky / ly), coefficient))
    return modes


@pytest.mark.parametrize(("shape", "lengths"), GRIDS)
@pytest.mark.parametrize("bins", [{}, {"per_decade": 7}, {"spacing": "linear"}, {"spacing": "linear", "width": 2.5}])
def test_radial_average_is_the_mean_over_all_modes_of_a_ring(shape, lengths, bins):
    """The average over a half spectrum with Hermitian weights is the mean over all modes of a bin; rounding only."""
    field = fields(shape)[0]
    edges = binning.bin_edges(shape, lengths, **bins)
    expected = []
    for low, high in itertools.pairwise(edges):
        inside = [(q, abs(c) ** 2) for q, c in all_modes(field, lengths) if low < q <= high]
        if inside:
            expected.append((*np.mean(inside, axis=0), len(inside)))
    q, value, count = radial_average(power_spectrum(field), shape, lengths, **bins)
    np.testing.assert_allclose(np.transpose([q, value, count]), expected, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize(("shape", "lengths"), GRIDS)
@pytest.mark.parametrize("bins", [{}, {"per_decade": 3}, {"spacing": "linear"}, {"spacing": "linear", "width": 9.0}])
def test_bins_hold_every_mode_but_the_mean(shape, lengths, bins):
    """Counts add up to all N modes but q = 0, and with the mean they carry the whole mean square (Parseval)."""
    field = fields(shape)[0]
    _, value, count = radial_average(power_spectrum(field), shape, lengths, **bins)
    assert count.sum() == field.size - 1
    assert np.sum(count * value) + np.mean(field) ** 2 == pytest.approx(np.mean(field**2), rel=1e-13, abs=0)


def test_no_bin_reaches_beyond_the_cut_off():
    """With q_max, modes up to and including it are averaged and none beyond."""
    shape, lengths = (24, 24), (24.0, 24.0)
    cut_off = 2 * np.pi * 5 / 24
    modes = [q for q, _ in all_modes(np.zeros(shape), lengths)]
    for spacing in ("log", "linear"):
        q, _, count = radial_average(np.zeros((24, 13)), shape, lengths, spacing=spacing, q_max=cut_off)
        assert count.sum() == sum(0 < q <= cut_off * (1 + 1e-12) for q in modes)
        assert q[-1] <= cut_off * (1 + 1e-12)


@pytest.mark.parametrize("per_decade", [4, 5, 20])
def test_rounding_cannot_move_a_mode_to_another_bin(per_decade):
    """Bins are the same if every |q| moves by some units in the last place, also |k|² = 10 that lies on an edge."""
    shape, lengths = (64, 64), (64.0, 64.0)
    q = np.hypot(*rowblocks.wave_numbers(shape, lengths))
    edges = binning.bin_edges(shape, lengths, per_decade=per_decade)
    counts = [rowblocks.accumulate(edges, q * factor, 1.0)[0] for factor in (1 - 1e-14, 1, 1 + 1e-14)]
    np.testing.assert_array_equal(counts[0], counts[1])
    np.testing.assert_array_equal(counts[2], counts[1])


def test_blocks_in_any_layout_add_up(monkeypatch):
    """Sums over uneven blocks of the transposed spectrum are those of the whole: what ranks do.  Rounding only."""
    shape, lengths = (24, 17), (3.0, 5.0)
    height, pressure = (power_spectrum(field) for field in fields(shape))
    edges = binning.bin_edges(shape, lengths)
    qx, qy = rowblocks.wave_numbers(shape, lengths)
    weight = rowblocks.hermitian_weight(shape[1])
    whole = rowblocks.accumulate(edges, np.hypot(qx, qy), weight, height, pressure)
    monkeypatch.setattr(rowblocks, "BLOCK", 50)
    parts = sum(
        rowblocks.accumulate(edges, np.hypot(qx.T, qy.T[rows]), weight[rows, None], height.T[rows], pressure.T[rows])
        for rows in (slice(0, 1), slice(1, 6), slice(6, 6), slice(6, 9))
    )
    np.testing.assert_allclose(parts, whole, rtol=1e-13)


@pytest.mark.parametrize(("shape", "lengths"), GRIDS)
def test_autocorrelation_is_the_mean_of_products(shape, lengths):
    """C(Δr) = ⟨f(r) f(r+Δr)⟩, summed pair by pair with periodic shifts; rounding only."""
    pressure = fields(shape)[1]
    expected = np.empty(shape)
    for i, j in np.ndindex(shape):
        expected[i, j] = np.mean(pressure * np.roll(pressure, (-i, -j), axis=(0, 1)))
    result = autocorrelation(pressure)
    np.testing.assert_allclose(result, expected, rtol=0, atol=1e-14)
    assert result[0, 0] == pytest.approx(np.mean(pressure**2), rel=1e-13, abs=0)


@pytest.mark.parametrize(("shape", "lengths"), GRIDS)
def test_radial_autocorrelation_is_the_mean_over_rings_of_nearest_images(shape, lengths):
    """Each lag is measured to the nearest image, found by trying all; rings end at half the shorter side."""
    (nx, ny), (lx, ly) = shape, lengths
    correlation = fields(shape)[0]
    edges = binning.lag_edges(shape, lengths)
    assert edges[-1] == pytest.approx(min(lengths) / 2, rel=1e-8, abs=0)
    expected = []
    for low, high in itertools.pairwise(edges):
        ring = []
        for i, j in np.ndindex(shape):
            r = min(np.hypot(i * lx / nx - a * lx, j * ly / ny - b * ly) for a in (0, 1) for b in (0, 1))
            if low < r <= high:
                ring.append((r, correlation[i, j]))
        if ring:
            expected.append((*np.mean(ring, axis=0), len(ring)))
    r, value, count = radial_autocorrelation(correlation, lengths)
    np.testing.assert_allclose(np.transpose([r, value, count]), expected, rtol=1e-12, atol=1e-15)
    assert (r[0], value[0], count[0]) == (0, correlation[0, 0], 1)  # C(0) has a bin of its own


@pytest.mark.parametrize(
    "bad", [{"spacing": "cubic"}, {"per_decade": 0}, {"spacing": "linear", "width": -1}, {"q_max": np.nan}]
)
def test_wrong_bins_are_refused(bad):
    """A bin width, density or limit that is not positive, or an unknown spacing, is an input error that names it."""
    with pytest.raises(InputError, match=list(bad)[-1]):
        binning.bin_edges((8, 8), (8.0, 8.0), **bad)
