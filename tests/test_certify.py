"""The certificate of anybody's pressure: against the dense reference, on all ranks, and from the command line."""

import json
import math

import numpy as np
import peers
import pytest
import reference
from mpi4py import MPI

import pgfmd
from pgfmd.application import cli
from pgfmd.options.text import with_error
from pgfmd.parallel.collectives import slab

pytestmark = pytest.mark.mpi

SEEDS = range(6)
CASES = {
    "half-space": {}, "oblong pixels": {"spacing": (1.0, 0.6)}, "bonded": {"thickness": 3.0, "poisson": 0.3},
    "sliding": {"thickness": 2.0, "base": "sliding"}, "free": {"thickness": 4.0, "base": "free"},
    "hardness": {"hardness": 1.5}, "exponential": {"zeta": 0.2},
}  # fmt: skip
MEAN = 0.4


def solved(options: dict, seed: int) -> tuple[np.ndarray, reference.Solved]:
    """Heights (8, 6) and the exact contact under MEAN."""
    heights = np.random.default_rng(seed).standard_normal((8, 6))
    slab_of = {name: options[name] for name in ("thickness", "base", "poisson") if name in options}
    contact = reference.Contact(heights, options.get("spacing", (1.0, 1.0)), reference.Solid(**slab_of))
    if "zeta" in options:
        return heights, contact.exponential(MEAN, options["zeta"])
    return heights, contact.hard(MEAN, options.get("hardness", math.inf))


def certify(comm, heights: np.ndarray, pressure: np.ndarray, mean: float | None = MEAN, **options):
    """`pgfmd.certify` of this rank's rows of whole fields."""
    rows = slab(len(heights), comm.size, comm.rank)
    if "hardness" in options:
        options["wall"] = {"kind": "hardness", "hardness": options.pop("hardness")}
    return pgfmd.certify(heights[rows], pressure[rows], mean, comm=comm, **options)


def ratio(comm, case: str, seed: int, change) -> float:
    """Certified over true energy error of the exact pressure (8, 6) after a change of it, which keeps its mean."""
    options = CASES[case]
    heights, exact = solved(options, seed)
    pressure = change((exact.x * exact.pressure).astype(float).reshape(heights.shape))
    pressure *= MEAN / pressure.mean()
    found = certify(comm, heights, pressure, **options)
    deviation = pressure.ravel() / MEAN - 1
    work = deviation @ (exact.contact.compliance @ deviation)
    return found.certified_error / float(exact.error_of(pressure) * exact.scaled_work / work)


@pytest.mark.mpi("breadth")
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("seed", SEEDS)
def test_the_bound_holds_for_random_pressures(comm, case, seed):
    """J(p) − J(p*) ≤ certified error · 2 E_el for a feasible p that has nothing to do with the solution p*."""
    limit = CASES[case].get("hardness", math.inf)

    def replaced(pressure):
        rng = np.random.default_rng(100 + seed)
        found = rng.exponential(MEAN, pressure.shape) * (rng.random(pressure.shape) < 0.7)
        for _ in range(50):  # of that mean, and below the hardness
            found = np.minimum(found * (MEAN / found.mean()), limit)
        return found

    assert ratio(comm, case, seed, replaced) >= 1 - 1e-9


@pytest.mark.mpi("breadth")
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("size", [1e-2, 1e-4])
def test_the_bound_is_sharp_near_the_solution(comm, case, size):
    """It is 1 to 1.7 times the true error of p* with small noise on all points below the hardness, touching or not."""

    def noisy(pressure):
        noise = np.abs(np.random.default_rng(7).standard_normal(pressure.shape)) * size * MEAN
        return np.where(pressure < CASES[case].get("hardness", math.inf) * (1 - 1e-9), pressure + noise, pressure)

    ratios = [ratio(comm, case, seed, noisy) for seed in SEEDS]
    assert min(ratios) >= 1 - 1e-6 and np.median(ratios) <= 1.7


