"""Stress below the surface: closed forms of a sinusoidal pressure and of Hertz's contact."""

from __future__ import annotations

import math

import numpy as np
import pytest
from contacts import elastic, solution_of, under_hard_wall
from job_texts import rough_job

import pgfmd
from pgfmd.application import job
from pgfmd.application.results import Results
from pgfmd.application.simulate import simulate
from pgfmd.errors import InputError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables.contact import Contact
from pgfmd.observables.rough_surface import RoughSurface
from pgfmd.observables.subsurface import Subsurface, _summit
from pgfmd.physics.solids.homogeneous import Homogeneous


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
def test_wave(comm, along, count):
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


def test_hertz():
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
def test_in_a_run(comm, shared_tmp_path):
    """A run writes the profile at its own depths, and the slice of the depth where the stress is largest."""
    output = {"observables": ["subsurface"], "fields": ["von_mises"]}
    simulate(job.parse(rough_job(32, load={"pressure": [0.02]}, output=output)), comm, shared_tmp_path / "out")
    results = Results(shared_tmp_path / "out")
    found = results[0]["subsurface"]
    assert len(found["depth"]) == 12 and results[0].numbers["von_mises_max"] >= found["von_mises_max"].max()
    assert results.field("von_mises", 0).max() == pytest.approx(found["von_mises_max"].max(), rel=1e-12)


def test_refused(comm):
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
