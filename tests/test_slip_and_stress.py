"""Partial slip: Cattaneo and Mindlin's sphere, rough contacts, a cycle's loss.  Stress below waves and spheres."""

import math

import numpy as np
import pytest
from contacts import elastic, solution_of, under_hard_wall
from job_texts import rough_job
from mpi4py import MPI
from scipy.optimize import lsq_linear

import pgfmd
from pgfmd.application import job
from pgfmd.application.results import Results
from pgfmd.application.simulate import simulate
from pgfmd.errors import InputError
from pgfmd.grid.domain import OPEN
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.transforms import sink, source
from pgfmd.observables.contact import Contact
from pgfmd.observables.partial_slip import PartialSlip
from pgfmd.observables.rough_surface import RoughSurface
from pgfmd.observables.subsurface import Subsurface, _summit
from pgfmd.physics.laws.hard import Hardness, HardWall
from pgfmd.physics.solids.homogeneous import Homogeneous
from pgfmd.physics.solids.open_kernel import tangential_action

SPHERE = elastic(1.0, poisson=0.0)


def rough(n, seed=2):
    """Heights of waves 2 … 8, whose slope is about .1."""
    q = np.hypot(np.fft.fftfreq(n, 1 / n)[:, None], np.fft.rfftfreq(n, 1 / n))
    phases = np.exp(2j * np.pi * np.random.default_rng(seed).random(q.shape))
    heights = np.fft.irfft2(np.where((q > 1) & (q < 8), np.maximum(q, 1) ** -1.8, 0) * phases, s=(n, n))
    return heights * 0.1 / np.std(np.diff(heights, axis=0))


@pytest.mark.parametrize("share", [0.25, 0.75])
@pytest.mark.parametrize(("boundary", "n"), [("periodic", 640), ("open", 112)])
def test_cattaneo_mindlin(boundary, n, share):
    """A sphere of a = 48 points: stick radius c = a (1 − Q/μP)^⅓ to 1e-3, by areas inside the contact line, traction
    μ(p − (c/a) p₁), p₁ Hertz's pressure of radius c, to 1.6 % in L2; and, where there are no images, the shift μ(a² −
    c²)/R to 1e-4, and the stiffness 2E'c to 1e-3."""
    x, a, mu = np.arange(n) - n / 2 - 0.3, 48.0, 0.3
    radius, r2 = 8000.0, x[:, None] ** 2 + x**2
    force, c = 4 * a**3 / (3 * radius), a * (1 - share) ** (1 / 3)
    loads = {"force": [force * (1 - share), force], "boundary": boundary, "solid": SPHERE}
    lower, sphere = pgfmd.solve(-r2 / (2 * radius), tolerance=1e-11, **loads)
    assert math.sqrt(lower.contact_area_corrected / sphere.contact_area_corrected) == pytest.approx(c / a, rel=1e-3)
    surface = RoughSurface(sphere.problem, [PartialSlip(friction=mu, load_share=share)], fields=["traction"])
    contact = Contact.of(surface, sphere)
    found = contact.measure()["loads"]
    assert found["tangential_traction"] == pytest.approx(share * mu * sphere.mean_pressure, rel=1e-9)
    assert found["stick_area"] == pytest.approx(lower.contact_area, abs=3 / n**2)
    peak = 3 * force / (2 * math.pi * a**2)
    hertz = [peak * each / a * np.sqrt(np.maximum(1 - r2 / each**2, 0)) for each in (a, c)]
    expected, traction = mu * (hertz[0] - hertz[1]), contact.fields(("traction",), 8)["traction"]
    assert np.linalg.norm(traction - expected) < 0.016 * np.linalg.norm(expected)
    if boundary == "open":
        assert found["tangential_shift"] == pytest.approx(mu * (a**2 - c**2) / radius, rel=1e-4)
        assert found["tangential_stiffness"] * n**2 == pytest.approx(2 * c, rel=1e-3)


@pytest.mark.mpi
def test_displacement_under_a_traction(comm):
    """On a patch a traction along x displaces points as Cerruti's integrals say, to 1e-8 of the largest, on any number
    of ranks and on oblong pixels; integrals in polar coordinates about each point.  In a cell a wave responds alone."""
    poisson, (ax, ay), angles = 0.4, (1.0, 1.25), 2 * np.pi * (np.arange(256) + 0.5) / 256
    r = (np.arange(4000) + 0.5) * 0.015

    def bump(x, y):
        return np.exp(-((x - 24) ** 2 + (y - 22.5) ** 2) / 18)

    grid = SlabGrid(comm, (48, 37), (48.0, 37 * ay), domain=OPEN)
    traction = bump(*np.ix_(np.arange(48)[grid.rows] * ax, np.arange(37) * ay))
    cell = SlabGrid(comm, (12, 10), (12.0, 20.0))
    wave = np.cos(2 * np.pi * (np.arange(12)[:, None] / 6 + np.arange(10) / 5))[cell.rows]
    q, qx, qy = 2 * np.pi * np.array([math.hypot(1 / 6, 1 / 10), 1 / 6, 1 / 10])
    for along in (True, False):
        displacement, of_wave = grid.new_field(), cell.new_field()
        grid.convolve(source(traction), tangential_action(grid, poisson, along), sink(displacement))
        cell.convolve(source(wave), tangential_action(cell, poisson, along), sink(of_wave))
        response = 2 / q * (1 - poisson * qx**2 / q**2) if along else -2 * poisson * qx * qy / q**3
        np.testing.assert_allclose(of_wave, response * wave, atol=1e-12)
        kernel = 1 - poisson * np.sin(angles) ** 2 if along else poisson * np.sin(angles) * np.cos(angles)
        found = grid.fetch(displacement, 0, 48)
        for i, j in ((10, 12), (24, 20), (30, 15), (47, 0)):
            around = bump(i * ax + r[:, None] * np.cos(angles), j * ay + r[:, None] * np.sin(angles))
            assert found[i, j] == pytest.approx((around @ kernel).sum() * 0.015 * 2 / 256, abs=6e-8)
    grid.free()
    cell.free()


