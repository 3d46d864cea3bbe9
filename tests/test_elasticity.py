"""Stiffness of half-space and slabs against a direct solution of plane-strain elasticity, and its limits."""

from __future__ import annotations

import math
from decimal import Decimal, localcontext

import numpy as np
import pytest
from solids import elastic

from pgfmd.errors import InputError

DIGITS = 80
BASES = ("bonded", "free", "sliding")


def combinations(z: Decimal, q: Decimal, nu: Decimal) -> tuple[list[Decimal], ...]:
    """U, W, U', W' at height z as linear forms in four coefficients.

    Waves u = (−i U(z), W(z)) exp(iqx) with W = (a + c z) cosh qz + (b + e z) sinh qz and
    −U = (b + e z + k c) cosh qz + (a + c z + k e) sinh qz, k = (3 − 4ν)/q, solve Navier's equations.
    """
    ch, sh = ((q * z).exp() + (-q * z).exp()) / 2, ((q * z).exp() - (-q * z).exp()) / 2
    k = (3 - 4 * nu) / q
    w = [ch, sh, z * ch, z * sh]
    dw = [q * sh, q * ch, ch + q * z * sh, sh + q * z * ch]
    u = [-sh, -ch, -k * ch - z * sh, -k * sh - z * ch]
    du = [-q * ch, -q * sh, -k * q * sh - sh - q * z * ch, -k * q * ch - ch - q * z * sh]
    return u, w, du, dw


def direct_stiffness(q: float, thickness: float, base: str, poisson: float) -> float:
    """Pressure per displacement of one wave on a slab of E' = 1: Navier's equations with boundary conditions.

    Two conditions at the base z = 0; at the top z = d no shear stress and W = 1.  80 digits: nothing cancels.
    """
    with localcontext() as context:
        context.prec = DIGITS
        q, d, nu = Decimal(q), Decimal(thickness), Decimal(poisson)
        mu = (1 - nu) / 2  # from E' = 2μ/(1 − ν) = 1
        lam = 2 * mu * nu / (1 - 2 * nu)

        def stresses(z: Decimal) -> tuple[list[Decimal], list[Decimal]]:
            """σzz, and σxz but for a factor −i."""
            u, w, du, dw = combinations(z, q, nu)
            normal = [(lam + 2 * mu) * dw[i] + lam * q * u[i] for i in range(4)]
            return normal, [mu * (du[i] - q * w[i]) for i in range(4)]

        u, w, _, _ = combinations(Decimal(0), q, nu)
        normal, shear = stresses(Decimal(0))
        bottom = {"bonded": (u, w), "free": (normal, shear), "sliding": (w, shear)}[base]
        normal, shear = stresses(d)
        rows = [*bottom, shear, combinations(d, q, nu)[1]]
        coefficients = solve([list(row) for row in rows], [Decimal(0)] * 3 + [Decimal(1)])
        return float(sum(a * b for a, b in zip(normal, coefficients, strict=True)))


def solve(matrix: list[list[Decimal]], right: list[Decimal]) -> list[Decimal]:
    """Gauss's elimination with pivots; overwrites both."""
    for i in range(len(right)):
        pivot = max(range(i, len(right)), key=lambda row: abs(matrix[row][i]))
        matrix[i], matrix[pivot], right[i], right[pivot] = matrix[pivot], matrix[i], right[pivot], right[i]
        for row in range(len(right)):
            if row != i:
                factor = matrix[row][i] / matrix[i][i]
                matrix[row] = [a - factor * b for a, b in zip(matrix[row], matrix[i], strict=True)]
                right[row] -= factor * right[i]
    return [right[i] / matrix[i][i] for i in range(len(right))]


def test_the_reference_solves_navier():
    """(1−2ν)∇²u + ∇(∇·u) = 0 for each of the four waves, by differences of step 1e-20."""
    with localcontext() as context:
        context.prec = DIGITS
        q, nu, z, step = Decimal("1.3"), Decimal("0.3"), Decimal("0.8"), Decimal("1e-20")
        below, here, above = (combinations(z + shift * step, q, nu) for shift in (-1, 0, 1))
        for i in range(4):
            u, w, du, dw = (part[i] for part in here)
            u1, w1, u2, w2 = ((above[k][i] - below[k][i]) / (2 * step) for k in range(4))
            assert max(abs(u1 - du), abs(w1 - dw)) < Decimal("1e-35")
            assert abs((1 - 2 * nu) * (u2 - q * q * u) - q * (q * u + dw)) < Decimal("1e-35")
            assert abs((1 - 2 * nu) * (w2 - q * q * w) + q * du + w2) < Decimal("1e-35")


