"""The exponential wall: field theory, limits, exact relations, and its certificate."""

import math

import numpy as np
import pytest
from conftest import SIZE
from contacts import elastic, rough_on, under_hard_wall
from mpi4py import MPI
from reference import Contact, Solid

from pgfmd.errors import InputError, SolverError, Uncertifiable
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.physics.laws.exponential_law import ExponentialWall, exponential, logarithm, wright_omega
from pgfmd.physics.laws.formula import FormulaWall
from pgfmd.physics.laws.law import Units
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.active_set.contact_from_coarse import solve_hard_wall
from pgfmd.solvers.dispatch import solve_contact
from pgfmd.solvers.exponential_wall import newton_from_coarse
from pgfmd.solvers.exponential_wall.newton_from_coarse import solve_exponential_wall
from pgfmd.solvers.gfmd import solve_gfmd
from pgfmd.solvers.options import Solver
from pgfmd.surfaces.self_affine import self_affine
from pgfmd.surfaces.sinusoid import sinusoid
from pgfmd.theory.exponential import response

pytestmark = pytest.mark.mpi

SOLID = elastic(8 / 3)


def solve(grid, heights, load, zeta, sigma_ref=None, **keywords):
    """The contact of those heights at that mean pressure.  Collective."""
    law = ExponentialWall(zeta=zeta, sigma_ref=sigma_ref)
    return solve_exponential_wall(ContactProblem(grid, heights, SOLID, law, load), **keywords)


def norm(grid, field) -> float:
    return math.sqrt(grid.reduction.dot(field, field))


@pytest.fixture(scope="module")
def rough(comm):
    grid = SlabGrid(comm, (128, 128))
    return grid, self_affine(grid, 0.8, 8.0, 0.031, 3)


@pytest.mark.parametrize("scale", [1e-2, 1e-3])
def test_the_response_to_a_small_wave_is_that_of_field_theory(comm, scale):
    """σ̃ = G₁ (E'q/2) h̃ up to terms quadratic in amplitude/ζ: 1.2e-5 at 1e-2, with that wave (solved independently)."""
    grid, zeta, load = SlabGrid(comm, (64, 64)), 0.5, 0.02
    heights = sinusoid(grid, scale * zeta, (3, 0))
    found = solve(grid, heights, load, zeta, tolerance=1e-14)
    q = 2 * np.pi * 3 / 64
    expected = load + response(q, load, zeta, contact_modulus=8 / 3) * 8 / 3 * q / 2 * heights
    wave = grid.reduction.dot(found.pressure, heights) / grid.reduction.dot(expected - load, heights)
    # The second harmonic does not enter the projection; what remains is of second order relative to the amplitude.
    assert abs(wave - 1) < 0.2 * scale**2
    # The whole field holds the second harmonic, of relative size scale.
    assert norm(grid, found.pressure - expected) < scale * norm(grid, expected - load)


@pytest.mark.parametrize("zeta", [1e-3, 0.05, 1.0, 10.0, 100.0])
def test_the_wall_answers_its_gap_and_carries_the_load(rough, zeta):
    """σ = σ_ref exp(−gap/ζ) at every point, ⟨σ⟩ = p̄, and the gap's mean is the mean gap."""
    grid, heights = rough
    zeta *= math.sqrt(grid.reduction.dot(heights, heights) / grid.size)
    found = solve(grid, heights, 0.01, zeta, 2.0, tolerance=1e-14)
    wall = 2.0 * np.exp(-found.gap / zeta)
    # D ~ ½ζ⟨p ln²(p/σ)⟩/⟨pu⟩ = 1e-14 leaves relative pressures of about √(1e-14 ⟨pu⟩/(ζ p̄)).
    allowed = 3 * math.sqrt(1e-14 * max(1, 2 * found.elastic_energy / (zeta * 0.01)))
    assert norm(grid, wall - found.pressure) <= allowed * norm(grid, found.pressure)
    assert grid.reduction.sum(found.pressure) / grid.size == pytest.approx(0.01, rel=1e-12, abs=0)
    assert grid.reduction.sum(found.gap) / grid.size == pytest.approx(found.mean_gap, rel=1e-10, abs=0)


