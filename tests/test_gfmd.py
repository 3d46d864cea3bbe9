"""Molecular dynamics of the displacement: the same contact as the default solvers, and as the exact solutions."""

import math

import numpy as np
import pytest
from conftest import apart
from contacts import elastic, under_hard_wall

from pgfmd.errors import SolverError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.physics.laws.exponential_law import ExponentialWall
from pgfmd.physics.laws.hard import Hardness, HardWall
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.dispatch import solve_contact
from pgfmd.solvers.gfmd import solve_gfmd
from pgfmd.solvers.law_operations import LawOperations, LawState
from pgfmd.solvers.options import Solver
from pgfmd.surfaces.self_affine import self_affine
from pgfmd.surfaces.sinusoid import sinusoid

pytestmark = pytest.mark.mpi

SOLID = elastic(8 / 3)


def test_westergaard(comm):
    """h = Δ cos(2πx/λ) at f = ½: mean gap Δ(1 − f + f ln f), to the discretisation error of a second-order quantity."""
    n, amplitude, f = 256, 1.0, 0.5
    grid = SlabGrid(comm, (n, 8))
    load = f * np.pi * 8 / 3 * amplitude / n
    found = solve_gfmd(under_hard_wall(grid, sinusoid(grid, amplitude, (1, 0)), load, SOLID), tolerance=1e-11)
    assert found.mean_gap == pytest.approx(amplitude * (1 - f + f * math.log(f)), abs=5e-6 * amplitude)
    energy = np.pi * 8 / 3 * amplitude**2 / n * f**2 * (1 - 2 * math.log(f)) / 4
    assert found.elastic_energy == pytest.approx(energy, rel=1e-4, abs=0)


def wave(grid):
    return sinusoid(grid, 1.0, (1, 1))


def rough(hurst, wavelength, slope, seed):
    return lambda grid: self_affine(grid, hurst, wavelength, slope, seed)


SMOOTH, FINE, STEEP = rough(0.8, 8.0, 0.1, 2), rough(0.3, 8.0, 0.031, 2), rough(0.8, 4.0, 0.1, 1)
WAVE_LOAD = 0.2 * math.sqrt(2) * np.pi * 8 / 3 / 64
SAME = {  # points a side, heights, solid, law, mean pressure, tolerance of the dynamics
    "wave": (64, wave, SOLID, HardWall(), WAVE_LOAD, 1e-12),
    "wave, short range": (64, wave, SOLID, ExponentialWall(zeta=0.02, sigma_ref=1.0), WAVE_LOAD, 1e-12),
    "wave, long range": (64, wave, SOLID, ExponentialWall(zeta=0.25, sigma_ref=1.0), WAVE_LOAD, 1e-12),
    "rough": (512, FINE, SOLID, HardWall(), 0.004, 1e-11),
    "rough, exponential": (512, FINE, SOLID, ExponentialWall(zeta=0.05, sigma_ref=1.0), 0.004, 1e-11),
    "hardness of half the points": (64, STEEP, elastic(1.0), Hardness(hardness=0.02), 0.01, 1e-12),
    "hardness of a few points": (64, STEEP, elastic(1.0), Hardness(hardness=0.1), 0.01, 1e-12),
    **{base: (64, SMOOTH, elastic(1.0, 8.0, base, 0.4), HardWall(), 0.01, 1e-13)
       for base in ("bonded", "free", "sliding")},
}  # fmt: skip


@pytest.mark.parametrize("case", SAME)
def test_dynamics_agree_with_the_law_s_own_method(comm, case):
    """By two methods that share the law alone: pressures to 1e-5, areas to 1e-3 (edges bear next to nothing), mean gaps
    to 1e-6, energies to 1e-5."""
    n, heights, solid, law, load, tolerance = SAME[case]
    grid = SlabGrid(comm, (n, n))
    problem = ContactProblem(grid, heights(grid), solid, law, load)
    one = solve_contact(problem, Solver(method="gfmd", tolerance=tolerance))
    two = solve_contact(problem, Solver(method=law.methods[0], tolerance=tolerance / 10))  # "auto" may take dynamics
    assert apart(grid, one, two) < 1e-5 and one.certified_error <= tolerance
    assert grid.reduction.max(one.pressure) <= law.highest
    different = grid.reduction.sum((one.pressure > 0) != (two.pressure > 0))
    assert different <= 1e-3 * grid.reduction.sum(two.pressure > 0)
    assert one.mean_gap == pytest.approx(two.mean_gap, rel=1e-6, abs=0)
    assert one.elastic_energy == pytest.approx(two.elastic_energy, rel=1e-5, abs=0)


@pytest.mark.parametrize("wall", [HardWall(), Hardness(hardness=0.05), ExponentialWall(zeta=0.05)])
def test_progress_shows_the_contact_area(comm, wall):
    """Each method's last step on the finest grid counts as many points in contact as its solution, to one."""
    grid = SlabGrid(comm, (64, 64))
    problem = ContactProblem(grid, self_affine(grid, 0.8, 4.0, 0.1, 2), SOLID, wall, 0.01)
    for method in wall.methods:
        seen = []
        watch = lambda level, state, seen=seen: seen.append((level.size, state.contact))  # noqa: E731
        found = solve_contact(problem, Solver(method=method), monitor=watch)
        count = grid.reduction.sum(found.pressure_in_contact() > 0)
        assert 0 < count < grid.size
        assert seen[-1] == (grid.size, pytest.approx(count, abs=1)), method


def test_what_does_not_arrive_is_an_error(comm):
    """Too few steps are said, not hidden."""
    grid = SlabGrid(comm, (32, 32))
    with pytest.raises(SolverError, match="after 10 steps"):
        solve_gfmd(under_hard_wall(grid, STEEP(grid), 0.01, SOLID), tolerance=1e-12, max_steps=10)


@pytest.mark.parametrize("method", ["auto", "gfmd", "active-set"])
def test_without_a_load_the_highest_point_touches(comm, method):
    """A hard wall that carries nothing is answered by every method: mean gap = highest point over the mean."""
    grid = SlabGrid(comm, (8, 8))
    problem = under_hard_wall(grid, sinusoid(grid, 1.0), 0.0, SOLID)
    assert solve_contact(problem, Solver(method=method)).mean_gap == pytest.approx(1.0)


def test_dynamics_step_in_where_the_active_set_fails(comm, monkeypatch):
    """method = "auto" ends right even if the fast solver gives up."""
    from pgfmd.solvers import dispatch

    def fail(*_, **__):
        raise SolverError("no")

    monkeypatch.setitem(dispatch.SOLVERS, "active-set", fail)
    grid = SlabGrid(comm, (32, 32))
    problem = under_hard_wall(grid, self_affine(grid, 0.8, 4.0, 0.1, 2), 0.01, SOLID)
    assert solve_contact(problem, Solver(tolerance=1e-8)).certified_error <= 1e-8
    with pytest.raises(SolverError):
        solve_contact(problem, Solver(method="active-set"))


def test_a_pressure_above_the_largest_is_not_certified(comm):
    """Points bear 3 p̄ or nothing, and 2 p̄ is the largest pressure: it carries the load, but breaks the law."""
    grid = SlabGrid(comm, (12, 9))
    heights = sinusoid(grid, 1.0, (1, 0))
    operations = LawOperations(ContactProblem(grid, heights, SOLID, Hardness(hardness=2.0), 1.0))
    bearing = np.zeros((12, 9))
    bearing[:4] = 3.0
    state = LawState(bearing[grid.rows], grid.new_field())
    operations.compute_gap(state)
    operations.certify(state)
    assert state.error == math.inf