@pytest.mark.parametrize("base", BASES)
@pytest.mark.parametrize("poisson", [0.0, 0.25, 0.4999])
def test_slabs_have_the_stiffness_of_plane_strain(base, poisson):
    """(E'/2) q F(qd) for qd from 1e-3 to 50, to 1e-12; ν = 0.4999 and thin slabs included, where terms cancel."""
    thickness = 3.0
    t = np.array([1e-3, 3e-3, 0.01, 0.03, 0.049, 0.051, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 39.0, 41.0, 50.0])
    expected = [direct_stiffness(value / thickness, thickness, base, poisson) for value in t]
    found = elastic(1.0, thickness, base, poisson).stiffness(t / thickness)
    assert found == pytest.approx(expected, rel=1e-12, abs=0)


@pytest.mark.parametrize("base", BASES)
def test_thick_slabs_are_half_spaces(base):
    """Far below the surface nothing is felt; nothing overflows."""
    q = np.geomspace(1e-3, 1e3, 50)
    thick = elastic(2.0, 1e9, base, 0.3).stiffness(q)
    assert np.array_equal(thick, elastic(2.0).stiffness(q))


def test_at_the_paper_s_thickness_only_long_waves_shift():
    """d = λ_l: the longest wave (t = 2π) shifts by 3.3e-4 (bonded), −6.5e-4 (free), 9.5e-5 (sliding)."""
    shifts = [float(elastic(1.0, 1.0, base, 0.25).factor(np.array([2 * np.pi]))[0]) - 1 for base in BASES]
    assert shifts == pytest.approx([3.3e-4, -6.5e-4, 9.5e-5], rel=0.02)


def test_the_mean_mode_of_a_slab_is_uniaxial_strain():
    """dp̄/dū = (λ + 2μ)/d on a rigid base, 0 under a constant stress or for a half-space; compliance of q = 0 is 0."""
    lam = mu = 1.0
    solid = elastic(8 / 3, 4.0, "bonded", 0.25)
    assert solid.mean_stiffness() == pytest.approx((lam + 2 * mu) / 4.0, rel=1e-14, abs=0)
    assert elastic(8 / 3, 4.0, "sliding", 0.25).mean_stiffness() == pytest.approx(solid.mean_stiffness())
    assert elastic(8 / 3, 4.0, "free", 0.25).mean_stiffness() == elastic(8 / 3).mean_stiffness() == 0
    assert solid.compliance(np.zeros(1))[0] == solid.stiffness(np.zeros(1))[0] == 0


@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.49])
@pytest.mark.parametrize("base", BASES)
def test_the_stiffness_of_long_waves_has_a_limit(base, poisson):
    """stiffness(q) for q → 0, by its value at qd = 1e-9; a sliding slab may then widen, so that it is E'/d."""
    solid = elastic(2.0, 3.0, base, poisson)
    limit = solid.mean_stiffness(periodic=False)
    assert float(solid.stiffness(np.array(1e-9 / 3))) == pytest.approx(limit, rel=1e-7, abs=1e-15)
    assert elastic(2.0).mean_stiffness(periodic=False) == 0


@pytest.mark.parametrize(
    "wrong",
    [
        {"contact_modulus": 0.0},
        {"contact_modulus": math.nan},
        {"contact_modulus": 1.0, "thickness": 0.0},
        {"contact_modulus": 1.0, "base": "glued"},
        {"contact_modulus": 1.0, "poisson": 0.5},
        {"contact_modulus": 1.0, "poisson": -1.0},
    ],
)
def test_solids_that_cannot_be_are_refused(wrong):
    """Moduli, thickness, base and Poisson's ratio outside their range."""
    with pytest.raises(InputError, match="must"):
        elastic(**wrong)