def test_the_displacement_belongs_to_the_pressure(rough):
    """K(gap + h) = p for all modes but the mean, by the transforms of the grid: E'q/2 written here again."""
    grid, heights = rough
    found = solve(grid, heights, 0.01, 0.1, tolerance=1e-10)
    stress = grid.backward(4 / 3 * np.sqrt(grid.q_squared()) * grid.forward(found.gap + heights))
    assert norm(grid, stress - (found.pressure - 0.01)) < 1e-12 * norm(grid, stress)  # rounding only


def test_thin_walls_tend_to_the_hard_one(rough):
    """As ζ → 0 pressures tend to those of the hard wall, nearer each time, and so does the contact area from above: a
    soft wall adds a rim, whose width falls with ζ; within the 1 % of points that bear little there."""
    grid, heights = rough
    hard = solve_hard_wall(under_hard_wall(grid, heights, 0.01, SOLID), 1e-12)
    soft = [solve(grid, heights, 0.01, zeta, tolerance=1e-9) for zeta in (1e-2, 4e-3, 3e-3, 2e-3, 1e-3, 1e-4)]
    apart = [norm(grid, found.pressure - hard.pressure) for found in soft]
    assert apart == sorted(apart, reverse=True)
    assert apart[-1] < 0.02 * norm(grid, hard.pressure)
    area, *areas = (grid.reduction.sum(found.pressure_in_contact() > 0) / grid.size for found in (hard, *soft))
    assert areas == sorted(areas, reverse=True)
    assert abs(areas[-1] / area - 1) <= 0.01


@pytest.mark.parametrize("method", [solve_exponential_wall, solve_gfmd])
@pytest.mark.parametrize("zeta", [2e-3, 0.05, 0.5])
def test_the_certificate_is_of_second_order(rough, method, zeta):
    """J(p) − J(p*) ≤ bound ≤ 6 (J(p) − J(p*)) at every look, with p* solved to 1e-14.  J(p) − J(p*) = ½‖p − p*‖²_G +
    ζ⟨p ln(p/p*)⟩.  In 330 states of 84 contacts the ratio was 1.0 to 3.8; 6 for others."""
    grid, heights = rough
    problem = ContactProblem(grid, heights, SOLID, ExponentialWall(zeta=zeta), 0.01)
    exact = solve_exponential_wall(problem, 1e-14)
    least = grid.reduction.min(exact.pressure)
    assert least > 0  # so that the logarithm is finite
    seen = []

    def watch(level, state):
        if level is not grid:
            return
        pressure = state.pressure * 0.01
        apart = pressure - exact.pressure
        displacement = grid.backward(SOLID.compliance(np.sqrt(grid.q_squared())) * grid.forward(apart))
        ratio = np.maximum(pressure, 1e-300) / exact.pressure
        entropy = exact.pressure * (ratio * np.log(ratio) - ratio + 1)
        lost = (grid.reduction.dot(apart, displacement) / 2 + zeta * grid.reduction.sum(entropy)) / grid.size
        seen.append((state.error, lost / (2 * exact.elastic_energy)))

    method(problem, 1e-8, monitor=watch)
    seen = [(bound, error) for bound, error in seen if 1e-10 < error < 0.1]
    assert seen and all(error <= bound * (1 + 1e-3) and bound <= 6 * error for bound, error in seen), seen


def test_energy_and_gap_belong_together(rough):
    """dE_el/dp̄ = −p̄ dḡ/dp̄ − dE_wall/dp̄ with E_wall = ζ p̄: the load's work is stored in solid and wall."""
    grid, heights = rough
    zeta, load, step = 0.05, 0.01, 1e-3
    solutions = [solve(grid, heights, load * f, zeta, 1.0, tolerance=1e-15) for f in (1 - step, 1 + step)]
    low, high = solutions
    change = high.elastic_energy - low.elastic_energy
    work = -load * (high.mean_gap - low.mean_gap)
    # ⟨∫σ dg⟩ = ζ⟨σ⟩; central differences leave a relative error of step².
    assert change + 2 * step * load * zeta == pytest.approx(work, rel=10 * step**2, abs=0)


def test_sigma_ref_shifts_the_gap_alone(rough):
    """A factor on σ_ref changes the gap by ζ ln(factor) and the pressure not at all."""
    grid, heights = rough
    one, two = (solve(grid, heights, 0.01, 0.1, ref, tolerance=1e-8) for ref in (1.0, 7.0))
    assert np.array_equal(one.pressure, two.pressure)
    assert two.mean_gap - one.mean_gap == pytest.approx(0.1 * math.log(7), rel=1e-12, abs=0)


