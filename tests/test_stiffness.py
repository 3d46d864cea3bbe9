"""Stiffness of a contact that stays as it is: bounds against dense algebra, exact solutions, secants; conductance."""

import itertools
import math

import numpy as np
import pytest
import reference
from contacts import elastic, under_hard_wall
from job_texts import rough_job

import pgfmd
from pgfmd.application import job
from pgfmd.application.results import Results
from pgfmd.application.simulate import simulate
from pgfmd.errors import InputError
from pgfmd.grid.domain import OPEN, PERIODIC
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables.rough_surface import RoughSurface
from pgfmd.observables.stiffness import Stiffness
from pgfmd.physics.laws.exponential_law import ExponentialWall
from pgfmd.physics.laws.formula import FormulaWall
from pgfmd.physics.laws.hard import Hardness, HardWall
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.fixed_contact import increment


def stiffness_of(comm, pressure, law=None, width=1e-3, domain=PERIODIC):
    """The increment of a whole pressure (nx, ny), cut into slabs."""
    grid = SlabGrid(comm, pressure.shape, domain=domain)
    flat = np.zeros(grid.local_shape)
    problem = ContactProblem(grid, flat, elastic(1.0), law or HardWall(), pressure.mean())
    found = increment(problem, pressure[grid.rows].copy(), width)
    grid.free()
    return found


def dense(pressure, law, domain):
    """K by dense algebra; E' = 1."""
    size, spacing = np.zeros(pressure.shape), (1.0, 1.0)
    contact = reference.Contact(size) if domain is PERIODIC else reference.OpenContact(
        size, spacing, reference.Solid(), OPEN.torus(pressure.shape, spacing))  # fmt: skip
    (compliance, _), p = contact.matrices, pressure.ravel()
    if isinstance(law, ExponentialWall):  # (G + ζ/p)x = 1, symmetric in x/√p
        root = np.sqrt(p)
        return root @ np.linalg.solve(law.zeta * np.eye(len(p)) + root[:, None] * compliance * root, root) / len(p)
    inside = np.flatnonzero((p > 0) & (p < law.highest))
    matrix = np.ones((len(inside) + 1, len(inside) + 1))
    matrix[:-1, :-1], matrix[-1, -1] = compliance[np.ix_(inside, inside)], 0
    return -1 / np.linalg.solve(matrix, np.r_[np.zeros(len(inside)), len(p)])[-1]


@pytest.mark.mpi
@pytest.mark.parametrize("law", [HardWall(), Hardness(hardness=2.0), ExponentialWall(zeta=0.05)], ids=lambda x: x.kind)
@pytest.mark.parametrize("domain", [PERIODIC, OPEN], ids=lambda x: x.name)
def test_bounds_enclose_dense_algebra(comm, law, domain):
    """The bounds enclose K of dense algebra, and are as near as asked; 1e-11: rounding of the dense solution."""
    rng = np.random.default_rng(8)
    for _ in range(6):
        pressure = rng.exponential(size=rng.integers(4, 15, 2)) ** 2
        if law.releases:
            pressure[rng.random(pressure.shape) < rng.uniform(0.1, 0.9)] = 0
            pressure[rng.random(pressure.shape) < 0.1] = min(law.highest, 2.0)
            np.minimum(pressure, law.highest, out=pressure)
        exact = dense(pressure, law, domain)
        for width in (1e-2, 1e-6):
            found = stiffness_of(comm, pressure, law, width, domain)
            assert found.lower * (1 - 1e-11) <= exact <= found.upper * (1 + 1e-11)
            assert found.upper <= found.lower * (1 + 1.01 * width)


@pytest.mark.mpi
def test_bounds_of_an_unfinished_solution(comm, monkeypatch):
    """Under an exponential wall the bounds enclose K after any number of iterations, though they are far apart."""
    law, pressure = ExponentialWall(zeta=1e-4), np.random.default_rng(2).exponential(size=(12, 9))
    exact = dense(pressure, law, PERIODIC)
    for most in (1, 2, 5, 20):
        monkeypatch.setattr("pgfmd.solvers.fixed_contact.MOST_ITERATIONS", most)
        found = stiffness_of(comm, pressure, law, 1e-9)
        assert found.lower <= exact <= found.upper


@pytest.mark.parametrize("radius", [8.0, 20.0])
def test_round_contact(comm, radius):
    """A round contact of radius a in a cell L has 1/(K L²) = 1/2a − 3.900265/(πL) + .9585 a²/L³ (E' = 1): the flat
    punch, its square lattice of images, and their effect on it; on an open patch the first term only.  Pixels: a =
    √(N/π) − .129, ± .006 at 8."""
    x = np.arange(128) - 64.31
    mask = 1.0 * (x[:, None] ** 2 + (x + 0.44) ** 2 < radius**2)
    found, a, length = stiffness_of(comm, mask), math.sqrt(mask.sum() / math.pi) - 0.129, 128
    expected = 1 / (2 * a) - 3.900265 / (math.pi * length) + 0.9585 * a**2 / length**3
    slack = 0.006 * 8 / radius / (2 * a**2)
    assert 1 / (found.upper * length**2) <= expected + slack and expected - slack <= 1 / (found.lower * length**2)
    found, expected = stiffness_of(comm, mask, domain=OPEN), 1 / (2 * a)
    assert 1 / (found.upper * length**2) <= expected + slack and expected - slack <= 1 / (found.lower * length**2)


