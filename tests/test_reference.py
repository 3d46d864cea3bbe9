"""The slow reference itself, against exact solutions and by its own certificate."""

import itertools
import math

import numpy as np
import pytest
import reference
from reference import Contact, Real, Solid

pytestmark = pytest.mark.skipif(np.finfo(Real).eps > 1e-18, reason="needs extended precision")

LOADS = (1e-100, 1e-13, 1e-6, 1e-3, 0.05, 0.3, 1.0, 5.0)  # over the rms stress of full contact
SLABS = itertools.product(("bonded", "free", "sliding"), (0.1, 3.0))
SOLIDS = [Solid(), *(Solid(2.0, thickness, base, 0.3) for base, thickness in SLABS)]


def noise(shape, seed=1):
    return np.random.default_rng(seed).standard_normal(shape)


@pytest.mark.parametrize("solid", SOLIDS, ids=lambda solid: f"{solid.base} {solid.thickness}")
def test_hard_walls_obey_the_contact_conditions(solid):
    """From one pixel to full contact: p ≥ 0, gap ≥ 0, p·gap = 0 and Σp right, to 1e-15; bound at most 1e-20."""
    contact = Contact(noise((9, 8)), (1.0, 1.3), solid)
    counts = []
    for load in LOADS:
        found = contact.hard(load * contact.full_stress)
        size = np.abs(found.scaled_gap).max() or 1
        assert found.bound <= 1e-20 and found.x.min() >= 0 and found.scaled_gap.min() >= -1e-15 * size
        assert np.abs(found.x * found.scaled_gap).max() <= 1e-13 * found.x.max() * min(size, np.sqrt(found.scaled_work))
        assert abs(found.x.mean() - 1) < 1e-17
        counts.append(np.count_nonzero(found.x > 0))
    assert counts[0] == 1 and counts[-1] == 72 and counts == sorted(counts)


@pytest.mark.parametrize("solid", [Solid(), Solid(2.0, 5.0, "sliding"), Solid(2.0, 1.0, "bonded", 0.3)])
def test_open_patches(solid):
    """The same on patches: p ≥ 0, gap ≥ 0, p·gap = 0; a pixel is displaced as by a square load on a half-space, to
    1e-3, and less on a slab; exponential walls tend to the hard one."""
    contact = reference.OpenContact(noise((9, 8)), (1.0, 1.0), solid, (128, 128))
    square = 4 / np.pi * np.log(1 + np.sqrt(2)) / solid.modulus
    assert contact.pixel < square if solid.thickness < np.inf else abs(contact.pixel / square - 1) < 1e-3
    for load in (1e-6, 0.05, 1.0, 50.0):
        found = contact.hard(load)
        size = np.abs(contact.displace(found.deviation)).max()
        assert found.bound <= 1e-20 and found.x.min() >= 0 and found.scaled_gap.min() >= -1e-15 * size
        assert np.abs(found.x * found.scaled_gap).max() <= 1e-13 * found.x.max() * min(size, np.sqrt(found.scaled_work))
    walls = [contact.exponential(1.0, zeta) for zeta in (1e-2, 1e-3)]
    hard = contact.hard(1.0)
    apart = [float(np.abs(wall.x - hard.x).max()) for wall in walls]
    assert max(wall.bound for wall in walls) < 1e-20 and apart[0] > 3 * apart[1]
    assert abs(contact.measure("displacement", walls[1]) - contact.measure("displacement", hard)) < 0.01


@pytest.mark.parametrize("load", LOADS)
def test_guesses_and_the_textbook_agree(load):
    """The guessed active set and the textbook one, a point at a time, give the same pressures to 1e-14."""
    contact = Contact(noise((6, 7)))
    pressure = load * contact.full_stress
    programme = reference._Programme(contact, contact.heights / (pressure * contact.pixel), Real(math.inf))
    slow, _ = programme.feasible(programme.one_by_one())
    assert np.abs(slow - contact.hard(pressure).x).max() < 1e-14 * slow.max()


def test_a_hardness_bounds_the_pressure():
    """0 ≤ p ≤ σ_Y, p = σ_Y only where the gap is negative; one by one gives the same; f_c ≥ p̄/σ_Y."""
    contact = Contact(noise((8, 7)))
    for load, hardness in itertools.product((0.1, 0.5, 0.9), (1.0, 2.0)):
        pressure = load * contact.full_stress
        found = contact.hard(pressure, hardness * contact.full_stress)
        most = hardness / load
        assert found.x.max() <= most * (1 + 1e-15) and np.count_nonzero(found.x) >= found.contact.count / most
        assert np.all(found.scaled_gap[found.x >= most] <= 1e-12) and np.all(found.scaled_gap[found.x <= 0] >= -1e-12)
        programme = reference._Programme(contact, contact.heights / found.unit, Real(most))
        assert np.abs(programme.feasible(programme.one_by_one())[0] - found.x).max() < 1e-13 * most


