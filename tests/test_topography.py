"""Surfaces: spectrum, slope, the same surface on every rank count and grid; rough surfaces from a table of C(q)."""

import cmath
import math

import numpy as np
import pytest
from conftest import once
from job_texts import SOLID
from mpi4py import MPI

from pgfmd.application import job
from pgfmd.application.results import Results
from pgfmd.application.simulate import simulate
from pgfmd.errors import InputError
from pgfmd.grid.cell import Cell
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.transfer import SubGrid, restrict
from pgfmd.surfaces.paraboloid import Paraboloid
from pgfmd.surfaces.random_modes import RandomModes
from pgfmd.surfaces.rigid_surface import coordinates
from pgfmd.surfaces.self_affine import SelfAffine, self_affine, self_affine_variance
from pgfmd.surfaces.sinusoid import sinusoid
from pgfmd.surfaces.spectrum import FromSpectrum
from pgfmd.theory import surface as theory

pytestmark = pytest.mark.mpi

def modes(grid, heights):
    """|h̃|² (Fourier coefficients) and |q| of this rank."""
    return np.abs(grid.forward(heights) / grid.size) ** 2, np.sqrt(grid.q_squared())


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


def test_roll_off_is_flat():
    """C is constant for 2π/λ_l ≤ q < 2π/λ_r, falls from its value there on, and is zero elsewhere."""
    k = np.array([0, 0.05, 0.1, 0.3, 0.5, 1.0, 3.0, 4.0])
    found = self_affine_variance(0.5, k_l=0.1, k_r=0.5, k_s=3.0)(k**2)
    assert np.allclose(found, [0, 0, 1, 1, 1, 0.5**3, 6.0**-3, 0], rtol=1e-14, atol=0)


def ones(k_squared):
    return np.ones_like(k_squared)


