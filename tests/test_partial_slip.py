"""Partial slip: Cattaneo and Mindlin's sphere, rough contacts, a cycle's loss, refusals."""

from __future__ import annotations

import math

import numpy as np
import pytest
from job_texts import rough_job
from solids import elastic

import pgfmd
from pgfmd.application import job
from pgfmd.errors import InputError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables.contact import Contact
from pgfmd.observables.partial_slip import PartialSlip
from pgfmd.observables.rough_surface import RoughSurface
from pgfmd.physics.laws.hard import HardWall
from pgfmd.physics.laws.hardness import Hardness
from pgfmd.physics.solids.homogeneous import Homogeneous

SPHERE = elastic(1.0, poisson=0.0)


def rough(n, seed=2):
    """Heights of waves 2 … 8, whose slope is about .1."""
    q = np.hypot(np.fft.fftfreq(n, 1 / n)[:, None], np.fft.rfftfreq(n, 1 / n))
    phases = np.exp(2j * np.pi * np.random.default_rng(seed).random(q.shape))
    heights = np.fft.irfft2(np.where((q > 1) & (q < 8), np.maximum(q, 1) ** -1.8, 0) * phases, s=(n, n))
    return heights * 0.1 / np.std(np.diff(heights, axis=0))


@pytest.fixture(scope="module")
def sphere():
    """A sphere of a = 24 points, in a cell ten times as wide."""
    x = np.arange(240) - 120.3
    return pgfmd.solve(-(x[:, None] ** 2 + x**2) / 4000, 8 * 24**3 / (3 * 4000) / 240**2, solid=SPHERE, tolerance=1e-10)


@pytest.mark.parametrize("share", [0.25, 0.75])
def test_cattaneo_mindlin(sphere, share):
    """Stick radius c = a (1 − Q/μP)^⅓ and traction μ(p − (c/a) p₁), p₁ Hertz's pressure of radius c.  Pixels: the area,
    which counts points, to 1.5 %; the traction, in L2, to 1.6 % at a = 48, and twice that at half as many.
    """
    found = sphere.observables(partial_slip={"friction": 0.3, "load_share": share})["loads"]
    a = math.sqrt(sphere.contact_area / math.pi) * 240
    assert found["tangential_traction"] == pytest.approx(share * 0.3 * sphere.mean_pressure, rel=1e-9)
    radius = math.sqrt(found["stick_area"] / math.pi) * 240
    assert (radius / a) ** 2 == pytest.approx((1 - share) ** (2 / 3), rel=0.015)
    surface = RoughSurface(sphere.problem, [PartialSlip(friction=0.3, load_share=share)], fields=["traction"])
    contact = Contact.of(surface, sphere)
    contact.measure()
    x = np.arange(240) - 120.3
    r2, a = x[:, None] ** 2 + x**2, 24.0
    c = a * (1 - share) ** (1 / 3)
    peak = 3 * sphere.mean_pressure * 240**2 / (2 * math.pi * a**2)
    hertz = [peak * each / a * np.sqrt(np.maximum(1 - r2 / each**2, 0)) for each in (a, c)]
    expected, traction = 0.3 * (hertz[0] - hertz[1]), contact.fields(("traction",), 8)["traction"]
    assert np.linalg.norm(traction - expected) < 0.032 * np.linalg.norm(expected)


def test_rough_contact_without_poisson_effect():
    """At ν = 0 the stick area moves as one, to 1e-6 of the shift, on rough surfaces too; at ν = .3 it does not."""
    for poisson, least, most in ((0.0, 0.0, 1e-6), (0.3, 1e-3, 0.2)):
        contact = pgfmd.solve(rough(64), 0.01, solid=elastic(1.0, poisson=poisson), tolerance=1e-13)
        violation = contact.observables(partial_slip={"friction": 0.2})["loads"]["stick_violation"]
        assert least <= violation <= most


def test_loss_is_the_area_of_the_loop():
    """The loss of a cycle is 4Qδ − 8∫δ dQ; the integral by Gauss–Legendre points in Q, which misses it by .01 %."""
    contact, mu = pgfmd.solve(rough(48), 0.02, solid=SPHERE, tolerance=1e-12), 0.4

    def at(share):
        return contact.observables(partial_slip={"friction": mu, "load_share": share})["loads"]

    end, (places, weights) = at(0.8), np.polynomial.legendre.leggauss(6)
    integral = 0.8 * mu * contact.mean_pressure / 2 * sum(
        weight * at(0.4 * (1 + place))["tangential_shift"] for place, weight in zip(places, weights, strict=True)
    )  # fmt: skip
    expected = 4 * end["tangential_traction"] * end["tangential_shift"] - 8 * integral
    assert end["cycle_loss"] == pytest.approx(expected, rel=5e-3) and expected > 0


@pytest.mark.mpi
def test_shift_is_met(comm):
    """A given shift is met to 1e-6, at the load that gives this shift; the stiffness is its slope."""
    heights = rough(48)
    rows = SlabGrid(comm, heights.shape).rows
    contact = pgfmd.solve(heights[rows].copy(), 0.02, solid=SPHERE, tolerance=1e-12, comm=comm)
    one = contact.observables(partial_slip={"friction": 0.4, "load_share": 0.3})["loads"]
    shift = float(one["tangential_shift"])
    same = contact.observables(partial_slip={"friction": 0.4, "shift": shift})["loads"]
    assert same["tangential_traction"] == pytest.approx(one["tangential_traction"], rel=3e-6)
    more = contact.observables(partial_slip={"friction": 0.4, "shift": 1.02 * shift})["loads"]
    slope = (more["tangential_traction"] - one["tangential_traction"]) / (0.02 * shift)
    assert more["tangential_stiffness"] * 0.995 <= slope <= one["tangential_stiffness"] * 1.005


def test_refused():
    """No friction, no Poisson's ratio, a slab, a wall that yields: refused by name."""
    slip = PartialSlip(friction=0.1)
    for solid, law, asked, why in (
        (SPHERE, HardWall(), PartialSlip(), "friction is missing"),
        (SPHERE, Hardness(hardness=1.0), slip, "hard wall"),
        (Homogeneous(contact_modulus=1.0), HardWall(), slip, "Poisson"),
        (elastic(1.0, 3.0), HardWall(), slip, "half-spaces"),
    ):
        with pytest.raises(InputError, match=why):
            asked.check_contact(solid, law)
    with pytest.raises(InputError, match="friction is missing"):  # before anything is computed
        job.parse(rough_job(8, load={"pressure": [0.1]}, output={"observables": ["partial_slip"]}))
