"""Hard contacts whose heights, pressure and gap are stored in single precision."""

from functools import partial

import numpy as np
import pytest
from conftest import broad
from job_texts import rough_job

import pgfmd
from pgfmd.application.job import parse
from pgfmd.application.loads import Loads
from pgfmd.application.results import Results
from pgfmd.application.simulate import simulate
from pgfmd.errors import InputError, Stopped, Uncertifiable
from pgfmd.grid import slab_grid
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.parallel.collectives import slab
from pgfmd.solvers.active_set import unknowns
from pgfmd.surfaces.self_affine import self_affine

pytestmark = pytest.mark.mpi
LOADS = {"pressure": 0.01, "contact_area": 0.3, "mean_gap": 0.4, "displacement": 1.5}


@pytest.fixture
def solve(comm):
    """solve(heights, …): `pgfmd.solve` on these ranks, each with one thread, in single precision."""
    return partial(pgfmd.solve, storage="float32", comm=comm, threads=1)


def rough(comm, n=320):
    """Heights (nx_local, n) that single precision holds, λ_s of 8 pixels."""
    made = self_affine(SlabGrid(comm, (n, n)), 0.8, 8.0, 0.1, 3)
    return made.astype(np.float32).astype(float)


@pytest.mark.parametrize(
    ("imposed", "value"), [*LOADS.items(), *broad([("pressure", 0.06), ("pressure", 1e-5), ("pressure", 0.35)], 1)]
)
def test_it_is_the_contact_of_the_stored_heights(comm, solve, imposed, value):
    """Certified for these heights by `certify` in double precision, and the contact of double precision within what
    both certificates leave: pressures to 1e-3 of their rms value, the area to 3e-4 of it."""
    heights = rough(comm)
    asked = {imposed: value}
    found, exact = solve(heights, **asked), solve(heights, storage="float64", tolerance=1e-12, **asked)
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


def test_far_heights_are_those_of_their_mean(comm, solve):
    """Heights 3 above their mean are rounded once more, as is certified: the same contact within both certificates."""
    heights = rough(comm)
    near, far = (solve(heights + up, 0.01) for up in (0.0, 3.0))
    wrong, total = near.pressure - far.pressure, near.grid.reduction
    assert total.dot(wrong, wrong) <= 4e-10 * total.dot(near.pressure, near.pressure)
    assert far.mean_gap == pytest.approx(near.mean_gap, rel=1e-6)
    stored = (heights + 3.0).astype(np.float32).astype(float)
    again = pgfmd.certify(stored, far.pressure.astype(float), far.mean_pressure, comm=comm, threads=1)
    assert again.certified_error < 2e-8


def test_gaps_beside_contact_keep_their_digits(comm, solve):
    """A gap is stored to the last digit of itself, not of the distance between the mean planes, some 4, whose digit is
    2⁻²²: gaps below .1 are finer than that, and contact is as flat as in double precision."""
    heights = rough(comm)
    found, exact = (solve(heights, 0.0005, storage=kind, tolerance=1e-9) for kind in ("float32", "float64"))
    small = found.gap[(found.gap > 0) & (found.gap < 0.1)].astype(float)
    finer, total = found.grid.reduction.sums(np.count_nonzero(small % 2.0**-22), len(small))
    assert finer > total / 2 > 100
    assert found.max_violation <= 1.1 * exact.max_violation
    assert found.approach == pytest.approx(exact.approach, rel=1e-6)
    assert found.mean_gap == pytest.approx(found.grid.reduction.sum(found.gap) / found.grid.size, rel=1e-6)


def test_jobs_whose_heights_underflow_are_refused(comm, shared_tmp_path):
    """Heights of a job are made in double precision: tiny ones are not taken for a plane."""
    surface = {"lambda_s": 8.0, "rms_slope": 1e-50}
    text = rough_job(32, surface, load={"pressure": [1e-52]}, solver={"storage": "float32"})
    with pytest.raises(InputError, match="solver.storage.*range"):
        simulate(parse(text), comm, shared_tmp_path / "out")


def test_an_area_that_jumps_is_met_on_the_nearer_side(comm, solve):
    """On a wave that varies in x only whole rows come into contact: the area is within a row of the target."""
    grid = SlabGrid(comm, (64, 8))
    wave = np.cos(2 * np.pi * np.arange(64) / 64)[grid.rows, None] * np.ones(8)
    found = solve(wave, contact_area=0.4)
    assert abs(found.contact_area - 0.4) <= 1 / 64


def test_each_of_several_loads_is_certified(comm, solve):
    """A list of pressures: each contact is certified and bears its pressure, to the rounding of single precision."""
    loads = [0.01, 0.0103, 0.0101]
    for load, found in zip(loads, solve(rough(comm), loads), strict=True):
        assert found.grid.reduction.sum(found.pressure) / found.grid.size == pytest.approx(load, rel=1e-6)
        assert found.certified_error <= 1e-8


def test_a_start_is_used(comm, solve):
    """What was the answer needs no iteration, and is certified by 1.5 transforms."""
    cold = solve(rough(comm), 0.01)
    warm = solve(rough(comm), 0.01, start=cold.pressure)
    assert cold.transforms > 2.5 and warm.transforms <= 1.75


