"""A layer on a half-space: its symbol against a direct solution of elasticity, its limits, and a contact."""

from __future__ import annotations

from decimal import Decimal, localcontext

import numpy as np
import pytest
import reference
from solids import elastic
from test_elasticity import DIGITS, combinations, solve

from pgfmd.application.job import parse
from pgfmd.errors import InputError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.physics.laws.hard import HardWall
from pgfmd.physics.problem import ContactProblem
from pgfmd.physics.solids.layered import Layered
from pgfmd.solvers.dispatch import solve_contact
from pgfmd.solvers.options import Solver

RATIOS = [1e-6, 1e-3, 0.1, 1.0, 10.0, 1e3, 1e6]
POISSONS = [(0.0, 0.0), (0.25, 0.25), (0.4999, 0.1), (-0.5, 0.4999)]
T = [1e-3, 3e-3, 0.01, 0.03, 0.1, 0.3, 0.7, 1.0, 1.4, 1.6, 3.0, 10.0, 30.0, 49.0, 51.0]


def layered(ratio: float, poisson: tuple[float, float] = (0.25, 0.25), thickness: float = 1.0) -> Layered:
    """A layer of contact modulus 1 whose shear modulus is `ratio` times that of the half-space."""
    base = (1 - poisson[0]) / (1 - poisson[1]) / ratio
    return Layered(
        contact_modulus=1.0, poisson=poisson[0], thickness=thickness, base_modulus=base, base_poisson=poisson[1]
    )


def stresses(wave: tuple[list, ...], poisson: Decimal, modulus: Decimal) -> tuple[list, list]:
    """σzz, and σxz but for a factor −i, of waves (u, w, u', w') of q = 1 in a solid of that contact modulus."""
    u, w, du, dw = wave
    mu = modulus * (1 - poisson) / 2
    lam = 2 * mu * poisson / (1 - 2 * poisson)
    normal = [(lam + 2 * mu) * slope + lam * along for slope, along in zip(dw, u, strict=True)]
    return normal, [mu * (slope - up) for slope, up in zip(du, w, strict=True)]


def direct_factor(t: float, solid: Layered) -> float:
    """F of one wave, q = 1, d = t, from Navier's equations in layer and half-space: four waves in one, the two that
    decay in the other; displacements and stresses are continuous, no shear stress and W = 1 at the top.
    """
    with localcontext() as context:
        context.prec = DIGITS
        nu, below = Decimal(solid.poisson), Decimal(solid.base_poisson)
        bottom = combinations(Decimal(0), Decimal(1), nu)
        decaying = tuple([four[0] + four[1], four[2] + four[3]] for four in combinations(Decimal(0), Decimal(1), below))
        top = combinations(Decimal(t), Decimal(1), nu)
        layer = [*bottom[:2], *stresses(bottom, nu, Decimal(1))]
        base = [*decaying[:2], *stresses(decaying, below, Decimal(solid.base_modulus))]
        rows = [[*one, *(-value for value in two)] for one, two in zip(layer, base, strict=True)]
        normal, shear = stresses(top, nu, Decimal(1))
        rows += [[*shear, Decimal(0), Decimal(0)], [*top[1], Decimal(0), Decimal(0)]]
        coefficients = solve(rows, [Decimal(0)] * 5 + [Decimal(1)])
        return float(2 * sum(a * b for a, b in zip(normal, coefficients, strict=False)))  # over E' q/2


@pytest.mark.parametrize("poisson", POISSONS)
@pytest.mark.parametrize("ratio", RATIOS)
def test_the_symbol_is_that_of_plane_strain(ratio, poisson):
    """(E'/2) q F(qd) solves the six boundary conditions, to 1e-13: soft on stiff and stiff on soft, thin and thick,
    nearly incompressible and auxetic."""
    solid = layered(ratio, poisson)
    assert solid.factor(np.array(T)) == pytest.approx([direct_factor(t, solid) for t in T], rel=1e-13, abs=0)


def test_published_values():
    """1/F(.5) of layers 10 and .1 times as stiff as the half-space, ν = 1/4."""
    found = [1 / float(layered(ratio).factor(np.array(0.5))) for ratio in (10.0, 0.1)]
    assert found == pytest.approx([6.662598255148012, 0.305849009274627], rel=1e-14, abs=0)


