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


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("tolerance", math.nan), ("tolerance", 0.0), ("tolerance", 1.0),
        ("threads", -1), ("threads", 0), ("threads", 1.5),
        ("spacing", 0.0), ("spacing", -1.0), ("spacing", math.inf), ("spacing", (1.0, math.nan)), ("spacing", "1"),
        ("contact_modulus", 0.0), ("contact_modulus", math.inf),
        ("thickness", 0.0), ("thickness", math.nan), ("base", "free"), ("poisson", math.nan),
        ("zeta", 0.0), ("zeta", -1.0), ("zeta", 1e-300), ("zeta", math.inf),
        ("zeta", 1e-200), ("method", "newton"), ("method", "fast"),
        ("area_tolerance", math.nan), ("area_tolerance", np.ones(2)), ("gap_tolerance", 0.0), ("gap_tolerance", "1"),
        ("pressure", -1.0), ("pressure", math.nan), ("pressure", math.inf), ("pressure", "1"),
    ],
)  # fmt: skip
def test_a_wrong_argument_is_named_in_one_line(comm, name, value):
    """InputError with the argument's name and value, and no line break."""
    arguments = {"pressure": 0.01} | {name: value}
    with pytest.raises(InputError, match=name) as caught:
        pgfmd.solve(mine(comm), arguments.pop("pressure"), comm=comm, **arguments)
    assert "\n" not in str(caught.value)


def test_ranks_that_disagree_are_refused(comm):
    """Pressures, or any other number, that differ between ranks: an error on all, and no hang."""
    if comm.size == 1:
        pytest.skip("needs ranks")
    for arguments in ({"pressure": 0.01 * (1 + comm.rank)}, {"pressure": 0.01, "zeta": 1.0 + comm.rank}):
        with pytest.raises(InputError, match="ranks ask for different"):
            pgfmd.solve(mine(comm), arguments.pop("pressure"), comm=comm, **arguments)


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