def test_a_small_patch_by_brute_force():
    """The traction on an open patch of ν = 0 is that of least energy ½⟨τ, Gτ⟩ − shift Στ within the bounds ±μp, by
    bounded least squares with a dense G, at the shift that was found."""
    n, mu = 20, 0.3
    heights = rough(n) - (np.arange(n)[:, None] - 9.4) ** 2 / 90 - (np.arange(n) - 9.7) ** 2 / 90
    solved = pgfmd.solve(heights, force=1.0, boundary="open", solid=SPHERE, tolerance=1e-16)
    surface = RoughSurface(solved.problem, [PartialSlip(friction=mu, load_share=0.6)], fields=["traction"])
    contact = Contact.of(surface, solved)
    shift, grid = float(contact.measure()["loads"]["tangential_shift"]), solved.problem.grid
    inside, columns = np.flatnonzero(solved.pressure), []
    for k in inside:
        response, point = grid.new_field(), np.bincount([k], minlength=n * n).reshape(n, n).astype(float)
        grid.convolve(source(point), SPHERE.apply_compliance(grid, np.float64, 1 / grid.modes), sink(response))
        columns.append(response.ravel()[inside])
    factor, most = np.linalg.cholesky(np.array(columns)), mu * solved.pressure.ravel()[inside]
    found = lsq_linear(factor.T, np.linalg.solve(factor, np.full(len(inside), shift)), (-most, most), tol=1e-14)
    traction = contact.fields(("traction",), 8)["traction"].ravel()[inside]
    assert 0.2 < np.mean(abs(found.x) < 0.999 * most) < 0.8
    np.testing.assert_allclose(traction, found.x, atol=1e-6 * traction.max())


@pytest.mark.parametrize("boundary", ["periodic", "open"])
def test_rough_contact_without_poisson_effect(boundary):
    """At ν = 0 the stick area moves as one, to 1e-6 of the shift, on rough surfaces too; at ν = .3 it does not."""
    for poisson, least, most in ((0.0, 0.0, 1e-6), (0.3, 1e-3, 0.2)):
        solid = elastic(1.0, poisson=poisson)
        contact = pgfmd.solve(rough(64), 0.01, solid=solid, tolerance=1e-13, boundary=boundary)
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
@pytest.mark.parametrize("boundary", ["periodic", "open"])
def test_shift_is_met(comm, boundary):
    """A given shift is met to 1e-6, at the load that gives this shift; the stiffness is its slope."""
    heights = rough(48)
    rows = SlabGrid(comm, heights.shape).rows
    options = {"solid": SPHERE, "tolerance": 1e-12, "comm": comm, "boundary": boundary}
    contact = pgfmd.solve(heights[rows].copy(), 0.02, **options)
    one = contact.observables(partial_slip={"friction": 0.4, "load_share": 0.3})["loads"]
    shift = float(one["tangential_shift"])
    same = contact.observables(partial_slip={"friction": 0.4, "shift": shift})["loads"]
    assert same["tangential_traction"] == pytest.approx(one["tangential_traction"], rel=3e-6)
    more = contact.observables(partial_slip={"friction": 0.4, "shift": 1.02 * shift})["loads"]
    slope = (more["tangential_traction"] - one["tangential_traction"]) / (0.02 * shift)
    assert more["tangential_stiffness"] * 0.995 <= slope <= one["tangential_stiffness"] * 1.005


def test_slip_is_refused():
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


@pytest.mark.parametrize("spacing", [1e-153, 3e153])
def test_a_traction_at_extreme_lengths(spacing):
    """On a patch displacements are proportional to lengths, also where squares of wave numbers underflow."""
    traction = np.random.default_rng(1).random((8, 6))

    def displacement(unit):
        grid, found = SlabGrid(MPI.COMM_SELF, (8, 6), (8 * unit, 6 * unit), domain=OPEN), np.empty((8, 6))
        grid.convolve(source(traction), tangential_action(grid, 0.3, True), sink(found))
        return found / unit

    np.testing.assert_allclose(displacement(spacing), displacement(1.0), rtol=1e-12)