@pytest.mark.mpi
@pytest.mark.parametrize("width", [9, 40])
def test_strip(comm, width):
    """A strip of width w: 1/K = (2L/π) ln(1/sin(πw/2L)), w = pixels − .379 (±.01)."""
    length = 96
    pressure = np.zeros((length, 4))
    pressure[10 : 10 + width] = 1
    found, (wide, narrow) = stiffness_of(comm, pressure), (width - 0.379 + 0.01, width - 0.379 - 0.01)
    least, most = (2 * length / math.pi * math.log(1 / math.sin(math.pi * w / 2 / length)) for w in (wide, narrow))
    assert 1 / found.upper <= most and least <= 1 / found.lower


def test_secants_lie_between():
    """Between two loads the mean gap falls along K(p̄): the secant lies between K of the first and of the last."""
    rng = np.random.default_rng(3)
    q = np.hypot(np.fft.fftfreq(64, 1 / 64)[:, None], np.fft.rfftfreq(64, 1 / 64))
    waves = np.where((q > 1) & (q < 10), np.maximum(q, 1) ** -1.8, 0) * np.exp(2j * np.pi * rng.random(q.shape))
    heights = np.fft.irfft2(waves, s=(64, 64))
    heights /= np.std(np.diff(heights, axis=0))
    contacts = list(pgfmd.solve(heights, [0.02, 0.022, 0.05, 0.1], tolerance=1e-12))
    bounds = [increment(each.problem, each.pressure, 1e-4) for each in contacts]
    for (one, low), (two, high) in itertools.pairwise(zip(contacts, bounds, strict=True)):
        secant = (two.mean_pressure - one.mean_pressure) / (one.mean_gap - two.mean_gap)
        assert low.lower <= secant * (1 + 1e-5) and secant * (1 - 1e-5) <= high.upper


def test_without_and_with_full_contact(comm):
    """No contact: K = 0.  Contact everywhere: K is infinite, as the mean mode deforms nothing; of an open patch it is
    that of a square punch, 1.1523 E' times its side n − .378."""
    assert stiffness_of(comm, np.zeros((8, 8))).upper == 0
    assert stiffness_of(comm, np.ones((8, 8))).lower == math.inf
    punch = stiffness_of(comm, np.ones((128, 128)), domain=OPEN)
    assert punch.lower * 128**2 == pytest.approx(1.1523 * (128 - 0.378), rel=1e-3)


def test_conductance_of_a_spot():
    """One small spot between half-spaces of resistivities ρ₁, ρ₂ conducts 4a/(ρ₁ + ρ₂) (Holm); images are taken off,
    pixels' scatter at a = 6: 1 %.  The current density has mean 1 and no part outside."""
    x = np.arange(96) - 48.2
    contact = pgfmd.solve(-(x[:, None] ** 2 + x**2) / 400, 4e-4)
    found = contact.observables(stiffness={"conductivities": [2.0, 5.0]})["loads"]
    a = math.sqrt(contact.contact_area_corrected / math.pi) * 96
    alone = 4 * a / (1 / 2.0 + 1 / 5.0)
    image = 3.900265 / (math.pi * 96) * (1 / 2.0 + 1 / 5.0) / 2
    assert 1 / (1 / (found["conductance"] * 96**2) + image) == pytest.approx(alone, rel=0.01)
    current = increment(contact.problem, contact.pressure, 1e-3).pressure
    assert current.mean() == pytest.approx(1, rel=1e-12) and not current[contact.pressure == 0].any()


@pytest.mark.mpi
def test_in_a_run(comm, shared_tmp_path):
    """A run writes the columns and, if it is asked for, the current density; with a slab the bulk is in series."""
    output = {"observables": ["stiffness"], "fields": ["current_density"], "stiffness": {"half_grid": True}}
    solid = {"contact_modulus": 1.0, "poisson": 0.2, "thickness": 20.0}
    text = rough_job(64, {"lambda_s": 16.0}, solid=solid, load={"pressure": [0.02]}, output=output)
    simulate(job.parse(text), comm, shared_tmp_path / "out")
    results = Results(shared_tmp_path / "out")
    numbers, bounds = results[0].numbers, results[0]["stiffness"]
    value, bulk = numbers["stiffness"], job.parse(text).solid.mean_stiffness()
    assert bounds["lower"] <= value <= bounds["upper"] <= 1.001 * bounds["lower"]
    assert 0 < numbers["stiffness_error"] < value
    assert numbers["stiffness_with_bulk"] == pytest.approx(1 / (1 / value + 1 / bulk), rel=1e-12)
    assert results.field("current_density", 0).mean() == pytest.approx(1, rel=1e-6)


def test_refused(comm):
    """A conductance of a slab, a wall without a stiffness, and a field without its observable are refused by name."""
    grid = SlabGrid(comm, (8, 8))
    slab = under_hard_wall(grid, np.zeros(grid.local_shape), solid=elastic(1.0, 3.0))
    with pytest.raises(InputError, match="half-spaces"):
        RoughSurface(slab, [Stiffness(conductivities=(1.0, 1.0))])
    with pytest.raises(InputError, match='half_grid needs boundary = "periodic"'):
        Stiffness(half_grid=True).check_in(OPEN)
    with pytest.raises(InputError, match='observable "stiffness"'):
        job.parse(rough_job(8, load={"pressure": [0.1]}, output={"fields": ["current_density"]}))
    with pytest.raises(InputError, match="hard, hardness and exponential"):
        Stiffness().check_contact(slab.solid, FormulaWall(pressure="exp(-gap)", gaps=(0.0, 9.0)))
