"""Arguments of `pgfmd.solve`, anything for anything: an answer, or one line, on all ranks together."""

import math
import warnings
from collections.abc import Iterator

import numpy as np
import pytest

pytest.importorskip("mpi4py")

import pgfmd  # noqa: E402
from pgfmd.grid.slab_grid import SlabGrid  # noqa: E402
from pgfmd.parallel.collectives import slab  # noqa: E402
from pgfmd.physics.solids.homogeneous import Homogeneous  # noqa: E402

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


@pytest.mark.parametrize("wall", [{"kind": "hard"}, {"kind": "adhesive", "work": 0.2, "range": 0.8}])
@pytest.mark.parametrize(
    ("solid", "reason"),
    [({"kind": "homogeneous", "thickness": 3.0, "base": "free"}, "on a free base a slab has no approach"),
     ({"kind": "table", "path": "factor.csv"}, "its kernel on a patch is not known")],
)  # fmt: skip
def test_a_solid_without_a_response_on_a_patch_is_refused(comm, wall, solid, reason):
    """In one line, whatever the wall, and of a pressure that is to be certified: before anything is read or solved."""
    heights = np.random.default_rng(0).standard_normal((8, 6))[slab(8, comm.size, comm.rank)]
    options = {"boundary": "open", "comm": comm, "wall": wall, "solid": {"contact_modulus": 1.0} | solid}
    message = rf'grid.boundary = "open": not with solid.kind = "{solid["kind"]}": {reason}'
    with pytest.raises(pgfmd.InputError, match=message):
        pgfmd.solve(heights, 0.01, **options)
    with pytest.raises(pgfmd.InputError, match=message):
        pgfmd.certify(heights, np.maximum(heights, 0), **options)


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
    with pytest.raises(pgfmd.InputError, match=name) as caught:
        solve(comm, **{name: value})
    assert "\n" not in str(caught.value)


def test_a_solid_is_given_in_three_ways(comm):
    """Arguments, a table of keys and an object are one solid; it and one of the arguments exclude each other."""
    slab = {"contact_modulus": 2.0, "thickness": 3.0, "base": "free", "poisson": 0.25}
    ways = [slab, {"solid": slab}, {"solid": Homogeneous(**slab)}]
    pressures = [solve(comm, **way).pressure for way in ways]
    assert np.array_equal(pressures[0], pressures[1]) and np.array_equal(pressures[0], pressures[2])
    for name, value in slab.items():
        if name != "poisson":
            with pytest.raises(pgfmd.InputError, match=f"{name} = .* not both"):
                solve(comm, solid={}, **{name: value})


def test_a_solid_of_one_modulus_is_refused_where_another_counts(comm):
    """A bonded slab needs Poisson's ratio, which a table does not assume."""
    with pytest.raises(pgfmd.InputError, match=r"solid.contact_modulus = 2.0: .* needs poisson"):
        solve(comm, solid={"contact_modulus": 2.0, "thickness": 3.0})


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
    with pytest.raises(pgfmd.InputError, match="start of shape"):
        pgfmd.solve(heights[rows].copy(), 0.1, refine=2, start=heights[rows].copy(), **options)
    surface = {"kind": "self-affine", "hurst": 0.8, "lambda_s": 1.0, "rms_slope": 0.1, "seed": 2}
    job = {"grid": {"n": 16, "refine": 3}, "surface": surface}
    own, refined = (pgfmd.surface(job | {"grid": {"n": 16, "refine": k}}, comm) for k in (1, 3))
    assert refined.shape == (len(range(48)[slab(48, comm.size, comm.rank)]), 48)
    assert comm.size > 1 or np.allclose(refined[::3, ::3], own)


def test_no_transforms_stay(comm, monkeypatch):
    """A contact, a certificate and a refused call leave no grid with memory of its transforms, refined or not."""
    made, make = [], SlabGrid.__init__

    def recorded(grid, *arguments, **options):
        made.append(grid)
        make(grid, *arguments, **options)

    monkeypatch.setattr(SlabGrid, "__init__", recorded)
    contact = solve(comm)
    with pytest.raises(pgfmd.InputError, match="start of shape"):
        solve(comm, refine=2, start=contact.pressure)
    with pytest.raises(pgfmd.InputError, match="float32"):
        solve(comm, refine=2, storage="float32", zeta=1.0)
    pgfmd.certify(contact.heights, contact.pressure, comm=comm)
    assert len(made) > 5 and not any(grid._planned or grid._strips for grid in made)