def profile(comm, pressure, poisson, depths):
    """What is measured below a whole pressure (nx, ny)."""
    grid = SlabGrid(comm, pressure.shape)
    local = pressure[grid.rows].copy()
    problem = under_hard_wall(grid, np.zeros(local.shape), solid=elastic(1.0, poisson=poisson))
    surface = RoughSurface(problem, [Subsurface(depths=depths)])
    return Contact.of(surface, solution_of(local, local * 0, pressure.mean())).measure()["subsurface"]


@pytest.mark.mpi
@pytest.mark.parametrize("along", [0, 1])
@pytest.mark.parametrize("count", [3, 16])
def test_stress_below_a_wave(comm, along, count):
    """Under p = 1 + cos qx, even of two points a wave: Airy's closed form of plane strain at each depth, to 1e-10."""
    n, nu, depths = 32, 0.3, (0.0, 1.5, 4.0)
    x = np.arange(n)
    q = 2 * math.pi * count / n
    wave = np.repeat(1 + np.cos(q * x)[:, None], 18, axis=1)
    found = profile(comm, np.ascontiguousarray(wave if along == 0 else wave.T), nu, depths)
    for z, largest in zip(depths, found["von_mises_max"], strict=True):
        decay = math.exp(-q * z)
        zz = -1 - (1 + q * z) * decay * np.cos(q * x)
        xx = -nu / (1 - nu) - (1 - q * z) * decay * np.cos(q * x)
        yy = -nu / (1 - nu) - 2 * nu * decay * np.cos(q * x)
        xz = q * z * decay * np.sin(q * x)
        mises = np.sqrt(((xx - yy) ** 2 + (yy - zz) ** 2 + (zz - xx) ** 2) / 2 + 3 * xz**2)
        assert largest == pytest.approx(mises.max(), rel=1e-10)
    rms = found["von_mises_rms"][-1]
    assert rms == pytest.approx(math.sqrt(np.mean(mises**2)), rel=1e-10)


@pytest.mark.filterwarnings("error")
def test_depths_a_rounding_apart():
    """The default depths on a grid of two points: no parabola through them."""
    assert _summit(np.array([0.5, 0.5, 0.5]), np.array([1.0, 2.0, 1.0])) == (0.5, 2.0)


def test_hertz_below():
    """Below a sphere, ν = .3, von Mises' stress is largest at .481 a: .620 p₀ (Johnson 1985), within .5 %.  The cell is
    16 a wide, so that images and the mean add little; its mean is part of the tolerance."""
    n, a = 256, 16.0
    x = np.arange(n) - n / 2
    p = np.sqrt(np.maximum(1 - (x[:, None] ** 2 + x**2) / a**2, 0))
    grid = SlabGrid(pgfmd.parallel.mpi.world(), (n, n))
    found = profile(grid.comm, p, 0.3, tuple(a * np.array([0.40, 0.48, 0.56])))
    fit = np.polyfit(found["depth"], found["von_mises_max"], 2)
    at = -fit[1] / (2 * fit[0])
    assert np.polyval(fit, at) == pytest.approx(0.620, rel=5e-3)
    assert at == pytest.approx(0.481 * a, rel=0.01)  # the summit is flat: .5 % of its value is 4 % of its depth
    assert abs(found["row"] - n / 2).max() <= 1 and abs(found["column"] - n / 2).max() <= 1


@pytest.mark.mpi
def test_stress_below_in_a_run(comm, shared_tmp_path):
    """A run writes the profile at its own depths, and the slice of the depth where the stress is largest."""
    output = {"observables": ["subsurface"], "fields": ["von_mises"]}
    simulate(job.parse(rough_job(32, load={"pressure": [0.02]}, output=output)), comm, shared_tmp_path / "out")
    results = Results(shared_tmp_path / "out")
    found = results[0]["subsurface"]
    assert len(found["depth"]) == 12 and results[0].numbers["von_mises_max"] >= found["von_mises_max"].max()
    assert results.field("von_mises", 0).max() == pytest.approx(found["von_mises_max"].max(), rel=1e-12)


def test_stress_below_is_refused(comm):
    """Without Poisson's ratio, or in a slab, it is refused by name."""
    grid = SlabGrid(comm, (8, 8))
    flat = np.zeros(grid.local_shape)
    for solid, why in ((Homogeneous(contact_modulus=1.0), "Poisson"), (elastic(1.0, 3.0), "half-space only")):
        with pytest.raises(InputError, match=why):
            RoughSurface(under_hard_wall(grid, flat, solid=solid), [Subsurface()])


def test_lengths_whose_squares_overflow():
    """Depth and value of the largest stress scale with the unit of length, to 1e200."""
    x = np.arange(64) - 31.5
    heights = -(x[:, None] ** 2 + x**2) / 200
    usual, large = (
        pgfmd.solve(heights * unit, 0.01, spacing=unit, tolerance=1e-16).observables(subsurface={})["loads"]
        for unit in (1.0, 2.0**400)
    )
    assert large["von_mises_max"] == pytest.approx(usual["von_mises_max"], rel=1e-6)
    assert large["von_mises_depth"] / 2.0**400 == pytest.approx(usual["von_mises_depth"], rel=1e-6)
