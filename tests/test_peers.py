"""Agreement with independent codes on a rough surface (extra `bench`; skipped where they are not installed)."""

import numpy as np
import peers
import pytest
from contacts import elastic, rough_on, under_hard_wall

import pgfmd
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.physics.laws.hard import Hardness
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.active_set.contact_from_coarse import solve_hard_wall
from pgfmd.solvers.dispatch import solve_contact
from pgfmd.solvers.options import Solver
from pgfmd.surfaces.self_affine import self_affine

N, PRESSURE, MODULUS = 256, 0.003, 8 / 3


@pytest.fixture(scope="module", params=[(0.8, 16.0), (0.3, 1.0)], ids=["smooth", "rough"])
def contact(request, comm):
    """Heights and our pressure (256, 256): self-affine, certified to 1e-15 of the energy, the pressure's square."""
    grid, heights = rough_on(comm, (N, N), *request.param, 0.031, 1)
    return heights, solve_hard_wall(under_hard_wall(grid, heights, PRESSURE, elastic(MODULUS)), 1e-15).pressure


def _agree(theirs: np.ndarray, ours: np.ndarray) -> None:
    """The contact area is equal to the pixel, the pressure to 1e-6 in the 2-norm: both are solved far better."""
    assert np.count_nonzero(theirs > 0) == np.count_nonzero(ours > 0)
    assert np.linalg.norm(theirs - ours) <= 1e-6 * np.linalg.norm(ours)


@pytest.mark.parametrize("program", ["tamaas", "ContactMechanics"])
def test_a_periodic_contact(contact, program):
    """tamaas' Polonsky–Keer–Rey, and ContactMechanics' constrained conjugate gradients."""
    _agree(_theirs(program, contact[0]), contact[1])


def _theirs(program: str, heights: np.ndarray, **options: bool | float) -> np.ndarray:
    """The pressure on a square by another program, at the same load."""
    pytest.importorskip(program)
    square = peers.Square(len(heights), MODULUS, bool(options.pop("open", False)))
    return {"tamaas": peers.tamaas, "ContactMechanics": peers.contact_mechanics}[program](
        heights, PRESSURE, 1e-12, square, **options
    )[0]


def test_aspher(contact):
    """ASPHER's nested solver with its periodic operator at the same load."""
    aspher = pytest.importorskip("aspher")
    heights, ours = contact
    result = aspher.solve_nested(
        N, -heights.ravel(), PRESSURE, domain_size=float(N), E_star=MODULUS, backend="periodic", tol=1e-11
    )
    _agree(np.asarray(result.pressure).reshape(N, N), ours)


def test_an_open_patch_by_contact_mechanics(comm):
    """With the kernel of uniform pixels (Love 1929), the pressure on a rough patch is that of its free half-space."""
    heights = self_affine(SlabGrid(comm, (96, 96)), 0.8, 8.0, 0.031, 1)
    with peers.love():
        ours = pgfmd.solve(heights, PRESSURE, boundary="open", contact_modulus=MODULUS, tolerance=1e-16)
    _agree(_theirs("ContactMechanics", heights, open=True), ours.pressure)


@pytest.mark.parametrize("hardness", [10 * PRESSURE, 20 * PRESSURE])
@pytest.mark.parametrize(("hurst", "lambda_s"), [(0.8, 8.0), (0.3, 1.0)], ids=["smooth", "rough"])
def test_limited_hardness_by_contact_mechanics(comm, hurst, lambda_s, hardness):
    """Its constrained conjugate gradients, with their own treatment of points that flow, find the same points at the
    hardness and in contact, and the same pressure to 1e-6 in the 2-norm (measured 1e-8)."""
    grid, heights = rough_on(comm, (64, 64), hurst, lambda_s, 0.031, 1)
    problem = ContactProblem(grid, heights, elastic(MODULUS), Hardness(hardness=hardness), PRESSURE)
    ours = solve_contact(problem, Solver(tolerance=1e-16)).pressure
    theirs = _theirs("ContactMechanics", heights, hardness=hardness)
    _agree(theirs, ours)
    assert np.count_nonzero(theirs >= hardness * (1 - 1e-12)) == np.count_nonzero(ours == hardness) > 0