def test_large_grids_give_their_transforms_back(comm, solve, monkeypatch):
    """Where ranks free what can be made anew, the contact is the same to the last bit."""
    free, calls = SlabGrid.free, []
    monkeypatch.setattr(SlabGrid, "free", lambda grid: (calls.append(grid), free(grid))[1])
    kept = solve(rough(comm), 0.01)
    count = len(calls)
    monkeypatch.setattr(slab_grid, "ROOM", 0)
    freed = solve(rough(comm), 0.01)
    assert len(calls) > 2 * count
    assert np.array_equal(kept.pressure, freed.pressure) and np.array_equal(kept.gap, freed.gap)


def test_a_job_goes_on_from_its_checkpoint(comm, solve, shared_tmp_path, monkeypatch):
    """Stopped in its second load and continued: the fields of `solve` and of a run without a stop, to the tolerance."""
    surface = {"lambda_s": 8.0, "rms_slope": 0.1}
    sections = {"solid": {"contact_modulus": 1.0}, "load": {"pressure": [0.01, 0.02]}}
    text = rough_job(128, surface, **sections, solver={"storage": "float32"},
                     output={"fields": ["height", "pressure", "gap"], "precision": "float64"})  # fmt: skip
    whole, halved = shared_tmp_path / "whole", shared_tmp_path / "halved"
    simulate(parse(text), comm, whole)
    solve_load, calls = Loads.solve, []

    def once(self, index):
        calls.append(index)
        if len(calls) > 1:
            raise Stopped("stopped")
        return solve_load(self, index)

    with monkeypatch.context() as patched, pytest.raises(Stopped):
        patched.setattr(Loads, "solve", once)
        simulate(parse(text), comm, halved)
    simulate(parse(text), comm, halved, restart=True)
    for load in (0, 1):
        one, two = (Results(folder).field("pressure", load) for folder in (whole, halved))
        assert np.linalg.norm(one - two) <= 1e-3 * np.linalg.norm(one)
    heights = np.ascontiguousarray(Results(whole).field("height")[slab(128, comm.size, comm.rank)])
    direct = solve(heights, 0.01)
    saved = Results(whole).field("pressure", 0)[slab(128, comm.size, comm.rank)]
    assert np.abs(saved - direct.pressure).max() <= 1e-3 * saved.max()


def test_refined_heights_are_stored_in_single_precision(comm, solve):
    """On a grid of twice the points each way, certified in double precision."""
    heights = rough(comm, 64)
    found = solve(heights, 0.01, refine=2)
    assert found.pressure.dtype == np.float32 and found.grid.shape == (128, 128)
    stored = found.heights.astype(float)
    again = pgfmd.certify(stored, found.pressure.astype(float), found.mean_pressure, spacing=0.5, comm=comm, threads=1)
    assert again.certified_error < 2e-8


def test_observables_are_those_of_double_precision(comm, solve):
    """Curves of both precisions, to what a tolerance of 1e-8 leaves."""
    names = ("histogram", "spectra", "acf", "patches")
    double, single = (
        solve(rough(comm), 0.01, storage=storage).observables(*names) for storage in ("float64", "float32")
    )
    assert double.keys() == single.keys()
    if comm.rank == 0:
        for group in ("height_spectrum", "stress_spectrum"):
            one, two = (of[group]["value"] for of in (double, single))
            assert np.allclose(one, two, rtol=1e-2, atol=1e-6 * one.max())


@pytest.mark.parametrize("name", ["bearing", "partial_slip"])
def test_observables_that_need_double_precision_are_refused(comm, solve, name):
    """One line, before anything is measured."""
    contact = solve(rough(comm, 64), 0.01)
    with pytest.raises(InputError, match=f'{name} needs solver.storage = "float64"'):
        contact.observables(name)


@pytest.mark.parametrize(("n", "unit", "mean", "load", "options", "error", "reason"), [
    (64, 1.0, 1000.0, 1e-32, {}, InputError, "solver.storage.*subtract the mean"),
    (64, 1e-32, 0.0, 1e-32, {}, InputError, "solver.storage.*range"),
    (64, 1.0, 0.0, 0.01, {"zeta": 0.1}, InputError, "solver.storage.*wall.kind"),
    (64, 1.0, 0.0, 0.01, {"boundary": "open"}, InputError, "solver.storage.*boundary"),
    (64, 1.0, 0.0, 0.01, {"method": "gfmd"}, InputError, "solver.storage.*method"),
    (64, 1.0, 0.0, 0.01, {"thickness": 2.0, "base": "free"}, InputError, "solver.storage.*so thin a solid"),
    (64, 1.0, 0.0, 0.01, {"wall": {"kind": "hardness", "hardness": 1.0}}, InputError, "solver.storage.*wall.kind"),
    (320, 1.0, 0.0, 0.01, {"tolerance": 1e-14}, Uncertifiable, "rounding in single precision"),
    (320, 1.0, 0.0, None, {"mean_gap": 0.4, "gap_tolerance": 1e-8}, Uncertifiable,
     "gap_tolerance .* need a smaller error.*single precision"),
])  # fmt: skip
def test_what_single_precision_does_not_hold_is_refused(comm, solve, n, unit, mean, load, options, error, reason):
    """One line: why, or which key it does not go with, or which asks for an error that rounding hides."""
    with pytest.raises(error, match=reason):
        solve(unit * rough(comm, n) + mean, load, **options)


def test_wide_rows_number_their_columns_in_four_bytes(comm, monkeypatch):
    """The same bits as with two bytes, up to 65536 columns."""
    heights = rough(comm)
    short = pgfmd.solve(heights, 0.01, comm=comm, threads=1).pressure
    monkeypatch.setattr(unknowns, "SHORT", 0)
    assert np.array_equal(short, pgfmd.solve(heights, 0.01, comm=comm, threads=1).pressure)