def test_a_neighbouring_load_is_as_good_a_start_as_coarse_grids(rough):
    """Up and down a sequence of loads the pressures agree with cold starts to 1e-8."""
    grid, heights = rough
    before = None
    for load in (0.002, 0.01, 0.03, 0.01, 0.002):
        cold = solve(grid, heights, load, 0.1, tolerance=1e-18)
        warm = solve(grid, heights, load, 0.1, tolerance=1e-18, start=before)
        assert norm(grid, warm.pressure - cold.pressure) < 1e-8 * norm(grid, cold.pressure)
        before = warm.pressure


def test_a_flat_surface_is_pressed_evenly(comm):
    """Without roughness p = p̄ and the gap is ζ ln(σ_ref/p̄)."""
    grid = SlabGrid(comm, (16, 16))
    found = solve(grid, np.full(grid.local_shape, 5.0), 0.1, 0.3, 1.0)
    assert np.all(found.pressure == 0.1)
    assert found.gap == pytest.approx(-0.3 * math.log(0.1))


@pytest.mark.parametrize(("load", "zeta"), [(0.0, 1.0), (1.0, 0.0), (math.nan, 1.0), (1.0, math.inf)])
def test_a_wall_that_cannot_be_is_refused(rough, load, zeta):
    """No load, no ζ, or ones that are not finite are wrong input."""
    with pytest.raises(InputError, match="positive|> 0"):
        solve(*rough, load, zeta)


def test_an_accuracy_beyond_rounding_is_an_error(rough):
    """What cannot be certified is not returned."""
    with pytest.raises(SolverError, match="cannot be certified: rounding"):
        solve(*rough, 0.03, 1e-3, tolerance=1e-30)


def test_few_transforms_are_enough(comm):
    """The paper's figure 8, smaller (512², same λ_l/λ_s): at most 60 transform pairs to 1e-6 in the pressure."""
    grid, heights = rough_on(comm, (512, 512), 0.3, 16.0, 0.031, 1)
    for zeta in (0.25, 1.0):
        exact = solve(grid, heights, 0.004, zeta, tolerance=1e-15)
        found = solve(grid, heights, 0.004, zeta, tolerance=1e-12)
        assert found.transforms <= 60
        assert norm(grid, found.pressure - exact.pressure) <= 1e-6 * norm(grid, exact.pressure)


def test_logarithm_and_exponential_are_right_to_rounding():
    """Within 1 and 2 units of the last place of those of the C library, which are off by up to one themselves."""
    x = np.concatenate([np.geomspace(3e-308, 1e308, 20011), 1 + np.linspace(-0.5, 1, 20011)])
    found, right = np.array([logarithm(value) for value in x]), np.log(x)
    assert np.max(np.abs(found - right) / np.spacing(np.abs(right))) <= 1
    x = np.concatenate([np.linspace(-708, 709, 40021), np.geomspace(1e-20, 1, 2001), -np.geomspace(1e-20, 1, 2001)])
    found, right = np.array([exponential(value) for value in x]), np.exp(x)
    assert np.max(np.abs(found - right) / np.spacing(right)) <= 2
    assert exponential(-708.5) == exponential(-np.inf) == 0 and exponential(709.5) == exponential(np.inf) == np.inf


def test_omega_solves_its_equation():
    """ω + ln ω = z from −700 to 1e8 to rounding: mixed error against scipy's Wright omega function."""
    wrightomega = pytest.importorskip("scipy.special").wrightomega
    z = np.concatenate([np.linspace(-700, 10, 4001), np.geomspace(10, 1e8, 500)])
    found = np.array([wright_omega(value) for value in z])
    assert np.max(np.abs(found / wrightomega(z) - 1)) < 1e-14


ONE_SEED = "k = 4–7 comes out 15–18 % low: 0.288(9) over 16 seeds, which scatter by 0.037; one seed gave 0.34"


@pytest.mark.long
@pytest.mark.parametrize(("zeta", "expected"), [
    (0.25, (0.95, 1.21, 1.86)),
    (1.0, (1.24, 1.24, 1.38)),
    pytest.param(0.05, (0.34, 0.34, 0.56), marks=pytest.mark.xfail(reason=ONE_SEED)),
])  # fmt: skip
def test_the_spectrum_of_figure_8(comm, zeta, expected):
    """C̃_σ/(G₁² full) by shells of q, in octaves, mean of 4 seeds at 1024²: within 15 % of an independent solver's."""
    grid = SlabGrid(comm, (1024, 1024))
    bands = np.mean([figure_8_bands(grid, seed, 0.004, zeta) for seed in range(1, 5)], axis=0)
    assert np.all(np.abs(bands - expected) <= 0.15 * np.array(expected)), bands


