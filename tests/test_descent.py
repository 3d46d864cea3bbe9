"""Active-set steps that lower the energy each time: right where the larger steps go round in circles, and anywhere."""

import math
from contextlib import nullcontext

import numpy as np
import pytest
from conftest import whole
from contacts import elastic, under_hard_wall
from reference import Contact, Solid

from pgfmd.errors import SolverError, Uncertifiable
from pgfmd.grid import slab_grid, transpose
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.physics.laws.exponential_law import ExponentialWall
from pgfmd.physics.laws.hard import Hardness, HardWall
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers import dispatch
from pgfmd.solvers.active_set.active_set import State
from pgfmd.solvers.active_set.primal import Descent
from pgfmd.solvers.dispatch import solve_contact
from pgfmd.solvers.options import Solver
from pgfmd.surfaces.self_affine import self_affine

pytestmark = pytest.mark.mpi

TOLERANCE = 1e-10


def awkward(seed: int):
    """White heights of up to 16², under a load from light to half of full contact, on pixels of ratios up to 100 or
    under a thin slab with a free base, which bends like a plate."""
    random = np.random.default_rng(seed)
    shape = tuple(int(n) for n in random.integers(4, 17, 2))
    steps, thickness = (1.0, 1.0), math.inf
    if seed % 2:
        steps = (10 ** random.uniform(1, 2), 1.0)
    else:
        thickness = max(shape) * 10 ** random.uniform(-2.5, -1)
    heights, solid = random.standard_normal(shape), Solid(1.0, thickness, "free" if seed % 2 == 0 else "bonded")
    contact = Contact(heights, steps, solid)
    return heights, steps, elastic(1.0, thickness, solid.base), contact.full_stress * 10 ** random.uniform(-3, -0.3)


@pytest.mark.parametrize("seed", range(24))
def test_oblong_pixels_and_thin_slabs(comm, seed):
    """The method "active-set" certifies its answer, and its true error is not above that (slow reference)."""
    heights, steps, solid, load = awkward(seed)
    grid = SlabGrid(comm, heights.shape, (heights.shape[0] * steps[0], heights.shape[1] * steps[1]))
    problem = under_hard_wall(grid, heights[grid.rows].copy(), float(load), solid)
    found = solve_contact(problem, Solver(method="active-set", tolerance=TOLERANCE))
    exact = Contact(heights, steps, Solid(1.0, solid.thickness, solid.base)).hard(found.mean_pressure)
    assert exact.error_of(whole(grid, found.pressure)) <= found.certified_error <= TOLERANCE, seed


@pytest.mark.parametrize("hardness", [math.inf, 0.6])
@pytest.mark.parametrize("seed", range(4))
def test_the_energy_falls_with_each_step(comm, seed, hardness):
    """½⟨p, Gp⟩ − ⟨p, h⟩ never rises by more than rounding, from a uniform pressure down to the tolerance."""
    heights, steps, solid, load = awkward(2 * seed + 1)
    grid = SlabGrid(comm, heights.shape, (heights.shape[0] * steps[0], heights.shape[1] * steps[1]))
    law = HardWall() if hardness == math.inf else Hardness(hardness=float(load) * 4)
    problem = ContactProblem(grid, heights[grid.rows].copy(), solid, law, float(load))
    energies = []

    def see(state):
        energies.append(state.energy - grid.reduction.dot(state.pressure, problem.heights))

    relaxation = Descent(problem)
    start = State(np.full(grid.local_shape, problem.mean_pressure), np.empty(grid.local_shape))
    relaxation.relax(start, TOLERANCE, see)
    relaxation.free()
    assert len(energies) > 2 and np.all(np.diff(energies) <= 1e-12 * np.abs(energies[-1])), energies


def test_what_rounding_forbids_is_not_tried_again(comm, monkeypatch):
    """Where rounding in double precision alone may exceed the tolerance, no other method is tried."""
    heights, steps, solid, _ = awkward(1)
    grid = SlabGrid(comm, heights.shape)
    monkeypatch.setattr(dispatch, "solve_gfmd", lambda *_: pytest.fail("dynamics were tried"))
    problem = under_hard_wall(grid, heights[grid.rows].copy(), 0.1, solid)
    with pytest.raises(Uncertifiable, match="rounding in double precision"):
        solve_contact(problem, Solver(tolerance=1e-33))


def test_a_solver_that_fails_gives_its_memory_back(comm, monkeypatch):
    """Whether and wherever a solver fails, only the grid itself still has memory of transforms."""
    monkeypatch.setattr(slab_grid, "MOST_MODES", 0)  # none is kept for the next grid
    alive, allocate, free = {}, transpose.Strips._allocate, transpose.Strips.free

    def counted(self, *arguments):
        alive[id(self)] = self
        allocate(self, *arguments)

    def freed(self):
        alive.pop(id(self), None)
        free(self)

    monkeypatch.setattr(transpose.Strips, "_allocate", counted)
    monkeypatch.setattr(transpose.Strips, "free", freed)
    grid = SlabGrid(comm, (256, 256))
    heights = self_affine(grid, 0.8, 8.0, 0.1, 1)

    def fail(level, state):
        if level.shape[0] == failing:
            raise SolverError("as the test asks")

    for law in (HardWall(), ExponentialWall(zeta=0.1)):
        for failing in (256, 128, None):
            problem = ContactProblem(grid, heights, elastic(1.0), law, 0.005)
            with pytest.raises(SolverError, match="as the test asks") if failing else nullcontext():
                solve_contact(problem, Solver(tolerance=1e-3, method=law.methods[0]), monitor=fail)
            assert len(alive) == 1
    grid.free()
    assert not alive
