"""Rough surfaces from a table of C(q): the convention of C, its interpolation, and what is refused."""

import numpy as np
import pytest
from conftest import once
from job_texts import SOLID
from mpi4py import MPI

from pgfmd.application import job
from pgfmd.application.results import Results
from pgfmd.application.simulate import simulate
from pgfmd.errors import InputError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.transfer import SubGrid, restrict
from pgfmd.surfaces.self_affine import SelfAffine
from pgfmd.surfaces.spectrum import FromSpectrum
from pgfmd.theory import surface as theory

pytestmark = pytest.mark.mpi

BENT = np.array([[0.1, 3.0], [0.2, 0.5], [1.0, 0.6], [2.5, 1e-4]])  # C that falls, rises and falls


def saved(comm, path, table):
    once(comm, *(np.save, path, table) if path.suffix == ".npy" else (np.savetxt, path, table, "%.18e", ", "))
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
