"""Agreement with independent codes on a rough surface (extra `bench`; skipped where they are not installed)."""

import numpy as np
import pytest

N, PRESSURE, MODULUS = 256, 0.003, 8 / 3


@pytest.fixture(scope="module", params=[(0.8, 16.0), (0.3, 1.0)], ids=["smooth", "rough"])
def contact(request, comm):
    """Heights and our pressure (256, 256): self-affine, to a certified error of 1e-12."""
    from pgfmd.grid.slab_grid import SlabGrid
    from pgfmd.physics.elasticity import Elasticity
    from pgfmd.physics.laws.hard import HardWall
    from pgfmd.physics.problem import ContactProblem
    from pgfmd.solvers.active_set.nested_iteration import solve_hard_wall
    from pgfmd.surfaces.self_affine import self_affine

    hurst, lambda_s = request.param
    grid = SlabGrid(comm, (N, N))
    heights = self_affine(grid, hurst, lambda_s, 0.031, 1)
    return heights, solve_hard_wall(
        ContactProblem(grid, heights, Elasticity(MODULUS), HardWall(), PRESSURE), 1e-12
    ).pressure


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


def test_contact_mechanics(contact):
    """ContactMechanics' constrained conjugate gradients at the same load."""
    pytest.importorskip("ContactMechanics")
    from ContactMechanics import PeriodicFFTElasticHalfSpace
    from ContactMechanics.Optimization import constrained_conjugate_gradients

    heights, ours = contact
    substrate = PeriodicFFTElasticHalfSpace((N, N), MODULUS, (float(N), float(N)))
    result = constrained_conjugate_gradients(
        substrate, heights, external_force=PRESSURE * N**2, pentol=1e-11, forcetol=1e-11, thermotol=1e-12
    )
    _agree(np.asarray(result.jac), ours)
