"""The Python interface: `pgfmd.solve`, `pgfmd.surface`, `pgfmd.run` and results, beside what jobs give."""

import math
import tempfile

import numpy as np
import pytest
from conftest import ROOT

import pgfmd
from pgfmd.application import loads
from pgfmd.application.job import parse, tables_as_toml
from pgfmd.application.results import Runs
from pgfmd.errors import InputError, SolverError
from pgfmd.grid import slab_grid, transpose
from pgfmd.parallel.collectives import slab

pytestmark = pytest.mark.mpi

JOB = {
    "grid": {"n": 48},
    "surface": {"kind": "self-affine", "hurst": 0.8, "lambda_s": 8.0, "rms_slope": 0.1, "seed": 3},
    "solid": {"contact_modulus": 2.0},
    "load": {"pressure": [0.004, 0.02]},
    "solver": {"tolerance": 1e-18},
    "output": {"fields": ["height", "pressure", "gap"], "observables": ["histogram", "spectra", "discretisation"]},
}
SOLVE = {"contact_modulus": 2.0, "tolerance": 1e-18}


@pytest.fixture(scope="module")
def heights(comm):
    """This rank's rows of the surface of JOB."""
    return pgfmd.surface(JOB, comm)


@pytest.fixture
def results(comm, shared_tmp_path):
    """A run of JOB."""
    return pgfmd.run(JOB, shared_tmp_path / "run", comm=comm)


def test_a_call_gives_what_a_run_gives(comm, heights, results):
    """Pressures, gaps, numbers, curves and error bars of `solve` are those of the run of the same job.  Both are
    certified to 1e-18, so that pressures agree to its square root.  Spectra of arrays end at the grid's last mode,
    those of jobs at λ_s: the observable of the run is asked for with the same bins."""
    rows = slab(48, comm.size, comm.rank)
    for load, contact in zip(results, pgfmd.solve(heights, JOB["load"]["pressure"], comm=comm, **SOLVE), strict=True):
        scale = load.field("pressure").max()
        np.testing.assert_allclose(contact.pressure, load.field("pressure", rows), atol=1e-8 * scale)
        np.testing.assert_allclose(contact.gap, load.field("gap", rows), atol=1e-7)
        for name in ("mean_pressure", "contact_area", "mean_gap", "displacement", "elastic_energy", "kappa"):
            assert math.isclose(contact.numbers[name], load.numbers[name], rel_tol=1e-6)
        groups = contact.observables("histogram", spectra={"all_modes": True})
        if comm.rank == 0:
            count = groups["pressure_histogram"]["count"]
            np.testing.assert_array_equal(count, load["pressure_histogram"]["count"])
            assert groups["stress_spectrum"]["q"][-1] > load["stress_spectrum"]["q"][-1]
        assert contact.contact_area_error >= 0


@pytest.mark.parametrize("name", ["contact_area", "mean_gap", "displacement"])
def test_what_is_imposed_is_met(comm, heights, name):
    """A contact solved again by its own area, gap or displacement has the load that it began with.  The tolerances
    asked for bound the imposed quantity; loads follow within ten times them (their logarithmic derivatives are of order
    one).  An area is met to a pixel, of about 400."""
    first = pgfmd.solve(heights, 0.01, comm=comm, **SOLVE)
    target = getattr(first, name)
    again = pgfmd.solve(heights, **{name: target}, gap_tolerance=1e-6, area_tolerance=1e-3, comm=comm, **SOLVE)
    assert math.isclose(again.mean_pressure, 0.01, rel_tol=1e-2 if name == "contact_area" else 1e-5)


def test_what_the_caller_does_to_its_arrays_later_changes_nothing(comm, heights):
    """κ, the error bar and the heights of contacts are those of the call, though the buffer of their heights has held
    another surface since; so is the start of a list.  The contacts of a list share one copy, and an array that nobody
    can write is not copied."""
    kept, buffer = pgfmd.solve(heights.copy(), 0.01, comm=comm, **SOLVE), heights.copy()
    start = kept.pressure.copy()
    contacts = pgfmd.solve(buffer, [0.01, 0.02], start=start, comm=comm, **SOLVE)
    start[:] = 0
    contact = next(contacts)
    buffer[:] = 7 * buffer**2
    again = pgfmd.solve(heights.copy(), 0.01, start=kept.pressure, comm=comm, **SOLVE)
    assert contact.transforms == again.transforms
    assert math.isclose(contact.numbers["kappa"], kept.numbers["kappa"], rel_tol=1e-9)
    assert math.isclose(contact.contact_area_error, kept.contact_area_error, rel_tol=1e-3)
    np.testing.assert_array_equal(contact.heights, heights)
    assert next(contacts).heights is contact.heights
    contacts.close()
    buffer.flags.writeable = False
    assert pgfmd.solve(buffer, 0.01, comm=comm).heights is buffer
    assert pgfmd.solve(buffer[:], 0.01, comm=comm).heights.base is buffer