def test_modes_are_bitwise_the_same_on_any_rank_count_and_grid(comm):
    """Modes depend on (seed, kx, ky) alone: bit for bit those of one process, of any columns, and of finer grids."""
    for shape in ((31, 26), (32, 27), (8, 1), (67, 2)):
        grid, alone = SlabGrid(comm, shape), SlabGrid(MPI.COMM_SELF, shape)
        fine = SlabGrid(MPI.COMM_SELF, tuple(2 * count + 3 for count in shape))
        mine, whole, more = (np.empty(each.spectral_shape, complex) for each in (grid, alone, fine))
        for column in range(len(mine)):
            RandomModes(grid, 4, ones).fill(mine[column : column + 1], column)
        RandomModes(alone, 4, ones).fill(whole, 0)
        RandomModes(fine, 4, ones).fill(more, 0)
        assert np.array_equal(mine, whole[grid.columns])
        inside = slice(1, (shape[1] + 1) // 2)  # without ky = 0 and ny/2, and kx = nx/2 which stands for two modes
        half = (shape[0] - 1) // 2
        assert np.array_equal(more[inside, : half + 1], whole[inside, : half + 1])
        assert np.array_equal(more[inside, -half:], whole[inside, -half:])


def brute_mode(seed, kx, ky):
    """The number of a mode from its definition, with Python's integers and libm: splitmix64 of seed, kx, ky in turn
    gives 53 bits each for the modulus √−ln u and the phase."""

    def mix(z):
        z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9 % 2**64
        z = (z ^ (z >> 27)) * 0x94D049BB133111EB % 2**64
        return z ^ (z >> 31)

    golden = 0x9E3779B97F4A7C15
    state = mix((seed + golden) % 2**64)
    state = mix(state ^ (kx * golden % 2**64))
    state = mix((state + ky * 0xD1342543DE82EF95) % 2**64)
    first = ((mix((state + golden) % 2**64) >> 11) + 1) / 2**53
    second = (mix((state + 2 * golden) % 2**64) >> 11) / 2**53
    return math.sqrt(-math.log(first)) * cmath.exp(2j * math.pi * second)


@pytest.mark.parametrize("seed", [0, 1, 2**63 - 1])
def test_modes_are_those_of_their_definition(seed):
    """Each mode is its number times the root of its variance, to rounding (4 ulp), so that a seed names the same
    surface in every version; modes that mirror themselves are Hermitian, and real with the same variance where they
    stand alone."""
    grid = SlabGrid(MPI.COMM_SELF, (12, 10), (3.0, 4.0))

    def variance(k_squared):
        return np.exp(-k_squared / 25)

    block = np.empty(grid.spectral_shape, complex)
    moment = RandomModes(grid, seed, variance).fill(block, 0)
    total = 0.0
    for ky in range(6):
        for i in range(12):
            kx, number = i if i <= 6 else i - 12, None
            if ky in (0, 5):
                number = brute_mode(seed, abs(kx), ky)
                number = math.sqrt(2) * number.real if kx in (0, 6) else number if kx > 0 else number.conjugate()
            else:
                number = brute_mode(seed, kx, ky)
            k_squared = (kx * 4 / 3) ** 2 + ky**2
            expected = number * math.exp(-k_squared / 50)
            assert abs(block[ky, i] - expected) <= 4 * 2.2e-16 * abs(expected)
            total += (1 if ky in (0, 5) else 2) * k_squared * abs(expected) ** 2
    assert moment == pytest.approx(total, rel=1e-13, abs=0)


def test_modes_are_gaussian_of_variance_one():
    """Moments ⟨|z|²⟩ = 1, ⟨|z|⁴⟩ = 2, ⟨z²⟩ = 0 within 5 standard errors, and different seeds are independent."""
    grid = SlabGrid(MPI.COMM_SELF, (401, 400))
    blocks = np.empty((2, *grid.spectral_shape), complex)
    for seed in (0, 1):
        RandomModes(grid, seed, ones).fill(blocks[seed], 0)
    z = blocks[:, 1:200]
    error = 5 / np.sqrt(z[0].size)
    assert abs(np.mean(np.abs(z[0]) ** 2) - 1) < error
    assert abs(np.mean(np.abs(z[0]) ** 4) - 2) < error * np.sqrt(20)
    assert abs(np.mean(z[0] ** 2)) < error * np.sqrt(2)
    assert abs(np.mean(z[0] * np.conj(z[1]))) < error


def test_same_surface_on_a_finer_grid(comm):
    """A band-limited surface on twice the points is the same function: its restriction is the coarse one."""
    for shape in ((64, 64), (40, 56)):
        fine = SlabGrid(comm, (2 * shape[0], 2 * shape[1]), (64.0, 64.0))
        coarse = SubGrid(fine, shape, fine.lengths)
        found = restrict(fine, coarse, self_affine(fine, 0.8, 8.0, 0.5, 2))
        if coarse.grid is not None:
            expected = self_affine(coarse.grid, 0.8, 8.0, 0.5, 2)
            assert np.abs(found - expected).max() < 1e-12 * np.abs(expected).max()


def test_simple_shapes(comm):
    """Sinusoids have their amplitude at the origin, the paraboloid its curvature about the centre."""
    grid = SlabGrid(comm, (16, 12), (8.0, 6.0))
    x, y = coordinates(grid)
    waves = 2 * np.cos(np.pi * x / 4) * np.cos(np.pi * y / 3)
    assert np.allclose(sinusoid(grid, 2.0, (1, 1)), waves, rtol=0, atol=1e-14)
    expected = -((x - 4) ** 2 + (y - 3) ** 2) / 20
    assert np.allclose(Paraboloid(radius=10.0).heights(grid), expected, rtol=1e-14, atol=0)


def test_generator_and_theory_mean_the_same_wavelengths(comm):
    """Mean |h̃|² in the plateau and in three bands of the power law is (2π)² C/A₀ of the continuum theory with the same
    λ_s, λ_r, λ_l and slope: to 4 standard errors, after the one factor by which the sum over the modes of this surface
    differs from the integral that the theory is scaled with."""
    grid = SlabGrid(comm, (256, 192), (128.0, 96.0))
    options = {"hurst": 0.7, "lambda_s": 4.0, "lambda_r": 32.0, "lambda_l": 96.0, "rms_slope": 0.2}
    power, q = modes(grid, SelfAffine(**{**options, "lambda_s": 8, "lambda_r": 64, "lambda_l": 192}).heights(grid))
    expected = (2 * np.pi) ** 2 / (128 * 96) * theory.SelfAffineSpectrum(**options).density(q)
    factor = 0.2**2 / grid.reduction.sum(grid.hermitian_weight * q**2 * expected)
    assert abs(factor - 1) < 0.05
    edges = 2 * np.pi / np.array([96.0, 32.0, 16.0, 8.0, 4.0])
    for low, high in zip(edges, edges[1:], strict=False):
        band = (q > low * 1.001) & (q < high * 0.999)
        count = grid.reduction.sum(band * grid.hermitian_weight)
        ratio = grid.reduction.sum((grid.hermitian_weight * power)[band] / expected[band]) / count
        assert abs(ratio / factor - 1) < 4 * np.sqrt(2 / count)
    outside = (q < edges[0] * 0.999) | (q > edges[-1] * 1.001)
    assert grid.reduction.max(power[outside]) < 1e-20 * grid.reduction.max(power)


@pytest.mark.parametrize("exponent", [-100, 100])
def test_any_unit_of_length(comm, exponent):
    """The same heights, in units from 1e-100 to 1e100 of the length; to rounding."""
    unit = 10.0**exponent
    expected = self_affine(SlabGrid(comm, (16, 12), (2.0, 1.0)), 0.8, 0.5, 0.1, 3)
    found = self_affine(SlabGrid(comm, (16, 12), (2.0 * unit, unit)), 0.8, 0.5 * unit, 0.1, 3)
    assert np.allclose(found / unit, expected, rtol=1e-12, atol=1e-14 * np.abs(expected).max(initial=0))


@pytest.mark.parametrize("seed", range(60))
def test_any_options_on_any_grid(comm, seed):
    """Options drawn from all that a job accepts, on grids of any shape, cell and rank count: the slope is exact, modes
    are zero outside the band of wavelengths and beyond the cut-off that the surface names, and it is refused just where
    no mode lies inside; to rounding."""
    chance = np.random.default_rng(seed)
    shape = tuple(int(count) for count in chance.choice([1, 2, 3, 8, 15, 16, 31], 2))
    shape = max(shape[0], comm.size), shape[1] if shape[0] > 1 else max(shape[1], 2)
    cell = Cell(n=shape, length=tuple(10.0 ** chance.uniform(-9, 9) * chance.uniform(1, 3, 2)))
    longest = max(cell.lengths) / min(cell.spacings)
    lengths = np.sort(longest ** chance.uniform(-0.1, 1, 3))
    options = {"hurst": chance.choice([0, 1, chance.uniform()]), "lambda_s": lengths[0], "rms_slope": chance.uniform()}
    options |= {"lambda_r": lengths[1]} if chance.random() < 0.5 else {}
    options |= {"lambda_l": chance.choice([lengths[2], np.inf])} if chance.random() < 0.5 else {}
    surface = SelfAffine(seed=int(chance.integers(2**63)), **options)
    surface.check_in(cell)
    grid = SlabGrid(comm, shape, cell.lengths)
    shortest, widest, _ = surface.wavelengths(cell)
    q = np.sqrt(grid.q_squared())
    upper = 2 * np.pi / shortest if shortest > max(cell.spacings) else np.inf
    outside = (q < 2 * np.pi / widest * (1 - 1e-6)) | (q > upper * (1 + 1e-6))
    if not grid.reduction.any(not outside.all()):
        with pytest.raises(InputError, match="no mode"):
            surface.heights(grid)
        return
    power, _ = modes(grid, surface.heights(grid))
    slope = np.sqrt(grid.reduction.sum(grid.hermitian_weight * q**2 * power))
    assert slope == pytest.approx(options["rms_slope"], rel=1e-12, abs=0)
    outside |= q > (surface.cutoff(cell) or np.inf) * (1 + 1e-6)
    assert grid.reduction.max(power[outside]) <= 1e-25 * grid.reduction.max(power)


BENT = np.array([[0.1, 3.0], [0.2, 0.5], [1.0, 0.6], [2.5, 1e-4]])  # C that falls, rises and falls


def saved(comm, path, table):
    write = (np.save, path, table) if path.suffix == ".npy" else (np.savetxt, path, table, "%.18e", ", ")
    once(comm, *write)
    return str(path)


def interpolated(table, q):
    """C at each q, written here again: the power law between two entries, zero outside."""
    spectrum = np.zeros_like(q)
    for (low, left), (high, right) in zip(table, table[1:], strict=False):
        inside = (q >= low) & (q <= high)
        spectrum[inside] = left * (q[inside] / low) ** (np.log(right / left) / np.log(high / low))
    return spectrum


def wave_numbers(shape, lengths):
    qx, qy = (2 * np.pi * np.fft.fftfreq(count, length / count) for count, length in zip(shape, lengths, strict=True))
    return np.hypot(qx[:, None], qy)


def test_a_self_affine_table_is_the_self_affine_surface(comm, shared_tmp_path):
    """Three entries are a self-affine spectrum with roll-off: the same seed gives the same heights, up to the one
    factor that makes the slope of the other kind exact; to rounding."""
    grid = SlabGrid(comm, (64, 48), (32.0, 24.0))
    spectrum = theory.SelfAffineSpectrum(hurst=0.7, lambda_s=2.0, lambda_r=8.0, lambda_l=24.0, rms_slope=0.2)
    q = 2 * np.pi / np.array([24.0, 8.0, 2.0])
    table = np.stack([q, (2 * np.pi) ** 2 * spectrum.density(q)], axis=1)
    found = FromSpectrum(path=saved(comm, shared_tmp_path / "c.npy", table), seed=5).heights(grid)
    options = {"hurst": 0.7, "lambda_s": 4, "lambda_r": 16, "lambda_l": 48, "rms_slope": 0.2, "seed": 5}
    expected = SelfAffine(**options).heights(grid)
    factor = grid.reduction.dot(found, expected) / grid.reduction.dot(expected, expected)
    assert np.allclose(found, factor * expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    assert 0.8 < factor < 1.25  # 1 on average over seeds and large cells


def test_heights_and_slopes_are_the_sums_of_the_table(comm, shared_tmp_path):
    """⟨h²⟩ = Σ C/A₀ and ⟨|∇h|²⟩ = Σ q² C/A₀ over the modes of the cell, on average over 40 seeds: within 5 standard
    errors of Gaussian modes; and over fine modes ⟨h²⟩ is ∫ C d²q/(2π)², to the 1 % of a sum that follows a bent curve.
    """
    shape, lengths = (64, 48), (100.0, 120.0)
    grid, q = SlabGrid(comm, shape, lengths), wave_numbers(shape, lengths)
    path = saved(comm, shared_tmp_path / "c.csv", BENT)
    power = interpolated(BENT, q) / np.prod(lengths)
    found = []
    for seed in range(40):
        heights = FromSpectrum(path=path, seed=seed).heights(grid)
        modes = np.abs(grid.forward(heights) / grid.size) ** 2 * grid.hermitian_weight
        found.append([grid.reduction.sum(modes), grid.reduction.sum(modes * grid.q_squared())])
    for moment, weight in zip(np.mean(found, axis=0), (np.ones_like(q), q**2), strict=True):
        expected = np.sum(weight * power)
        error = np.sqrt(2 * np.sum((weight * power) ** 2) / 40)  # a mode and its conjugate are one
        assert abs(moment - expected) < 5 * error
    fine = np.linspace(0.1, 2.5, 10**6)
    integral = np.trapezoid(fine * interpolated(BENT, fine), fine) / (2 * np.pi)
    wide = wave_numbers((1000, 1000), (1000.0, 1000.0))
    assert np.sum(interpolated(BENT, wide)) / 1000**2 == pytest.approx(integral, rel=0.01)


@pytest.mark.parametrize("seed", range(4))
def test_every_band_of_a_random_table(comm, shared_tmp_path, seed):
    """A₀ |h̃|²/C is 1 on average over the modes between any two entries of a table of random length and slopes, within 5
    standard errors; modes outside the table are zero; one or several ranks, and a finer grid, give the same surface.
    """
    chance = np.random.default_rng(seed)
    lengths = tuple(float(length) for length in chance.uniform(50, 100, 2))
    shape = (80 + 11 * seed, 70)
    coarse = SlabGrid(comm, shape, lengths)
    highest = np.pi * min(coarse.shape[0] / lengths[0], coarse.shape[1] / lengths[1])
    q = np.sort(chance.uniform(0.1, highest, chance.integers(2, 6)))
    table = np.stack([q, 10.0 ** chance.uniform(-6, 6, len(q))], axis=1)
    surface = FromSpectrum(path=saved(comm, shared_tmp_path / "c.npy", table), seed=seed)
    heights = surface.heights(coarse)
    whole = coarse.fetch(heights, 0, shape[0])
    alone = surface.heights(SlabGrid(MPI.COMM_SELF, shape, lengths))
    assert np.abs(whole - alone).max() <= 1e-13 * np.abs(alone).max()
    fine = SlabGrid(comm, (2 * shape[0], 2 * shape[1]), lengths)
    place = SubGrid(fine, shape, lengths)
    found = restrict(fine, place, surface.heights(fine))
    assert np.abs(found - whole[place.layout.rows]).max(initial=0) <= 1e-12 * np.abs(alone).max()

    power, waves = np.abs(np.fft.fft2(alone) / alone.size) ** 2, wave_numbers(shape, lengths)
    expected = interpolated(table, waves) / np.prod(lengths)
    assert power[expected == 0].max() <= 1e-25 * power.max()
    for low, high in zip(q, q[1:], strict=False):
        band = (waves > low) & (waves < high) & (expected > 1e-15 * expected.max())  # others are rounding
        if band.any():
            assert abs(np.mean(power[band] / expected[band]) - 1) < 5 * np.sqrt(2 / band.sum())


def test_job_end_to_end(comm, shared_tmp_path):
    """A job finds the table beside it, writes those heights, and cuts its spectra where the table ends."""
    saved(comm, shared_tmp_path / "c.txt", BENT)
    if comm.rank == 0:
        (shared_tmp_path / "job.toml").write_text(
            SOLID + "[grid]\nn = 64\n[surface]\nkind = 'spectrum'\npath = 'c.txt'\nseed = 3\n[load]\npressure = 0.1\n"
            "[solver]\ntolerance = 1e-3\n[output]\nfields = ['height']\nobservables = ['spectra']\n"
        )
    comm.Barrier()
    simulate(job.load(shared_tmp_path / "job.toml"), comm, shared_tmp_path / "out")
    results = Results(shared_tmp_path / "out")
    expected = FromSpectrum(path=str(shared_tmp_path / "c.txt"), seed=3).heights(SlabGrid(MPI.COMM_SELF, (64, 64)))
    assert np.abs(results.field("height") - expected).max() <= 1e-13 * np.abs(expected).max()
    q = results.load(0)["height_spectrum"]["q"]
    assert 2.0 < np.max(q) <= 2.5 * (1 + 1e-9)


WRONG = {
    "1 2\n": "at least two lines",
    "1 2 3\n2 3 4\n": "two columns",
    "1 2\n2 0\n": "must be > 0",
    "1 2\n2 -1\n": "must be > 0",
    "0 2\n2 1\n": "must be > 0",
    "1 2\n1 1\n": "larger than the one before",
    "2 2\n1 1\n": "larger than the one before",
    "1 nan\n2 1\n": "finite",
    "1 inf\n2 1\n": "finite",
    "1 2\n2\n": "line 2 has 1 numbers",
    "q C\n": "two columns",
    "": "two columns",
    "100 2\n200 1\n": "no mode of the 8 x 8 grid lies between q = 100 and 200; its lowest is 0.785398",
}


@pytest.mark.parametrize("content", WRONG, ids=range(len(WRONG)))
def test_tables_that_are_none(comm, shared_tmp_path, content):
    """Each is refused on all ranks with what is wrong with it."""
    path = shared_tmp_path / "c.txt"
    once(comm, path.write_text, content)
    with pytest.raises(InputError, match=WRONG[content]) as caught:
        FromSpectrum(path=str(path)).heights(SlabGrid(comm, (8, 8)))
    assert "\n" not in str(caught.value)


def test_files_that_are_no_table(comm, shared_tmp_path):
    """Missing, a folder, of another shape or type, cut short, damaged, several arrays: one line on all ranks."""
    if comm.rank == 0:
        np.save(shared_tmp_path / "flat.npy", np.ones(4))
        np.save(shared_tmp_path / "complex.npy", np.ones((4, 2), complex))
        np.save(shared_tmp_path / "cut.npy", BENT)
        whole = (shared_tmp_path / "cut.npy").read_bytes()
        (shared_tmp_path / "cut.npy").write_bytes(whole[:-9])
        (shared_tmp_path / "damaged.npy").write_bytes(whole.replace(b"shape'", b"shape("))
        with open(shared_tmp_path / "several.npy", "wb") as file:
            np.savez(file, q=BENT, C=BENT)
    comm.Barrier()
    for name in ("none.txt", "", "flat.npy", "complex.npy", "cut.npy", "damaged.npy", "several.npy"):
        with pytest.raises(InputError) as caught:
            FromSpectrum(path=str(shared_tmp_path / name)).heights(SlabGrid(comm, (8, 8)))
        assert "\n" not in str(caught.value) and str(shared_tmp_path) in str(caught.value)


def test_rank_0_alone_reads_the_table(comm, shared_tmp_path, monkeypatch):
    """A run ends alike on all ranks, whatever the others can read: it succeeds if rank 0 can read the table."""
    path = saved(comm, shared_tmp_path / "c.txt", BENT)

    def refuse(self):
        raise InputError("this rank cannot read the table")

    if comm.rank > 0:
        monkeypatch.setattr(FromSpectrum, "table", refuse)
    text = SOLID + f"[grid]\nn = 32\n[surface]\nkind = 'spectrum'\npath = '{path}'\n[load]\npressure = 0.1\n"
    simulate(job.parse(text + "[output]\nobservables = ['lowpass']\n"), comm, shared_tmp_path / "out")
    assert len(Results(shared_tmp_path / "out")) == 1


def test_a_csv_may_begin_with_words(comm, shared_tmp_path):
    """Names of the columns, as spreadsheets write them, are passed over."""
    path = shared_tmp_path / "c.csv"
    once(comm, path.write_text, "wave number,C\nrad/m,m4\n" + "\n".join(f"{q},{c}" for q, c in BENT))
    assert np.array_equal(np.stack(FromSpectrum(path=str(path)).table(), axis=1), BENT)
