"""Surfaces end to end: cells and pixels of any aspect, roll-off, a measured surface in SI units."""

import math

import numpy as np
import pytest
from conftest import ROOT, once, whole
from contacts import elastic, under_hard_wall
from job_texts import SOLID
from mpi4py import MPI

import pgfmd
from pgfmd.application import job
from pgfmd.application.results import Results
from pgfmd.application.simulate import simulate
from pgfmd.errors import InputError
from pgfmd.grid.cell import Cell
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.physics.laws.exponential_law import ExponentialWall
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.active_set.contact_from_coarse import solve_hard_wall
from pgfmd.solvers.exponential_wall.newton_from_coarse import solve_exponential_wall
from pgfmd.surfaces.file import read_heights
from pgfmd.surfaces.rigid_surface import Sum, coordinates
from pgfmd.surfaces.self_affine import SelfAffine, self_affine
from pgfmd.theory import exact

pytestmark = [pytest.mark.mpi, pytest.mark.uneven]

MODULUS = 8 / 3
STRETCHED = ((48, 80), (1.0, 3.1))  # points, cell: pixels 0.021 × 0.039
JOB = ROOT / "jobs" / "measured.toml"


def frequencies(shape, lengths):
    """|q| (nx, ny) in NumPy's order, from the cell alone."""
    qx, qy = (2 * np.pi * np.fft.fftfreq(count, length / count) for count, length in zip(shape, lengths, strict=True))
    return np.hypot(qx[:, None], qy)


def gap_of(pressure, heights, lengths):
    """u − h up to a constant for a whole field of pressures: ũ = 2 p̃/(E' q), by NumPy alone."""
    q = frequencies(heights.shape, lengths)
    q[0, 0] = np.inf
    displacement = np.fft.ifft2(2 / (MODULUS * q) * np.fft.fft2(pressure)).real
    return displacement - (heights - heights.mean()), displacement


def test_waves_along_both_axes_of_stretched_pixels(comm):
    """Westergaard's wave along x with pixels 5 times as long in y, and along y: one and the same pressure, the exact
    one.  L2 error ≤ 2e-3 at n = 256, of first order as in the test of the hard wall (5e-4 at 1024); certificates of
    1e-13 leave √(2e-13) between the two, 1e-6."""
    n, other, found = 256, 6, []
    theory = exact.Westergaard(1.0, 1.0, MODULUS)
    mean = 0.5 * theory.full_pressure
    for axis in (0, 1):
        shape, lengths = (n, other), (1.0, 5 * other / n)
        grid = SlabGrid(comm, shape[::-1] if axis else shape, lengths[::-1] if axis else lengths)
        x = (coordinates(grid)[axis] + np.zeros(grid.local_shape) + 0.5 / n + 0.5) % 1.0 - 0.5
        solution = solve_hard_wall(under_hard_wall(grid, np.cos(2 * np.pi * x), mean, elastic(MODULUS)), 1e-13)
        expected, pressure = whole(grid, theory.pressure(x, mean)), whole(grid, solution.pressure)
        assert np.linalg.norm(pressure - expected) <= 2e-3 * np.linalg.norm(expected)
        assert abs(solution.mean_gap - theory.mean_gap(mean)) <= 16e-6  # second order: 1e-6 at 1024
        found.append(pressure.T if axis else pressure)
    assert np.linalg.norm(found[0] - found[1]) <= 1e-6 * np.linalg.norm(found[0])


@pytest.fixture
def stretched(comm):
    grid = SlabGrid(comm, *STRETCHED)
    return grid, self_affine(grid, 0.8, 0.2, 0.031, 11)