def figure_8_bands(grid, seed, load, zeta) -> list[float]:
    """Σ|σ̃|² / Σ|G₁ (E'q/2) h̃|² of each shell of |k|, as it is drawn, averaged over 4–7, 8–15, 16–32.  Collective."""
    heights = self_affine(grid, 0.3, 32.0, 0.031, seed)
    found = solve(grid, heights, load, zeta, tolerance=1e-8)
    q = np.sqrt(grid.q_squared())
    stress = np.abs(grid.forward(found.pressure)) ** 2 * grid.hermitian_weight
    field = response(q, load, zeta, contact_modulus=8 / 3) * 4 / 3 * q * np.abs(grid.forward(heights))
    field = field**2 * grid.hermitian_weight
    k = np.rint(q * grid.lengths[0] / (2 * np.pi))
    shells = [(k == number) & (field > 0) for number in range(33)]
    ratio = [grid.reduction.sum(stress[shell]) / (grid.reduction.sum(field[shell]) or 1) for shell in shells]
    return [float(np.mean(ratio[low:stop])) for low, stop in ((4, 8), (8, 16), (16, 33))]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("zeta", [1e-7, 1e-5])
def test_pressure_on_points_that_cannot_touch_counts(comm, seed, zeta):
    """Points far below the highest are raised while a light load is solved; pressure that an iteration leaves on them
    does work on the way down again.  That is in the certified error, and that is within the tolerance."""
    heights = np.random.default_rng(seed).standard_normal((20, 3))
    grid, solid = SlabGrid(comm, heights.shape, (93.0, 3.0)), elastic(1.0, 0.03, "sliding")
    problem = ContactProblem(grid, heights[grid.rows].copy(), solid, ExponentialWall(zeta=zeta), 1e-14)
    assert solve_exponential_wall(problem, 1e-8).certified_error > 1e-8  # what the class is about
    assert solve_contact(problem, Solver(tolerance=1e-8)).certified_error <= 1e-8


def test_an_energy_that_rounding_hides_is_refused_at_once(comm, monkeypatch):
    """For p̄ far from E' rounding hides the elastic energy: that is said, without dynamics, warnings or NaN."""
    heights = np.random.default_rng(1).standard_normal((12, 8))
    grid = SlabGrid(comm, heights.shape)
    monkeypatch.setattr(newton_from_coarse, "Dynamics", lambda *_: pytest.fail("dynamics were tried"))
    for load, zeta in ((1e-100, 0.1), (1e-70, 1.0), (1e-40, 0.3), (1e20, 0.1), (1e60, 0.1), (1e100, 1.0)):
        problem = ContactProblem(grid, heights[grid.rows].copy(), elastic(1.0), ExponentialWall(zeta=zeta), load)
        with pytest.raises(Uncertifiable, match="rounding in double precision|last digits"):
            solve_contact(problem, Solver(tolerance=1e-8))


@pytest.mark.mpi("breadth")
@pytest.mark.skipif(np.finfo(np.longdouble).eps > 1e-18, reason="the reference needs extended precision")
@pytest.mark.parametrize("method", ["newton", "gfmd"])
@pytest.mark.parametrize("zeta", [1e-3, 0.1, 10.0, 1e3])
def test_heavy_loads_are_certified_or_refused_at_once(comm, method, zeta):
    """Up to p̄ = 1e10 E' the pressures, which differ by 1e-10 of p̄, are certified to 1e-8, and their true error (slow
    reference) is not above; beyond, their last digits hold more energy than that, which is said within fifty steps."""
    grid, heights = SlabGrid(comm, (8, 7)), np.random.default_rng(1).standard_normal((8, 7))
    for power in (4, 8, 10, 12, 14):
        law, steps = ExponentialWall(zeta=zeta), []
        problem = ContactProblem(grid, heights[grid.rows].copy(), elastic(1.0), law, 10.0**power)
        if power > 10:
            with pytest.raises(Uncertifiable, match="rounding in double precision"):
                solve_contact(problem, Solver(method=method), monitor=lambda _, state, steps=steps: steps.append(state))
            assert len(steps) < 50
            continue
        found = solve_contact(problem, Solver(method=method))
        exact = Contact(heights).exponential(10.0**power, zeta)
        error = exact.error_of(grid.fetch(found.pressure, 0, grid.shape[0]))
        assert error <= found.certified_error * (1 + 1e-9) <= 1e-8 and found.iterations <= 50


