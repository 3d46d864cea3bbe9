"""Loads from a single pixel, and from 1e-100, to full contact, against the slow reference."""

import math
import warnings

import numpy as np
import pytest

import pgfmd

pytest.importorskip("mpi4py")
import reference  # noqa: E402
from conftest import SIZE, broad  # noqa: E402

from pgfmd.parallel.collectives import slab  # noqa: E402

pytestmark = [
    pytest.mark.mpi,
    pytest.mark.skipif(np.finfo(np.longdouble).eps > 1e-18, reason="the reference needs extended precision"),
]

N = 14
# Over the stress of full contact.
LOADS = (1e-100, 1e-30, 1e-17, 1e-13, 1e-10, 1e-8, 1e-6, 1e-4, 1e-2, 0.1, 0.5, 2.0, 10.0, 1e3)
THICKNESSES = (0.05, 1.0, 1e3, 0.3, 4.0, 20.0) if SIZE == 1 else (1.0,)
SLABS = broad([(base, thickness) for thickness in THICKNESSES for base in ("bonded", "free", "sliding")], 9)


def surface(kind: str) -> np.ndarray:
    """Heights (N, N): a paraboloid, two equal summits, or white noise."""
    x = np.arange(N) - N / 2
    if kind == "two summits":
        return 1.0 * np.isin(np.arange(N * N), (3 * N + 4, 8 * N + 9)).reshape(N, N)
    if kind == "paraboloid":
        return -(x[:, None] ** 2 + x**2) / 20
    return np.random.default_rng(4).standard_normal((N, N))


def whole(comm, heights, pressure, **options):
    """The contact of a whole surface on all ranks, with whole fields."""
    rows = slab(len(heights), comm.size, comm.rank)
    found = pgfmd.solve(heights[rows].copy(), pressure, comm=comm, threads=1, **options)
    found.pressure, found.gap = (np.concatenate(comm.allgather(field)) for field in (found.pressure, found.gap))
    return found


def check(comm, heights, tolerance, **solid):
    """All LOADS certified, their true errors within the certified ones; energy and gap to the last digits."""
    contact = reference.Contact(
        heights, (1.0, 1.0), reference.Solid(1.0, solid.get("thickness", math.inf), solid.get("base", "bonded"), 0.25)
    )
    for load in LOADS if comm.size == 1 else LOADS[::4]:
        pressure = float(load * contact.full_stress)
        found, exact = whole(comm, heights, pressure, tolerance=tolerance, **solid), contact.hard(pressure)
        error = float(exact.error_of(found.pressure))
        assert error <= found.certified_error + 1e-30 and 0 < found.certified_error <= tolerance, (load, error, found)
        assert found.pressure.mean() == pytest.approx(pressure, rel=1e-12, abs=0)
        if load <= 1e-30:
            assert np.array_equal(found.pressure > 0, heights == heights.max())
        room = 3 * math.sqrt(tolerance)
        assert found.elastic_energy == pytest.approx(float(exact.work / 2), rel=room, abs=0)
        assert np.abs(found.gap.ravel() - exact.gap).max() <= room * exact.unit * math.sqrt(
            exact.scaled_work
        ) + 1e-13 * np.ptp(heights)


@pytest.mark.parametrize("kind", ["paraboloid", "two summits", "rough"])
def test_any_load_is_certified(comm, kind):
    """On a half-space, to 1e-10."""
    check(comm, surface(kind), 1e-10)


@pytest.mark.parametrize(("base", "thickness"), SLABS)
def test_any_load_on_a_slab_is_certified(comm, base, thickness):
    """The same for slabs from a twentieth of a pixel to 70 cells thick, to 1e-8."""
    check(comm, surface("rough"), 1e-8, base=base, thickness=thickness)


