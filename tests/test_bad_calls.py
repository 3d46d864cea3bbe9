"""Calls of `pgfmd.solve` with anything for anything: an answer, or one line."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator

import numpy as np
import pytest

pytest.importorskip("mpi4py")

import pgfmd  # noqa: E402
from pgfmd.parallel.collectives import slab  # noqa: E402

pytestmark = pytest.mark.mpi

HEIGHTS = np.random.default_rng(1).standard_normal((6, 5))
ODD = (
    0, -1, math.nan, math.inf, -math.inf, 1e-300, 1e300, 5e-324, "x", "", None, True, 1j, [], [1, 2], (1, 2, 3), {},
    np.ones(3),
)  # fmt: skip
ALLOWED = {
    "pressure": (0, [1, 2], (1, 2, 3), np.ones(3)),
    "contact_modulus": (),
    "spacing": ([1, 2], None),
    "tolerance": (),
    "zeta": (None,),
    "thickness": (math.inf, 1e300),
    "poisson": (0, 1e-300, 5e-324),
    "solid": (None,),
    "threads": (None,),
    "start": (None,),
    "method": (),
    "base": (None,),
}


def solve(comm, heights=HEIGHTS, pressure=0.05, **options):
    """With this rank's rows of the heights, and of a start like them."""
    rows = slab(len(HEIGHTS), comm.size, comm.rank)
    heights = heights[rows] if isinstance(heights, np.ndarray) and np.shape(heights) == HEIGHTS.shape else heights
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return pgfmd.solve(heights, pressure, comm=comm, **({"threads": 1} | options))


def same(value, other) -> bool:
    return type(value) is type(other) and repr(value) == repr(other)


@pytest.mark.mpi("breadth")
@pytest.mark.parametrize("name", ALLOWED)
def test_odd_values_are_refused_in_one_line(comm, name):
    """Numbers out of range, texts, lists, nothing: InputError on one line, but for the few that mean something."""
    for value in ODD:
        if any(same(value, allowed) for allowed in ALLOWED[name]):
            found = solve(comm, **{name: value})
            found = next(found) if isinstance(found, Iterator) else found
            assert np.isfinite(found.pressure).all() and found.certified_error <= 1e-6
            continue
        beyond_rounding = pgfmd.SolverError if name in ("tolerance", "zeta") else pgfmd.InputError
        with pytest.raises((pgfmd.InputError, beyond_rounding)) as caught:
            solve(comm, **{name: value})
        assert str(caught.value).isprintable() and len(str(caught.value)) < 300


@pytest.mark.parametrize(
    "heights",
    ["x", None, [[1, 2], [3]], HEIGHTS * 1j, HEIGHTS > 0, HEIGHTS.astype("U8"), HEIGHTS * np.nan,
     np.array([[object()] * 5] * 6), np.ma.masked_greater(HEIGHTS, 0), np.ones(3), np.ones((2, 3, 4, 5)),
     np.ones((0, 3, 4))],
    ids=lambda value: str(type(value).__name__) + str(np.shape(value) if isinstance(value, np.ndarray) else ""),
)  # fmt: skip
def test_odd_heights_are_refused_in_one_line(comm, heights):
    """Not real numbers, masked, not a surface."""
    with pytest.raises(pgfmd.InputError) as caught:
        solve(comm, heights)
    assert str(caught.value).isprintable() and len(str(caught.value)) < 300


def test_a_number_is_asked_for_where_one_was_given(comm):
    """A load out of range is told what a number must be, not that it should have been a list."""
    with pytest.raises(pgfmd.InputError, match=r"^load.pressure = \[-1.0\]: must be a number ≥ 0 with wall.kind"):
        solve(comm, pressure=-1)


@pytest.mark.parametrize("base", ["free", "sliding"])
def test_a_half_space_has_no_base(comm, base):
    """A base without thickness is refused, in a call and in a job."""
    from pgfmd.application.job import parse

    with pytest.raises(pgfmd.InputError, match="thickness"):
        solve(comm, base=base)
    with pytest.raises(pgfmd.InputError, match="thickness"):
        solid = f'solid = {{contact_modulus = 1, base = "{base}"}}'
        parse(f'grid.n = 4\nsurface = {{kind = "paraboloid", radius = 1}}\nload.pressure = 1\n{solid}')


@pytest.mark.parametrize("base", ["bonded", "free", "sliding"])
def test_a_slab_too_thin_for_doubles_is_refused(comm, base):
    """Its stiffness leaves the range of single precision, and then that of doubles: the line names the thickness."""
    for thickness in (1e-40, 1e-100, 5e-324):
        with pytest.raises(pgfmd.InputError, match="^thickness"):
            solve(comm, base=base, thickness=thickness)


@pytest.mark.parametrize(
    ("name", "values"),
    [("pressure", (0.1, 0.2)), ("zeta", (None, 0.1)), ("tolerance", (1e-6, 1e-5)), ("spacing", (1, 2))],
)
def test_ranks_that_disagree_are_refused(comm, name, values):
    """What must be the same on all ranks is compared."""
    if comm.size == 1:
        pytest.skip("needs several ranks")
    with pytest.raises(pgfmd.InputError, match="different"):
        solve(comm, **{name: values[comm.rank == comm.size - 1]})


def test_a_wall_too_short_or_long_for_doubles_is_refused(comm):
    """ζ = 1e-300 is one line, 1e-10 is solved; at 1e20 the pressure's digits hide the elastic energy: not certified."""
    with pytest.raises(pgfmd.InputError, match="zeta"):
        solve(comm, zeta=1e-300)
    assert solve(comm, zeta=1e-10).certified_error <= 1e-6
    with pytest.raises(pgfmd.SolverError, match="zeta = 1e\\+20: .* last digits"):
        solve(comm, zeta=1e20)


def test_heights_whose_squares_overflow_are_refused(comm):
    """Spectra hold squares of heights: a paraboloid of the wrong unit, 1e197 high, is one line on all ranks."""
    tables = {"grid": {"n": 8, "length": 1e99}, "surface": {"kind": "paraboloid", "radius": 1.5},
              "solid": {"contact_modulus": 1.0}, "load": {"pressure": 1.0}}  # fmt: skip
    with pytest.raises(pgfmd.InputError, match="^surface: heights over a range of .*e\\+197"):
        pgfmd.run(tables, comm=comm)