def test_contact_conditions_on_stretched_pixels(stretched):
    """p ≥ 0, ⟨p⟩ = p̄, and by transforms written here again ⟨p, g − min g⟩ ≤ 3 √tol · 2 E_el: contact and gap exclude
    each other, to the first order of what the certificate bounds in second.  3: the certificate weighs errors of the
    gap by the stiffness, this sum by the pressure, and it takes the lowest gap for the level; 1.02 was measured."""
    grid, heights = stretched
    tolerance, mean = 1e-20, 0.01
    found = solve_hard_wall(under_hard_wall(grid, heights, mean, elastic(MODULUS)), tolerance)
    pressure, heights = whole(grid, found.pressure), whole(grid, heights)
    gap, displacement = gap_of(pressure, heights, grid.lengths)
    energy = np.mean(pressure * displacement) / 2
    assert pressure.min() >= 0 and pressure.mean() == pytest.approx(mean, rel=1e-12, abs=0)
    assert np.mean(pressure * (gap - gap.min())) <= 3 * np.sqrt(tolerance) * 2 * energy
    assert 0.05 < np.mean(pressure > 0) < 0.5
    assert energy == pytest.approx(found.elastic_energy, rel=1e-9, abs=0)
    assert np.allclose(whole(grid, found.gap), gap - gap.mean() + found.mean_gap, rtol=0, atol=1e-10 * np.ptp(heights))


def test_exponential_wall_on_stretched_pixels(stretched):
    """σ = σ_ref exp(−g/ζ) at every point, with the gap from transforms written here again; D = 1e-14 · 2 E_el leaves
    relative pressures of about √(1e-14 · 2 E_el/(ζ p̄))."""
    grid, heights = stretched
    mean, zeta = 0.01, 0.2 * math.sqrt(grid.reduction.dot(heights, heights) / grid.size)
    found = solve_exponential_wall(
        ContactProblem(grid, heights, elastic(MODULUS), ExponentialWall(zeta=zeta, sigma_ref=2.0), mean),
        tolerance=1e-14,
    )
    pressure, heights = whole(grid, found.pressure), whole(grid, heights)
    gap, _ = gap_of(pressure, heights, grid.lengths)
    wall = 2.0 * np.exp(-(gap - gap.mean() + found.mean_gap) / zeta)
    allowed = 3 * math.sqrt(1e-14 * max(1, 2 * found.elastic_energy / (zeta * mean)))
    assert np.linalg.norm(wall - pressure) <= allowed * np.linalg.norm(pressure)


@pytest.mark.parametrize("surface", [
    "kind = 'self-affine'\nhurst = 0.6\nlambda_s = 4\nrms_slope = 0.1",
    "kind = 'sinusoid'\namplitude = 1.0",
    "kind = 'paraboloid'\nradius = 30.0",
    f"kind = 'file'\npath = '{ROOT}/jobs/data/measured.npy'\ndetrend = 'plane'",
])  # fmt: skip
def test_surface_of_a_job_in_a_script(comm, shared_tmp_path, surface):
    """`pgfmd.surface` gives rows of the heights that the job writes, by either transform; to 1e-14 of their range."""
    text = f"[grid]\nn = [128, 96]\n[surface]\n{surface}\n[load]\npressure = 1e-4\n[output]\nfields = ['height']\n"
    text += SOLID + "[solver]\ntolerance = 0.1\n"
    once(comm, (shared_tmp_path / "job.toml").write_text, text)
    simulate(job.parse(text), comm, shared_tmp_path / "out")
    expected = Results(shared_tmp_path / "out").field("height")
    rows = SlabGrid(comm, (128, 96)).rows
    atol = 1e-14 * np.ptp(expected)
    assert np.allclose(pgfmd.surface(shared_tmp_path / "job.toml", comm), expected[rows], rtol=0, atol=atol)
    other = job.parse(text, overrides=["solver.transform=mpi4py-fft"])
    assert np.allclose(pgfmd.surface(other), expected, rtol=0, atol=atol)


def run_measured(comm, folder, *overrides):
    simulate(job.load(JOB, overrides), comm, folder)
    comm.Barrier()
    return Results(folder)


