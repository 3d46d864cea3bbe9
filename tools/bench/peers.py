"""Other programs that solve contacts, for benchmarks and tests: heights (n, n), peaks positive, at a mean pressure.

watch(field, count, scale) is called after each iteration, field · scale being the pressure; it may raise EnoughError.
"""

import contextlib
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from benchmarks.recorder import EnoughError

from pgfmd.physics.solids import open_kernel


class Square(NamedTuple):
    """The side of what is solved, the contact modulus, and whether its boundaries are open."""

    side: float
    modulus: float
    open: bool = False


def tamaas(heights: np.ndarray, load: float, tolerance: float, square: Square, watch: Callable | None = None):
    """(pressure, iterations) by tamaas' Polonsky–Keer–Rey in pressures (in gaps it takes far longer)."""
    import tamaas as peer

    peer.set_log_level(peer.LogLevel.error)
    taken = [heights, -1]  # what it looks at first is the uniform start

    class Watch(peer.Functional):
        def computeF(self, variable, dual):  # noqa: N802 (their name)
            return 0.0

        def computeGradF(self, variable, gradient):  # noqa: N802
            taken[:] = np.asarray(variable).reshape(heights.shape), taken[1] + 1
            if watch and taken[1]:
                watch(*taken, 1.0)

    model = peer.Model(peer.model_type.basic_2d, [float(square.side)] * 2, list(heights.shape))
    model.E, model.nu = square.modulus, 0.0
    if square.open:
        peer.ModelFactory.registerNonPeriodic(model, "open")
    solver, functional = peer.PolonskyKeerRey(model, heights, tolerance), Watch()  # it must live as long as the solver
    if square.open:  # without it the problem is periodic
        solver.setIntegralOperator("open")
    solver.addFunctionalTerm(functional)
    solver.max_iter = 100_000
    with contextlib.suppress(EnoughError):
        solver.solve(load)
        taken[0] = model.traction
    return np.array(taken[0]).reshape(heights.shape), taken[1]


def contact_mechanics(
    heights: np.ndarray, load: float, tolerance: float, square: Square, watch: Callable | None = None,
    hardness: float | None = None,
):  # fmt: skip
    """(pressure, iterations) by ContactMechanics' constrained conjugate gradients."""
    import ContactMechanics as peer
    from ContactMechanics.Optimization import constrained_conjugate_gradients

    n, taken = len(heights), [heights, 0]
    scale = -((n / square.side) ** 2)  # of its forces, which are padded where boundaries are open

    def note(iteration, forces, _):
        taken[:] = np.asarray(forces)[:n, :n], iteration
        if watch:
            watch(*taken, scale)

    kind = peer.FreeFFTElasticHalfSpace if square.open else peer.PeriodicFFTElasticHalfSpace
    substrate = kind((n, n), square.modulus, (float(square.side),) * 2)
    limits = {"pentol": tolerance, "forcetol": tolerance, "thermotol": tolerance / 10, "maxiter": 100_000}
    with contextlib.suppress(EnoughError):
        found = constrained_conjugate_gradients(
            substrate, heights, hardness, external_force=load * square.side**2, callback=note, **limits
        )
        return -scale * np.asarray(found.jac)[:n, :n], found.nit
    return scale * taken[0], taken[1]


@contextlib.contextmanager
def love() -> Iterator[None]:
    """In the block our influence coefficients on patches are the peers', of uniform pressure on pixels (Love 1929)."""

    def kernel(x, y):
        corners = [(x + i, y + j, 4 * i * j) for i in (-0.5, 0.5) for j in (-0.5, 0.5)]
        return sum(s * (a * np.arcsinh(b / np.abs(a)) + b * np.arcsinh(a / np.abs(b))) for a, b, s in corners)

    def table(grid):  # coarse grids have larger spacings
        unit = grid.spacing[0]
        return open_kernel.cosine_transform(grid, lambda x, y: kernel(x / unit, y / unit) / unit)

    usual, open_kernel.half_space_table = open_kernel.half_space_table, table
    try:
        yield
    finally:
        open_kernel.half_space_table = usual