def test_a_force_is_pressure_times_area(comm, heights):
    """Forces of a list are those of the contacts found, and the pressure is the force over the cell's area."""
    contacts = pgfmd.solve(heights, force=[5.0, 10.0], spacing=0.5, comm=comm)
    for target, contact in zip((5.0, 10.0), contacts, strict=True):
        assert math.isclose(contact.force, target) and math.isclose(contact.mean_pressure, target / 24**2)


def test_a_list_is_solved_as_it_is_asked_for(comm, heights):
    """What is not asked for is not solved, so that a wrong later load does no harm; near loads start from the last."""
    contacts = pgfmd.solve(heights, [0.01, 0.01001, 0.5], comm=comm, **SOLVE)
    first, second = next(contacts), next(contacts)
    cold = pgfmd.solve(heights, 0.01001, comm=comm, **SOLVE)
    assert second.transforms < cold.transforms and first.mean_pressure == 0.01
    contacts.close()


def test_a_batch_is_its_surfaces_one_by_one(comm, heights):
    """Heights (B, nx, ny) give the contacts of each, to the last bit; lists of loads, a start and none are refused."""
    surfaces = np.stack([heights, 2 * heights, -heights])
    for imposed in ({"pressure": 0.02}, {"contact_area": 0.2}):
        for contact, alone in zip(pgfmd.solve(surfaces, comm=comm, **imposed), surfaces, strict=True):
            assert np.array_equal(contact.pressure, pgfmd.solve(alone, comm=comm, **imposed).pressure)
    for wrong in ({"pressure": [0.1]}, {"pressure": 0.1, "start": surfaces}):
        with pytest.raises(InputError, match="B ≥ 1 surfaces"):
            pgfmd.solve(surfaces, comm=comm, **wrong)
    with pytest.raises(InputError, match="B ≥ 1 surfaces"):
        pgfmd.solve(surfaces[:0], 0.1, comm=comm)
    if comm.size > 1:
        for uneven in (surfaces[: comm.rank + 1], surfaces if comm.rank else surfaces[0]):
            with pytest.raises(InputError, match="different numbers of surfaces"):
                pgfmd.solve(uneven, 0.1, comm=comm)


@pytest.mark.parametrize(("arguments", "message"), [
    ({}, "exactly one of"), ({"pressure": 0.1, "force": 1.0}, "pressure and force"),
    ({"pressure": []}, "pressure = "), ({"force": [1, -1]}, "force = "), ({"contact_area": 1.5}, "contact_area"),
    ({"pressure": 0.1, "wall": {"kind": "soft"}}, "wall.kind"), ({"pressure": 0.1, "wall": 3}, "wall = 3"),
    ({"pressure": 0.1, "zeta": 1.0, "wall": {"kind": "hard"}}, "zeta"),
    ({"pressure": 0.1, "area_tolerance": 0.0}, "area_tolerance"),
])  # fmt: skip
def test_wrong_loads_and_walls_are_refused(comm, heights, arguments, message):
    """One line that names the argument, on all ranks, before anything is solved."""
    with pytest.raises(InputError, match=message) as caught:
        pgfmd.solve(heights, comm=comm, **arguments)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("observable", ["spectrum", "Spectra"])
def test_unknown_observables_are_refused(comm, heights, observable):
    """The name, and the nearest that is known."""
    contact = pgfmd.solve(heights, 0.01, comm=comm)
    with pytest.raises(InputError, match="did you mean spectra"):
        contact.observables(observable)


def test_results_can_be_iterated_joined_and_shown(results):
    """Loads in turn; two runs as one; the representation shows the table; data frames hold its numbers and bars."""
    pandas = pytest.importorskip("pandas")
    both = results + results
    assert [load.index for load in both] == [0, 1, 0, 1] and len(both) == 4
    assert "contact_area" in repr(results) and "mean_pressure 0.004" in repr(results[0])
    frame = results.to_dataframe()
    assert isinstance(frame, pandas.DataFrame) and list(frame["mean_pressure"]) == [0.004, 0.02]
    assert (frame["contact_area_corrected_error"] >= 0).all()
    assert len(both.to_dataframe()) == 4
    assert Runs([]).to_dataframe().empty