@pytest.mark.skipif(np.finfo(np.longdouble).eps > 1e-18, reason="the reference needs extended precision")
@pytest.mark.parametrize("seed", [2, 4, 8, 17, 21, 23, 31, 38] if SIZE == 1 else [4])
def test_newton_under_thin_plates(comm, monkeypatch, seed):
    """White heights of 2 × 13 to 4 × 19 under slabs with a free base, .08 to 1.2 pixels thick, which bend like
    plates: steps cycle if slopes of the law are cut at 1e4 over α, and dynamics then take over.  The true error (slow
    reference) is within the bound."""
    monkeypatch.setattr(newton_from_coarse, "Dynamics", lambda *_: pytest.fail("steps cycle"))
    random = np.random.default_rng(seed)
    shape = tuple(int(n) for n in (random.integers(2, 5), random.integers(8, 20)))
    heights, thickness = random.standard_normal(shape), max(shape) * 10 ** random.uniform(-3, -0.5)
    contact = Contact(heights, (1.0, 1.0), Solid(1.0, thickness, "free"))
    load = float(contact.full_stress) * 10 ** random.uniform(-4, 1)
    zeta = float(np.std(heights) * 10 ** random.uniform(-4, 1))
    grid, solid = SlabGrid(comm, shape), elastic(1.0, thickness, "free")
    problem = ContactProblem(grid, heights[grid.rows].copy(), solid, ExponentialWall(zeta=zeta), load)
    found = solve_contact(problem, Solver(method="newton"))
    error = contact.exponential(load, zeta).error_of(grid.fetch(found.pressure, 0, shape[0]))
    assert error <= found.certified_error <= 1e-8


def test_dynamics_step_in_where_newton_s_steps_cycle(comm, monkeypatch):
    """Under a spring that ends at a hard wall, on the coarse grid; dynamics solve that and all finer ones, also where a
    rank has no rows of the coarse grid.  The pressure is that of dynamics alone, to 1e-4."""
    shapes = []

    class Seen(newton_from_coarse.Dynamics):
        def __init__(self, problem):
            shapes.append(problem.grid.shape)
            super().__init__(problem)

    monkeypatch.setattr(newton_from_coarse, "Dynamics", Seen)
    grid, heights = rough_on(comm, (64, 64), 0.8, 4.0, 0.1, 1)
    problem = ContactProblem(grid, heights, elastic(1.0), FormulaWall(pressure="0.1 - gap", gaps=(0.0, 0.1)), 0.01)
    found = solve_exponential_wall(problem, 1e-8)
    assert found.certified_error <= 1e-8 and shapes[-1] == (64, 64)
    assert comm.allreduce((32, 32) in shapes, MPI.LOR)
    assert norm(grid, found.pressure - solve_gfmd(problem, 1e-8).pressure) < 1e-4 * norm(grid, found.pressure)


def test_a_start_whose_residual_vanishes_in_single_precision(comm):
    """One point bears all, the others 1e-150 of it: the answer is that of any other start, to 1e-5."""
    heights = np.random.default_rng(1).standard_normal((8, 8))
    grid = SlabGrid(comm, heights.shape)
    problem = ContactProblem(grid, heights[grid.rows].copy(), elastic(1.0), ExponentialWall(zeta=0.01), 0.05)
    start = np.full(heights.shape, 1e-150)
    start[3, 4] = 1.0
    plain = solve_exponential_wall(problem, 1e-12)
    found = solve_exponential_wall(problem, 1e-12, start[grid.rows].copy())
    assert norm(grid, found.pressure - plain.pressure) < 1e-5 * norm(grid, plain.pressure)


def test_the_length_of_a_law():
    """ζ of an exponential wall, which changes with its units; 1 of a law without a single length."""
    wall = ExponentialWall(zeta=0.5)
    assert wall.length_scale == 0.5
    assert wall.in_units(Units(height=2.0, pressure=1.0, offset=0.0)).length_scale == 0.25
    formula = FormulaWall(pressure="exp(-gap)", gaps=(0.0, 5.0))
    assert formula.length_scale == formula.in_units(Units(2.0, 1.0, 0.0)).length_scale == 1.0