def test_the_solution_itself_is_certified_to_rounding(comm):
    """The exact pressure, rounded to doubles, to 1e-20: all of its error comes from the last digits."""
    heights, exact = solved({}, 0)
    found = certify(comm, heights, (exact.x * exact.pressure).astype(float).reshape(heights.shape))
    assert found.certified_error <= 1e-20
    assert math.isclose(found.mean_gap, float(exact.mean_gap), rel_tol=1e-12)
    assert found.contact_area == np.count_nonzero(exact.x > 0) / heights.size


def test_what_the_projection_changes_is_said(comm):
    """Tensions are cut and the rest is scaled, to the given mean or another: by how much is computed here again."""
    heights, exact = solved({}, 1)
    given = (exact.x * exact.pressure).astype(float).reshape(heights.shape)
    given[np.unravel_index(np.argmin(heights), heights.shape)] = -1e-3 * MEAN
    mine = np.maximum(given, 0) * (given.mean() / np.maximum(given, 0).mean())
    for mean in (None, 2 * given.mean()):
        found = certify(comm, heights, given, mean)
        assert math.isclose(found.projection.given_mean, given.mean(), rel_tol=1e-14)
        assert math.isclose(found.projection.change, np.linalg.norm(mine - given) / np.linalg.norm(given), rel_tol=1e-9)
        assert math.isclose(found.mean_pressure, given.mean() if mean is None else mean, rel_tol=1e-14)


@pytest.mark.parametrize("trace", [1e-12, 1e-7, 1e-4])
def test_traces_are_no_contact(comm, trace):
    """Pressures of 1e-12 … 1e-4 of the mean everywhere: the area stays that of the solution, and their load is said."""
    heights, exact = solved({}, 2)
    pressure = (exact.x * exact.pressure).astype(float).reshape(heights.shape) + trace * MEAN
    found = certify(comm, heights, pressure)
    assert found.contact_area == np.count_nonzero(exact.x > 0) / heights.size
    assert math.isclose(found.projection.outside, trace * (1 - found.contact_area), rel_tol=1e-3)


@pytest.mark.parametrize("factor", [1e-6, 1e-3, 0.1, 3.0, 1e3, -1.0])
def test_another_scale_is_named(comm, caplog, factor):
    """Heights in another unit, or turned over: a line that names the factor by which they differ."""
    heights, exact = solved({}, 3)
    pressure = (exact.x * exact.pressure).astype(float).reshape(heights.shape)
    found = certify(comm, heights * factor, pressure)
    assert found.certified_error > 0.1 and "same units" in found.projection.doubt
    assert f"that are {1 / factor:.3g} times" in found.projection.doubt


@pytest.mark.parametrize(("change", "message"), [
    (lambda p: -p, "mean is -"), (lambda p: 0 * p, "mean is 0"), (lambda p: p * np.nan, "finite"),
    (lambda p: p[:, :-1], "shape"), (lambda p: p * 0 + 1, "the same everywhere"), (lambda p: p > 0, "real numbers"),
    (lambda p: p * 1e300 * 1e10, "finite"), (lambda p: p * 1e-300, "must lie between"),
])  # fmt: skip
def test_wrong_pressures_are_refused_in_one_line(comm, change, message):
    """InputError on all ranks."""
    heights, exact = solved({}, 4)
    with np.errstate(over="ignore"):
        pressure = change((exact.x * exact.pressure).astype(float).reshape(heights.shape))
    with pytest.raises(pgfmd.InputError, match=message) as caught:
        certify(comm, heights, pressure, None)
    assert str(caught.value).isprintable()


def test_peers_are_certified(comm):
    """tamaas at three tolerances, 128²: the bound is at least the true energy error, and at most 1.7 times it."""
    pytest.importorskip("tamaas")
    if comm.size > 1:
        pytest.skip("one process")
    rough = {"kind": "self-affine", "hurst": 0.8, "lambda_s": 8.0, "rms_slope": 0.1}
    heights, mean = pgfmd.surface({"grid": {"n": 128}, "surface": rough}), 0.01
    exact = pgfmd.solve(heights, mean, tolerance=1e-13)
    frequency = 2 * np.pi * np.hypot(*np.meshgrid(*[np.fft.fftfreq(128)] * 2, indexing="ij"))
    frequency[0, 0] = math.inf

    def square(field):
        return np.sum(np.abs(np.fft.fft2(field)) ** 2 * 2 / frequency) / field.size

    for tolerance in (1e-2, 1e-3, 1e-4):
        theirs, _ = peers.tamaas(heights, mean, tolerance, peers.Square(128, 1.0))
        change = theirs - exact.pressure
        true = (square(change) / 2 + np.sum(exact.gap * change)) / square(theirs)
        assert true <= pgfmd.certify(heights, theirs).certified_error <= 1.7 * true