def test_measured_job(comm, shared_tmp_path):
    """jobs/measured.toml runs as it stands, in metres and pascals, and any number of ranks gives what one process
    gives: two pressures that are certified to tol differ by no more than 2 √(2 tol) in energy norm."""
    found = run_measured(comm, shared_tmp_path / "ranks")
    assert found.status == "complete" and (found.loads["certified_error"] <= 1e-8).all()
    assert np.allclose(found.loads["mean_pressure"], [1e6, 5e6], rtol=1e-12, atol=0)
    assert found.units["mean_gap"] == "m" and found.units["mean_pressure"] == "Pa"
    heights = found.field("height")
    assert heights.shape == (256, 192) and np.array_equal(heights, heights[::-1, ::-1])
    if comm.size == 1:
        return
    once(comm, run_measured, MPI.COMM_SELF, shared_tmp_path / "alone")
    alone = Results(shared_tmp_path / "alone")
    for load in (0, 1):
        change = found.field("pressure", load=load) - alone.field("pressure", load=load)
        q = frequencies(change.shape, (25.6e-6, 23.04e-6))
        q[0, 0] = np.inf
        norms = [np.sum(np.abs(np.fft.fft2(p)) ** 2 / q) for p in (change, alone.field("pressure", load=load))]
        assert math.sqrt(norms[0] / norms[1]) <= 2 * math.sqrt(2e-8)


def test_units_do_not_matter(comm, shared_tmp_path):
    """The job in metres and pascals, and in spacings and moduli: fields to 1e-8 of the largest, certified to 1e-18."""
    common = ("solver.tolerance=1e-18", "load.pressure=[5e6]", "output.observables=[]")
    physical = run_measured(comm, shared_tmp_path / "si", *common)
    bare = run_measured(
        comm, shared_tmp_path / "bare", *common, "grid.length=[256, 230.4]", "surface.height_scale=1e7",
        "solid.young=1", "load.pressure=[5e-3]", "output.length_unit=spacing", "output.pressure_unit=E",
    )  # fmt: skip
    for name, unit in (("pressure", 1e9), ("gap", 1e-7)):
        expected = unit * bare.field(name, load=0)
        assert np.abs(physical.field(name, load=0) - expected).max() <= 1e-8 * np.abs(expected).max(), name
    assert physical.loads["contact_area"][0] == bare.loads["contact_area"][0]
    energy = bare.loads["elastic_energy"][0] * 1e9 * 1e-7
    assert physical.loads["elastic_energy"][0] == pytest.approx(energy, rel=1e-8, abs=0)


def test_two_bodies_are_their_summed_heights(comm):
    """`second` adds the heights of another body, whose peaks point to the first, on any ranks and when refined."""
    rough = {"kind": "self-affine", "hurst": 0.7, "lambda_s": 4.0, "rms_slope": 0.1, "seed": 4}
    ball = {"kind": "paraboloid", "radius": 90.0}
    for grid in ({"n": [24, 20]}, {"n": [24, 20], "refine": 2}):
        parts = [pgfmd.surface({"grid": grid, "surface": body}, comm) for body in (rough, ball)]
        both = pgfmd.surface({"grid": grid, "surface": rough | {"second": ball}}, comm)
        assert np.abs(both - sum(parts)).max() < 1e-12
        assert np.abs(parts[1]).max() > 1e-3


def test_the_file_of_a_second_body_belongs_to_the_job(tmp_path):
    """Its path is relative to the job's folder, its file is an input of the run, and the effective job keeps it."""
    heights = np.random.default_rng(5).random((8, 8))
    np.save(tmp_path / "other.npy", heights)
    text = """[grid]
n = 8
[surface]
kind = "paraboloid"
radius = 50.0
[surface.second]
kind = "file"
path = "other.npy"
[solid]
contact_modulus = 1.0
[load]
pressure = 0.01
"""
    (tmp_path / "job.toml").write_text(text)
    found = job.load(str(tmp_path / "job.toml"))
    assert found.sources["surface.second.path"] == (str(tmp_path / "other.npy"), None)
    again = job.parse(job.as_toml(found), "again")
    assert again == found
    _, other = again.surface.bodies
    assert np.array_equal(other.heights(SlabGrid(MPI.COMM_SELF, (8, 8)), None), heights)


