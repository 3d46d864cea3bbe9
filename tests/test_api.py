"""`pgfmd.solve`: wrong arguments are refused in one line, on all ranks together."""

from __future__ import annotations

import math

import numpy as np
import pytest

import pgfmd
from pgfmd.errors import InputError
from pgfmd.parallel.collectives import slab
from pgfmd.physics.solids.homogeneous import Homogeneous

pytestmark = pytest.mark.mpi

HEIGHTS = np.cos(2 * np.pi * np.arange(16) / 16)[:, None] * np.ones(8)


def mine(comm):
    """This rank's rows."""
    return HEIGHTS[slab(len(HEIGHTS), comm.size, comm.rank)].copy()


@pytest.mark.parametrize(("name", "value"), [
    ("tolerance", math.nan), ("tolerance", 0.0), ("tolerance", 1.0),
    ("threads", -1), ("threads", 0), ("threads", 1.5), ("refine", 0), ("refine", 1.5),
    ("spacing", 0.0), ("spacing", -1.0), ("spacing", math.inf), ("spacing", (1.0, math.nan)), ("spacing", "1"),
    ("contact_modulus", 0.0), ("contact_modulus", math.inf),
    ("thickness", 0.0), ("thickness", math.nan), ("base", "free"), ("poisson", math.nan),
    ("zeta", 0.0), ("zeta", -1.0), ("zeta", 1e-300), ("zeta", math.inf),
    ("zeta", 1e-200), ("method", "newton"), ("method", "fast"),
    ("area_tolerance", math.nan), ("area_tolerance", np.ones(2)), ("gap_tolerance", 0.0), ("gap_tolerance", "1"),
    ("pressure", -1.0), ("pressure", math.nan), ("pressure", math.inf), ("pressure", "1"),
])  # fmt: skip
def test_a_wrong_argument_is_named_in_one_line(comm, name, value):
    """InputError with the argument's name and value, and no line break."""
    arguments = {"pressure": 0.01} | {name: value}
    with pytest.raises(InputError, match=name) as caught:
        pgfmd.solve(mine(comm), arguments.pop("pressure"), comm=comm, **arguments)
    assert "\n" not in str(caught.value)


def test_a_solid_is_given_in_three_ways(comm):
    """Arguments, a table of keys and an object are one solid; it and one of the arguments exclude each other."""
    slab = {"contact_modulus": 2.0, "thickness": 3.0, "base": "free", "poisson": 0.25}
    ways = [slab, {"solid": slab}, {"solid": Homogeneous(**slab)}]
    pressures = [pgfmd.solve(mine(comm), 0.01, comm=comm, **way).pressure for way in ways]
    assert np.array_equal(pressures[0], pressures[1]) and np.array_equal(pressures[0], pressures[2])
    for name, value in slab.items():
        if name != "poisson":
            with pytest.raises(InputError, match=f"{name} = .* not both"):
                pgfmd.solve(mine(comm), 0.01, comm=comm, solid={}, **{name: value})


def test_a_solid_of_one_modulus_is_refused_where_another_counts(comm):
    """A bonded slab needs Poisson's ratio, which a table does not assume."""
    with pytest.raises(InputError, match=r"solid.contact_modulus = 2.0: .* needs poisson"):
        pgfmd.solve(mine(comm), 0.01, comm=comm, solid={"contact_modulus": 2.0, "thickness": 3.0})


def test_refined_contact_is_that_of_the_interpolated_heights(comm):
    """`refine` solves on k times the points each way, here on heights interpolated by NumPy; so does a job's."""
    heights = np.random.default_rng(3).standard_normal((12, 9))
    spectrum = np.zeros((24, 18), complex)
    kx, ky = (np.fft.fftfreq(n, 1 / n).astype(int) for n in heights.shape)
    spectrum[np.ix_(kx, ky)] = np.fft.fft2(heights) * 4
    spectrum[[6, -6]] = spectrum[-6] / 2  # Nyquist
    finer = np.fft.ifft2(spectrum).real
    rows, finer_rows = (slab(n, comm.size, comm.rank) for n in (12, 24))
    options = {"comm": comm, "tolerance": 1e-10}
    contact = pgfmd.solve(heights[rows].copy(), 0.1, refine=2, **options)
    direct = pgfmd.solve(finer[finer_rows].copy(), 0.1, spacing=0.5, **options)
    np.testing.assert_allclose(contact.heights, finer[finer_rows], atol=1e-12)
    np.testing.assert_allclose(contact.pressure, direct.pressure, atol=1e-3 * contact.pressure.max())
    assert contact.problem.grid.lengths == (12.0, 9.0) and contact.mean_gap == pytest.approx(direct.mean_gap, rel=1e-4)
    assert pgfmd.solve(heights[rows].copy(), 0.1, refine=2, start=contact.pressure, **options).transforms < 3
    with pytest.raises(InputError, match="start of shape"):
        pgfmd.solve(heights[rows].copy(), 0.1, refine=2, start=heights[rows].copy(), **options)
    surface = {"kind": "self-affine", "hurst": 0.8, "lambda_s": 1.0, "rms_slope": 0.1, "seed": 2}
    job = {"grid": {"n": 16, "refine": 3}, "surface": surface}
    own, refined = (pgfmd.surface(job | {"grid": {"n": 16, "refine": k}}, comm) for k in (1, 3))
    assert refined.shape == (len(range(48)[slab(48, comm.size, comm.rank)]), 48)
    assert comm.size > 1 or np.allclose(refined[::3, ::3], own)