@pytest.mark.parametrize("poisson", [-0.5, 0.0, 0.25, 0.4999])
def test_limits_of_the_half_space(poisson):
    """Equal moduli: no layer.  A rigid one: the bonded slab.  A soft one: the slab with a free base.  The first is
    exact to rounding; the others differ by the ratio of the moduli over t³, below 1e-13 of F here."""
    q = np.geomspace(1e-3, 100, 200)
    assert np.abs(layered(1.0, (poisson, poisson)).factor(q) - 1).max() < 1e-15
    for ratio, base in ((1e-26, "bonded"), (1e26, "free")):
        expected = elastic(1.0, 1.0, base, poisson).factor(q)
        assert layered(ratio, (poisson, 0.3)).factor(q) == pytest.approx(expected, rel=1e-13, abs=0)


@pytest.mark.parametrize("ratio", RATIOS)
def test_limits_of_the_wave(ratio):
    """Long waves meet the half-space below, short ones that of the layer; nothing overflows.  Neither stops at rest."""
    solid = layered(ratio, (0.4, 0.1))
    longest, shortest = solid.stiffness(np.array([1e-12 * min(1, 1 / ratio), 1e12]))
    assert longest == pytest.approx(solid.base_modulus / 2 * 1e-12 * min(1, 1 / ratio), rel=1e-5)
    assert shortest == solid.half_space_stiffness(1e12) == 0.5e12
    assert solid.mean_stiffness() == solid.mean_stiffness(periodic=False) == 0
    scaled = solid.in_units(3.0, 0.1)
    assert scaled.stiffness(np.array(0.7)) == pytest.approx(30 * solid.stiffness(np.array(0.7)), rel=1e-14)


class Direct:
    """A solid for `reference.Contact`, by `direct_factor`."""

    def __init__(self, solid: Layered) -> None:
        self.solid, self.modulus, self.mean_compliance = solid, solid.contact_modulus, reference.Real(0)

    def stiffness(self, q: np.ndarray) -> np.ndarray:
        """Pressure per displacement."""
        values, where = np.unique(q, return_inverse=True)
        factors = [direct_factor(float(value) * self.solid.thickness, self.solid) for value in values]
        return q / 2 * np.array(factors, reference.Real)[where].reshape(q.shape)


@pytest.mark.mpi
@pytest.mark.parametrize("transform", ["blocked", "mpi4py-fft"])
@pytest.mark.parametrize("ratio", [0.1, 30.0])
def test_a_contact_is_that_of_brute_force(comm, ratio, transform):
    """Pressures on 9 × 8 points against the quadratic program with the direct symbol: to the root of the tolerance."""
    if transform == "mpi4py-fft":
        pytest.importorskip("mpi4py_fft")
    heights, solid = np.random.default_rng(7).standard_normal((9, 8)), layered(ratio, (0.3, 0.2), thickness=2.0)
    grid = SlabGrid(comm, heights.shape, transform=transform)
    problem = ContactProblem(grid, heights[grid.rows].copy(), solid, HardWall(), 0.1)
    found = solve_contact(problem, Solver(tolerance=1e-20))
    exact = reference.Contact(heights, (1.0, 1.0), Direct(solid)).hard(0.1)
    exact = 0.1 * exact.x.astype(float).reshape(heights.shape)
    assert np.abs(found.pressure - exact[grid.rows]).max() < 1e-8 * np.abs(exact).max()


def test_a_job_needs_poisson():
    """The moduli of the layer must fix Poisson's ratio; the rest of the job reads as ever."""
    text = (
        'grid.n = 8\nsurface = {kind = "sinusoid", amplitude = 1.0}\nload.pressure = 0.1\n'
        '[solid]\nkind = "layered"\nthickness = 2.0\nbase_modulus = 3.0\nbase_poisson = 0.2\n'
    )
    assert parse(text + "young = 1.0\npoisson = 0.3\n").solid.contact_modulus == pytest.approx(1 / 0.91, rel=1e-15)
    with pytest.raises(InputError, match=r"solid.contact_modulus = 1.0: .* needs poisson"):
        parse(text + "contact_modulus = 1.0\n")