@pytest.mark.parametrize(("second", "message"), [
    ("ball", "surface.second = .ball.: must be a table"),
    ({"kind": "paraboloid"}, "surface.second: surface.radius is missing"),
    ({"kind": "paraboloid", "radius": 1.0, "second": {"kind": "cone", "slope": 1.0}}, "no second of its own"),
    ({"kind": "self-affine", "hurst": 0.8, "lambda_s": 4.0, "rms_slope": 0.1, "seed": [1, 2]}, "one seed"),
])  # fmt: skip
def test_a_wrong_second_body_is_named(second, message):
    """No table, a key that is missing, a third body, an ensemble: one line says which."""
    with pytest.raises(InputError, match=message):
        pgfmd.surface({"grid": {"n": 8}, "surface": {"kind": "cone", "slope": 0.1, "second": second}})


@pytest.mark.parametrize("lambda_s", [5e-324, 1e-300, 1e-160])
def test_a_wavelength_lost_in_rounding_is_no_cut_off(comm, lambda_s):
    """λ_s times a small spacing underflows: the surface is that of λ_s = 1 pixel, with modes up to the corners."""
    grid = SlabGrid(comm, (8, 8), (5e-10, 5e-10))
    made = [SelfAffine(hurst=0.8, lambda_s=value, rms_slope=0.1, seed=1).heights(grid) for value in (lambda_s, 1.0)]
    np.testing.assert_array_equal(*made)


def test_heights_of_a_text_travel_in_rows(comm, shared_tmp_path, monkeypatch):
    """From 46341² on, points are more than the 2³¹ that MPI counts to: messages are counted in rows."""
    grid, heights, sent = SlabGrid(comm, (6, 5)), np.random.default_rng(1).standard_normal((6, 5)), []

    class Watched:
        def __getattr__(self, name):
            return getattr(comm, name)

        def Scatterv(self, message, mine):
            sent.extend([message, mine])
            comm.Scatterv(message, mine)

    if comm.rank == 0:
        np.savetxt(shared_tmp_path / "heights.txt", heights)
    monkeypatch.setattr(grid, "comm", Watched())
    found, _ = read_heights(grid, (str(shared_tmp_path / "heights.txt"), None), False, 1, None)
    np.testing.assert_allclose(found, heights[grid.rows], rtol=1e-15)
    assert sent[1][1] == len(found) and (comm.rank or list(sent[0][1]) == list(np.diff(grid.starts)))


@pytest.mark.parametrize(("shape", "lengths"), [
    ((96, 96), {}), ((96, 96), {"lambda_r": 24.0}), ((96, 96), {"lambda_l": 24.0}), ((192, 24), {}),
    ((64, 64), {"lambda_s": 48.0}),
])  # fmt: skip
def test_the_height_known_beforehand_is_that_of_the_surfaces(shape, lengths):
    """Its square is within a tenth the mean square height of 200 surfaces; that of two bodies is the sum of squares."""
    options = {"hurst": 0.8, "lambda_s": 4.0, "rms_slope": 0.1} | lengths
    surface, cell, grid = SelfAffine(**options), Cell(n=shape), SlabGrid(MPI.COMM_SELF, shape)
    known = surface.known_height(cell)
    squares = [np.mean(SelfAffine(**options, seed=seed).heights(grid) ** 2) for seed in range(200)]
    assert known**2 == pytest.approx(np.mean(squares), rel=0.1)
    assert Sum(surface, surface).known_height(cell) == pytest.approx(math.sqrt(2) * known)
