"""Agreement with independent codes on a rough surface (extra `bench`; skipped where they are not installed)."""

import numpy as np
import pytest
from contacts import elastic, under_hard_wall

import pgfmd
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.physics.laws.hard import Hardness
from pgfmd.physics.problem import ContactProblem
from pgfmd.physics.solids import open_kernel
from pgfmd.solvers.active_set.contact_from_coarse import solve_hard_wall
from pgfmd.solvers.dispatch import solve_contact
from pgfmd.solvers.options import Solver
from pgfmd.surfaces.self_affine import self_affine

N, PRESSURE, MODULUS = 256, 0.003, 8 / 3


@pytest.fixture(scope="module", params=[(0.8, 16.0), (0.3, 1.0)], ids=["smooth", "rough"])
def contact(request, comm):
    """Heights and our pressure (256, 256): self-affine, certified to 1e-15 of the energy, the pressure's square."""
    grid = SlabGrid(comm, (N, N))
    heights = self_affine(grid, *request.param, 0.031, 1)
    return heights, solve_hard_wall(under_hard_wall(grid, heights, PRESSURE, elastic(MODULUS)), 1e-15).pressure


def _agree(theirs: np.ndarray, ours: np.ndarray) -> None:
    """The contact area is equal to the pixel, the pressure to 1e-6 in the 2-norm: both are solved far better."""
    assert np.count_nonzero(theirs > 0) == np.count_nonzero(ours > 0)
    assert np.linalg.norm(theirs - ours) <= 1e-6 * np.linalg.norm(ours)


def test_tamaas(contact):
    """tamaas' Polonsky–Keer–Rey at the same load."""
    tamaas = pytest.importorskip("tamaas")
    heights, ours = contact
    tamaas.set_log_level(tamaas.LogLevel.error)
    model = tamaas.Model(tamaas.model_type.basic_2d, [float(N), float(N)], [N, N])
    model.E, model.nu = MODULUS, 0.0
    solver = tamaas.PolonskyKeerRey(model, heights, 1e-12)
    solver.max_iter = 10_000
    solver.solve(PRESSURE)
    _agree(np.asarray(model.traction), ours)


def test_aspher(contact):
    """ASPHER's nested solver with its periodic operator at the same load."""
    aspher = pytest.importorskip("aspher")
    heights, ours = contact
    result = aspher.solve_nested(
        N, -heights.ravel(), PRESSURE, domain_size=float(N), E_star=MODULUS, backend="periodic", tol=1e-11
    )
    _agree(np.asarray(result.pressure).reshape(N, N), ours)


def _by_contact_mechanics(kind: str, heights: np.ndarray, *hardness: float) -> np.ndarray:
    """The pressure on a square by ContactMechanics' constrained conjugate gradients, at the same load."""
    package = pytest.importorskip("ContactMechanics")
    from ContactMechanics.Optimization import constrained_conjugate_gradients

    n = len(heights)
    substrate = getattr(package, kind)((n, n), MODULUS, (float(n), float(n)))
    limits = {"pentol": 1e-12, "forcetol": 1e-12, "thermotol": 1e-13, "maxiter": 20_000}
    found = constrained_conjugate_gradients(substrate, heights, *hardness, external_force=PRESSURE * n**2, **limits)
    return np.asarray(found.jac)[:n, :n]


def test_contact_mechanics(contact):
    """ContactMechanics' constrained conjugate gradients."""
    heights, ours = contact
    _agree(_by_contact_mechanics("PeriodicFFTElasticHalfSpace", heights), ours)


def test_an_open_patch_by_contact_mechanics(comm, monkeypatch):
    """With the kernel of uniform pixels (Love 1929), the pressure on a rough patch is that of its free half-space."""

    def love(x, y):
        corners = [(x + i, y + j, 4 * i * j) for i in (-0.5, 0.5) for j in (-0.5, 0.5)]
        return sum(s * (a * np.arcsinh(b / np.abs(a)) + b * np.arcsinh(a / np.abs(b))) for a, b, s in corners)

    def table(grid):  # coarse grids have larger spacings
        unit = grid.spacing[0]
        return open_kernel.cosine_transform(grid, lambda x, y: love(x / unit, y / unit) / unit)

    monkeypatch.setattr(open_kernel, "half_space_table", table)
    heights = self_affine(SlabGrid(comm, (96, 96)), 0.8, 8.0, 0.031, 1)
    ours = pgfmd.solve(heights, PRESSURE, boundary="open", contact_modulus=MODULUS, tolerance=1e-16)
    _agree(_by_contact_mechanics("FreeFFTElasticHalfSpace", heights), ours.pressure)


@pytest.mark.parametrize("hardness", [10 * PRESSURE, 20 * PRESSURE])
@pytest.mark.parametrize(("hurst", "lambda_s"), [(0.8, 8.0), (0.3, 1.0)], ids=["smooth", "rough"])
def test_limited_hardness_by_contact_mechanics(comm, hurst, lambda_s, hardness):
    """Its constrained conjugate gradients, with their own treatment of points that flow, find the same points at the
    hardness and in contact, and the same pressure to 1e-6 in the 2-norm (measured 1e-8)."""
    grid = SlabGrid(comm, (64, 64))
    heights = self_affine(grid, hurst, lambda_s, 0.031, 1)
    problem = ContactProblem(grid, heights, elastic(MODULUS), Hardness(hardness=hardness), PRESSURE)
    ours = solve_contact(problem, Solver(tolerance=1e-16)).pressure
    theirs = _by_contact_mechanics("PeriodicFFTElasticHalfSpace", heights, hardness)
    _agree(theirs, ours)
    assert np.count_nonzero(theirs >= hardness * (1 - 1e-12)) == np.count_nonzero(ours == hardness) > 0