def test_a_group_that_is_not_there_is_named_with_those_that_are(results):
    """One line says what the load has, and how to read a field that is taken for a group."""
    load = results[0]
    for name in ("gap", "contact"):
        with pytest.raises(KeyError) as caught:
            load[name]
        message = caught.value.args[0]
        assert message.startswith(f"load 0 has no {name}, but ") and all(group in message for group in load)
        assert ("field('gap')" in message) is (name == "gap")


def test_fields_have_named_axes(comm, heights, results):
    """xarray of a contact and of a load of the run: x and y in lengths, the same fields."""
    pytest.importorskip("xarray")
    contact = next(pgfmd.solve(heights, [0.004], comm=comm, **SOLVE))
    mine, whole = contact.to_xarray(), results[0].to_xarray()
    assert whole.pressure.dims == ("x", "y") and float(whole.x[-1]) == 47.0
    assert abs(mine.pressure - whole.pressure.sel(x=mine.x)).max() <= 1e-8 * whole.pressure.max()
    assert mine.attrs["contact_area"] == whole.attrs["contact_area"]


def test_a_picture_shows_the_contact():
    """Axes with the surface and the pressure on it, for one process; x runs to the right."""
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    wave = np.cos(2 * np.pi * np.arange(32) / 32)
    contact = pgfmd.solve(wave[:, None] * np.ones(16), 0.1)
    surface, pressure = contact.plot().get_images()
    np.testing.assert_array_equal(surface.get_array(), contact.heights.T)
    np.testing.assert_array_equal(pressure.get_array().mask, contact.pressure.T <= 0)


def test_tables_are_jobs():
    """A job in tables is the job in TOML; what TOML cannot say is refused in one line."""
    job = parse(tables_as_toml(JOB | {"output": {"observables": ["spectra"], "spectra": {"bins": 7}}}))
    assert job.output.spectra.bins == 7 and job.surface.seed == 3 and job.load.pressure == (0.004, 0.02)
    with pytest.raises(InputError, match="load"):
        tables_as_toml({"load": {"pressure": None}})


def test_temporary_results_are_removed(comm):
    """Without an output folder the results are in a temporary one, which goes with the last reference to them."""
    if comm.size > 1:
        pytest.skip("one process")
    results = pgfmd.run(JOB)
    folder = results.directory
    load = results[0]
    del results
    assert folder.is_dir() and load["pressure_histogram"]["count"].sum() > 0
    del load
    assert not folder.exists()


def test_a_run_that_fails_leaves_nothing_behind(comm, shared_tmp_path, monkeypatch):
    """The temporary folder is removed, and shared memory given back, though the caller goes on."""
    held = []

    def allocate(strips, *arguments):
        held.append(strips)
        return original[0](strips, *arguments)

    def free(strips):
        held.remove(strips)
        original[1](strips)

    def fails(*_):
        raise SolverError("it does not converge")

    monkeypatch.setattr(slab_grid, "MOST_MODES", 0)  # none is kept for the next grid
    original = transpose.Strips._allocate, transpose.Strips.free
    monkeypatch.setattr(transpose.Strips, "_allocate", allocate)
    monkeypatch.setattr(transpose.Strips, "free", free)
    monkeypatch.setattr(loads, "solve_contact", fails)
    monkeypatch.setattr(tempfile, "tempdir", str(shared_tmp_path))
    with pytest.raises(SolverError, match="does not converge"):
        pgfmd.run(JOB, comm=comm)
    comm.Barrier()
    assert not held and not list(shared_tmp_path.iterdir())


@pytest.mark.breadth
def test_type_checkers_and_editors_know_the_options_of_solve(tmp_path, monkeypatch):
    """`pgfmd.solve` of a number is a contact, of a list an iterator; an option that does not exist is an error."""
    from mypy import api as mypy

    monkeypatch.chdir(ROOT)
    script = tmp_path / "script.py"
    script.write_text(
        "import numpy as np\nimport pgfmd\nfrom pgfmd.observables.contact import Contact\nz = np.zeros((4, 4))\n"
        "one: Contact = pgfmd.solve(z, contact_area=0.1)\ntwo: Contact = pgfmd.solve(z, contact_area=[0.1])\n"
        "pgfmd.solve(z, 0.1, tolerence=1e-3)\n"
    )
    found, _, _ = mypy.run([str(script), "--cache-dir", str(tmp_path)])
    wrong = [line for line in found.splitlines() if "script.py" in line and ": error" in line]
    assert {line.split(":")[1] for line in wrong} == {"6", "7"}
    assert "tolerence" in found
