"""Hard contacts whose heights, pressure and gap are stored in single precision."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import broad

import pgfmd
from pgfmd.errors import InputError, Uncertifiable
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.solvers.active_set import unknowns
from pgfmd.surfaces.self_affine import self_affine

pytestmark = pytest.mark.mpi
LOADS = {"pressure": 0.01, "contact_area": 0.3, "mean_gap": 0.4, "displacement": 1.5}


def rough(comm, n=320):
    """Heights (nx_local, n) that single precision holds, λ_s of 8 pixels."""
    made = self_affine(SlabGrid(comm, (n, n)), 0.8, 8.0, 0.1, 3)
    return made.astype(np.float32).astype(float)


@pytest.mark.parametrize(
    ("imposed", "value"), [*LOADS.items(), *broad([("pressure", 0.06), ("pressure", 1e-5), ("pressure", 0.35)], 1)]
)
def test_it_is_the_contact_of_the_stored_heights(comm, imposed, value):
    """Certified for these heights by `certify` in double precision, and the contact of double precision within what
    both certificates leave: pressures to 1e-3 of their rms value, the area to 3e-4 of it.
    """
    heights = rough(comm)
    asked = {imposed: value, "comm": comm, "threads": 1}
    found, exact = pgfmd.solve(heights, storage="float32", **asked), pgfmd.solve(heights, tolerance=1e-12, **asked)
    assert found.pressure.dtype == found.gap.dtype == np.float32
    mean = found.mean_pressure
    again = pgfmd.certify(heights, found.pressure.astype(float), mean, comm=comm, threads=1)
    assert again.certified_error < 2e-8 and found.certified_error <= 1e-8
    if imposed in ("pressure", "displacement"):
        wrong = found.pressure - exact.pressure
        total = found.grid.reduction
        assert total.dot(wrong, wrong) <= 1e-6 * total.dot(exact.pressure, exact.pressure)
        assert found.contact_area == pytest.approx(exact.contact_area, rel=3e-4, abs=3 / heights.size)
        assert found.mean_gap == pytest.approx(exact.mean_gap, rel=1e-4, abs=1e-6)
    elif imposed == "contact_area":
        assert found.contact_area == pytest.approx(value, rel=0.005)
    else:
        assert found.mean_gap == pytest.approx(value, rel=1e-4)


def test_several_loads_start_from_each_other(comm):
    """A list of pressures: each load is certified and has its pressure."""
    for load, found in zip((0.01, 0.0103, 0.0101), pgfmd.solve(
        rough(comm), [0.01, 0.0103, 0.0101], storage="float32", comm=comm, threads=1
    ), strict=True):  # fmt: skip
        assert found.grid.reduction.sum(found.pressure) / found.grid.size == pytest.approx(load, rel=1e-6)
        assert found.certified_error <= 1e-8


def test_observables_are_those_of_double_precision(comm):
    """Curves of both precisions, to what a tolerance of 1e-8 leaves."""
    names = ("histogram", "spectra", "acf", "patches")
    of = {
        storage: pgfmd.solve(rough(comm), 0.01, storage=storage, comm=comm, threads=1).observables(*names)
        for storage in ("float64", "float32")
    }
    assert of["float64"].keys() == of["float32"].keys()
    if comm.rank == 0:
        for group in ("height_spectrum", "stress_spectrum"):
            one, two = (of[storage][group]["value"] for storage in ("float64", "float32"))
            assert np.allclose(one, two, rtol=1e-2, atol=1e-6 * one.max())


@pytest.mark.parametrize("name", ["bearing", "partial_slip"])
def test_observables_that_need_double_precision_are_refused(comm, name):
    """One line, before anything is measured."""
    contact = pgfmd.solve(rough(comm, 64), 0.01, storage="float32", comm=comm, threads=1)
    with pytest.raises(InputError, match=f'{name} needs solver.storage = "float64"'):
        contact.observables(name)


def test_what_rounding_hides_is_refused(comm):
    """A tolerance below what single precision can certify raises an error that names the precision."""
    with pytest.raises(Uncertifiable, match="rounding in single precision"):
        pgfmd.solve(rough(comm), 0.01, storage="float32", tolerance=1e-14, comm=comm, threads=1)


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"zeta": 0.1}, "wall.kind"), ({"boundary": "open"}, "boundary"), ({"method": "gfmd"}, "method"),
        ({"thickness": 2.0, "base": "free"}, "so thin a solid"),
        ({"wall": {"kind": "hardness", "hardness": 1.0}}, "wall.kind"),
    ],
)  # fmt: skip
def test_what_needs_double_precision_is_refused(comm, options, reason):
    """One line, which names the key that single precision does not go with."""
    with pytest.raises(InputError, match=f"solver.storage.*{reason}"):
        pgfmd.solve(rough(comm, 64), 0.01, storage="float32", comm=comm, threads=1, **options)


def test_wide_rows_number_their_columns_in_four_bytes(comm, monkeypatch):
    """The same bits as with two bytes, up to 65536 columns."""
    heights = rough(comm)
    short = pgfmd.solve(heights, 0.01, comm=comm, threads=1).pressure
    monkeypatch.setattr(unknowns, "SHORT", 0)
    assert np.array_equal(short, pgfmd.solve(heights, 0.01, comm=comm, threads=1).pressure)