def test_full_contact_and_a_single_pixel():
    """p = p̄ + Kh at high loads, here for a wave (K = E'q/2); at low ones the pixel's own compliance."""
    x = 2 * np.pi * np.arange(8) / 8
    wave = np.cos(x)[:, None] * np.ones(6)
    contact = Contact(wave, (0.5, 0.5), Solid(3.0))
    stiffness = 3.0 / 2 * 2 * np.pi / 4
    found = contact.hard(10.0)
    assert np.abs(10 * found.x.reshape(8, 6) - 10 - stiffness * wave).max() < 1e-14
    assert float(found.work) == pytest.approx(stiffness / 2, rel=1e-14, abs=0)
    spike = contact.hard(1e-50)  # a ridge carries it
    assert np.count_nonzero(spike.x) == 6 and float(spike.mean_gap) == pytest.approx(1, rel=1e-14, abs=0)


def test_the_exponential_wall_answers_linearly_to_small_heights():
    """σ̃ = G₁ (E'q/2) h̃, G₁ = 1/(1 + ζ q E'/2p̄) (PHYSICS 1); relative deviation of the order of (amplitude/ζ)², 1e-12;
    at light loads and for short ranges the certificate holds, too."""
    x = 2 * np.pi * np.arange(8) / 8
    wave = 1e-6 * np.cos(x)[:, None] * np.ones(8)
    contact = Contact(wave, (1.0, 1.0), Solid(2.0))
    q, zeta, load = 2 * np.pi / 8, 1.0, 0.3
    found = contact.exponential(load, zeta)
    expected = q / (1 + zeta * q / load) * wave.ravel()
    assert np.abs(load * found.deviation - expected).max() < 1e-6 * np.abs(expected).max()
    rough = Contact(noise((8, 8)))
    for load, zeta in itertools.product((1e-100, 1e-3, 0.3, 5.0), (1e-3, 0.1, 1.0, 1e10)):
        assert rough.exponential(float(load * rough.full_stress), zeta).bound < 1e-20


def test_short_exponential_walls_are_hard():
    """As ζ → 0 pressures tend to those of the hard wall, the error falling with ζ."""
    contact = Contact(noise((8, 8)))
    load = float(0.2 * contact.full_stress)
    hard = contact.hard(load)
    walls = (contact.exponential(load, zeta) for zeta in (1e-2, 1e-3, 1e-4))
    apart = [float(np.abs(wall.x - hard.x).max() / hard.x.max()) for wall in walls]
    assert apart[0] > 3 * apart[1] > 9 * apart[2] and apart[2] < 1e-3


@pytest.mark.parametrize("zeta", [None, 0.1])
def test_errors_of_other_pressures(zeta):
    """J(p) − J(p*) by Bregman's distance is that of the objective itself, computed in extended precision."""
    contact = Contact(noise((6, 6)))
    load = float(0.2 * contact.full_stress)
    exact = contact.at(load, zeta)
    other = np.maximum(exact.x + Real(1e-3) * noise(36, 2) * (exact.x > 0), 1e-30 if zeta else 0)
    other = (other / other.mean() * load).astype(float)

    def objective(x):
        b, entropy = contact.heights / exact.unit, 0
        if zeta:
            entropy = zeta / exact.unit * np.sum(np.where(x > 0, x * np.log(x, where=x > 0, out=np.zeros_like(x)), 0))
        return x @ (contact.compliance @ x) / 2 - b @ x + entropy

    x = other.astype(Real) / load
    x *= exact.x.sum() / x.sum()
    lost = (objective(x) - objective(exact.x)) / exact.scaled_work
    assert float(exact.error_of(other.reshape(6, 6))) == pytest.approx(float(lost), rel=1e-6, abs=0)
    assert contact.bound_of(other.reshape(6, 6), zeta) >= lost


def test_controls_are_found_by_bracketing():
    """The bracket's ends are neighbours, on either side of the target; what is out of reach has one end only."""
    contact = Contact(noise((6, 5)))
    for control, target in (("contact_area", 0.4), ("mean_gap", 0.5), ("displacement", 0.3)):
        low, high = (contact.measure(control, side) for side in contact.find(control, target))
        assert min(low, high) <= target <= max(low, high) and abs(high - low) < (0.1 if "area" in control else 1e-11)
    assert len(contact.find("contact_area", 0.01)) == 1


@pytest.mark.parametrize("unit", [1e-100, 1e100])
def test_units_do_not_matter(unit):
    """Lengths × unit, pressures × unit²: the same x to 1e-15."""
    heights = noise((5, 6))
    here = Contact(heights, (1.0, 2.0), Solid(1.0, 3.0, "bonded", 0.3))
    there = Contact(heights * unit, (unit, 2 * unit), Solid(unit**2, 3 * unit, "bonded", 0.3))
    for zeta in (None, 0.1):
        one = here.at(0.05, zeta)
        two = there.at(0.05 * unit**2, zeta and zeta * unit)
        assert np.abs(one.x - two.x).max() < 1e-14 * one.x.max()


@pytest.mark.parametrize("poisson", [-0.9, 0.0, 0.3, 0.4999])
@pytest.mark.parametrize("base", ["bonded", "free", "sliding"])
def test_slab_factors_keep_their_digits(base, poisson):
    """The program's F(t) against the closed forms in decimals, from films 1e-13 of a wavelength thick to 50: to a few
    units of the last digit, which certificates count as no more than 4."""
    from contacts import elastic

    thickness = np.geomspace(1e-13, 50, 1000)
    found = elastic(1.0, 1.0, base, poisson).factor(thickness)
    exact = np.array([float(reference.slab_factor(Real(t), base, poisson)) for t in thickness])
    assert np.abs(found / exact - 1).max() < 6e-16