@pytest.mark.parametrize("method", ["auto", "gfmd"])
@pytest.mark.parametrize("load", [1e-100, 1e-12, 1e-3])
def test_one_pixel_carries_what_its_own_compliance_says(comm, load, method):
    """A lone summit: p = N p̄ on it, 2 E_el = p̄² N G₀₀, by either method; gaps elsewhere are those of the undeformed
    surfaces but for the indentation, max G − min G ≤ 2 G₀₀ per force.  The active set computes in single precision, of
    2⁻²⁴: its energy may miss √log₂ 2N² = 2.9 of that by the transform either way, and 4 by the symbol."""
    heights, pressure = surface("rough"), load * 1e-3
    pixel = float(reference.Contact(heights).pixel)
    found = whole(comm, heights, pressure, method=method)
    assert np.count_nonzero(found.pressure) == 1
    assert found.pressure.max() == pytest.approx(N**2 * pressure, rel=1e-14, abs=0)
    room = 1e-13 if method == "gfmd" else (2 * math.sqrt(math.log2(2 * N**2)) + 4) * 2.0**-24
    assert found.elastic_energy == pytest.approx(pressure**2 * N**2 * pixel / 2, rel=room, abs=0)
    assert np.abs(found.gap - (heights.max() - heights)).max() < 2 * N**2 * pressure * pixel + 1e-14


@pytest.mark.parametrize("zeta", [None, 0.1])
@pytest.mark.parametrize("method", ["auto", "gfmd"])
@pytest.mark.parametrize("bad", ["zeros", "tensions", "nan", "inf", "huge", "tiny", "one point"])
def test_a_start_never_decides(comm, bad, method, zeta):
    """Starts without a load, not finite, of tensions, or absurd: the same pressure as without one, to 1e-5."""
    heights = surface("rough")
    start = np.zeros((N, N))
    start[3, 4] = {"nan": np.nan, "inf": np.inf, "huge": 1e308, "tiny": 1e-320, "one point": 1.0}.get(bad, 0.0)
    if bad == "huge":
        start[...] = 1e308
    if bad == "tensions":
        start[...] = -1.0
    options = {"method": method, "zeta": zeta, "tolerance": 1e-12}
    plain = whole(comm, heights, 0.05, **options)
    found = whole(comm, heights, 0.05, start=start[slab(N, comm.size, comm.rank)].copy(), **options)
    assert np.linalg.norm(found.pressure - plain.pressure) < 1e-5 * np.linalg.norm(plain.pressure)


def test_a_heavy_load_knows_its_last_digits(comm):
    """Far beyond full contact p = p̄ + Kh, whose digits end at p̄'s: the bound grows with p̄², until it is refused."""
    heights = surface("rough")
    contact = reference.Contact(heights)
    for power in (2, 6, 9):
        pressure = 10.0**power
        found = whole(comm, heights, pressure)
        error = float(contact.hard(pressure).error_of(found.pressure))
        assert error <= found.certified_error < 1e4 * max(error, 1e-32)
        assert found.elastic_energy == pytest.approx(float(contact.hard(pressure).work / 2), rel=1e-13, abs=0)
    for pressure in (1e15, 1e119):
        with pytest.raises(pgfmd.SolverError, match="last digits"):
            whole(comm, heights, pressure, method="active-set")
    with pytest.raises(pgfmd.SolverError, match="last digits"):
        whole(comm, 1e-119 * heights, 1e60, method="gfmd")


def test_loads_of_any_ratio_follow_each_other(comm):
    """From 1e54 to 1e-300 of E': their ratio underflows, and the second is solved, or refused, as if it came alone."""
    heights, second = surface("rough"), 1e-300
    rows = slab(N, comm.size, comm.rank)
    contacts = pgfmd.solve(1e40 * heights[rows], [1e54, second], comm=comm, threads=1, spacing=1e-10)
    first = next(contacts)
    assert first.certified_error <= 1e-8
    with pytest.raises(pgfmd.InputError, match="mean pressure / contact modulus"):
        next(contacts)


def test_a_plate_with_a_pit(comm):
    """A thin free slab under 1e-70 of E' on a plane with a pit: certified without a warning, the true error within."""
    heights = np.zeros((7, 3))
    heights[6, 2] = -1.8e-6
    spacing, load, solid = (0.382, 2.494), 1.9e-77, {"thickness": 0.0284, "base": "free"}
    grid_rows = slab(7, comm.size, comm.rank)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = pgfmd.solve(heights[grid_rows].copy(), load, comm=comm, threads=1, spacing=spacing, **solid)
    exact = reference.Contact(heights, spacing, reference.Solid(1.0, **solid)).hard(load)
    pressure = np.concatenate(comm.allgather(found.pressure))
    assert float(exact.error_of(pressure)) <= found.certified_error + 1e-30 <= 1e-8