@pytest.fixture
def files(tmp_path, comm):
    """Heights, an exact pressure and wrong ones as files; the command line is one process."""
    if comm.size > 1:
        pytest.skip("one process")
    heights, exact = solved({}, 5)
    pressure = (exact.x * exact.pressure).astype(float).reshape(heights.shape)
    np.save(tmp_path / "heights.npy", heights)
    np.savetxt(tmp_path / "pressure.txt", pressure)
    np.save(tmp_path / "small.npy", pressure[1:])
    np.save(tmp_path / "nan.npy", np.where(pressure > 0, pressure, np.nan))
    np.save(tmp_path / "tension.npy", -pressure)
    np.save(tmp_path / "scaled.npy", 1e3 * pressure)
    (tmp_path / "job.toml").write_text(
        'grid.n = [8, 6]\nsurface = {kind = "file", path = "heights.npy"}\nload.pressure = 0.4\n'
        'solid.contact_modulus = 1.0\noutput.fields = ["pressure"]'
    )
    return tmp_path


MODULUS = ["--set", "solid.contact_modulus=1.0"]


def test_the_command_line_certifies(files, capsys):
    """One line, or JSON, for heights in a file, in a job and in a result folder; exit code 0."""
    pgfmd.run(files / "job.toml", files / "results")
    capsys.readouterr()
    for heights, options in (("heights.npy", MODULUS), ("job.toml", []), ("results", [])):
        for pressure in ("pressure.txt", "results", "results:0"):
            words = ["certify", str(files / heights), str(files / pressure), *options]
            assert cli.main(words) == 0
            assert capsys.readouterr().out.count("\n") == 1
            assert cli.main([*words, "--json"]) == 0
            found = json.loads(capsys.readouterr().out)
            assert found["certified_error"] <= 1e-8 and math.isclose(found["mean_pressure"], MEAN)


@pytest.mark.parametrize(("pressure", "words"), [
    ("small.npy", "small.npy: holds 7 x 6 pressures, the heights are 8 x 6"), ("nan.npy", "not finite"),
    ("tension.npy", "mean is -"),
    ("scaled.npy", "1e+03 times these"), ("none.npy", "no such file"), ("results:3", "no such file"),
])  # fmt: skip
def test_wrong_files_are_refused_in_one_line(files, capsys, pressure, words):
    """Exit code 2, and one line on stderr."""
    assert cli.main(["certify", str(files / "heights.npy"), str(files / pressure), *MODULUS]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1 and words in captured.err


@pytest.mark.parametrize("key", [{"boundary": "open"}, {"refine": 2}])
def test_results_are_certified_on_their_own_grid(tmp_path, capsys, key):
    """With open boundaries and on a refined grid: the bound is near that of the run, and below its tolerance."""
    job = {"grid": {"n": 24} | key, "surface": {"kind": "paraboloid", "radius": 100.0}, "load": {"pressure": 1e-3},
           "solid": {"contact_modulus": 1.0}, "output": {"fields": ["pressure"]}}  # fmt: skip
    solved = pgfmd.run(job, tmp_path, comm=MPI.COMM_SELF)[0].numbers["certified_error"]
    assert cli.main(["certify", str(tmp_path), str(tmp_path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["certified_error"] < max(4 * solved, 1e-12) < 4e-8


def test_an_error_that_is_not_known_is_left_out():
    """"0.8 ± nan" is no statement."""
    assert with_error(0.8, math.nan) == "0.80000" and with_error(0.8, 1e-3) == "0.80000 ± 0.00100"
    assert with_error(0.8, 2.3e-6) == "0.80000 ± 2e-06" and with_error(0.0, 0.0) == "0.00000 ± 0.00000"
