"""Results as NetCDF and .x3p; in other programs (xarray, VTK, h5py, h5grove); `pgfmd compare` and `pgfmd cite`."""

import json
import math

import h5py
import numpy as np
import pytest
from job_texts import EVERY_OBSERVABLE, rough_job
from mpi4py import MPI
from scipy.io import netcdf_file

import pgfmd
from pgfmd.application import job
from pgfmd.application.cli import main
from pgfmd.application.compare import Row
from pgfmd.application.export import export
from pgfmd.application.results import Results
from pgfmd.application.simulate import simulate
from pgfmd.errors import InputError

FIELDS = ["height", "pressure", "gap", "displacement"]


def solved(folder, unit="µm", fields=FIELDS, wall=None, boundary="periodic"):
    """A result folder."""
    job = {
        "grid": {"n": [24, 16], "length": [12.0, 4.0], "boundary": boundary},
        "surface": {"kind": "self-affine", "hurst": 0.8, "lambda_s": 4.0, "rms_slope": 0.1, "seed": 2},
        "solid": {"contact_modulus": 4.0},
        "load": {"pressure": [0.1, 0.3]},
        "output": {"fields": fields, "length_unit": unit, "pressure_unit": "MPa"},
    }
    return pgfmd.run(job | ({"wall": wall} if wall else {}), folder, overwrite=True)


def read(path):
    """Variables and attributes of a NetCDF 3 file."""
    with netcdf_file(path, mmap=False) as file:
        values = {name: variable[()].copy() for name, variable in file.variables.items()}
        about = {name: dict(variable._attributes) for name, variable in file.variables.items()}
        return values, about, dict(file._attributes)


@pytest.mark.parametrize("boundary", ["periodic", "open"])
@pytest.mark.parametrize("wall", [None, {"kind": "hardness", "hardness": 1.0}, {"kind": "exponential", "zeta": 0.05}],
                         ids=["hard", "hardness", "exponential"])  # fmt: skip
def test_fields_obey_the_equation_of_the_layout(tmp_path, wall, boundary):
    """gap = displacement − (heights − ⟨heights⟩) − mean_displacement, less the plastic depth; the displacement is the
    run's own field, of mean 0 or, on a patch, absolute; pressures are over the modulus; contacting points add up to the
    area: to rounding."""
    plastic = wall is not None and wall["kind"] == "hardness"
    results = solved(tmp_path / "out", wall=wall, fields=FIELDS + ["plastic_depth"] * plastic, boundary=boundary)
    paths = export(results, tmp_path / "files")
    assert [path.name for path in paths] == ["load_0000.nc", "load_0001.nc"]
    for load, path in zip(results, paths, strict=True):
        held, _, about = read(path)
        rough = held["heights"] - held["heights"].mean()
        depth = load.field("plastic_depth") if plastic else 0.0
        assert np.allclose(held["displacement"] - rough - about["mean_displacement"] + depth, held["gap"], atol=1e-13)
        assert np.allclose(held["displacement"], load.field("displacement"), rtol=0, atol=1e-13)
        assert np.array_equal(held["heights"], load.field("height"))
        assert np.allclose(held["pressure"] * 4.0, load.field("pressure"), rtol=1e-14, atol=0)
        assert held["contacting_points"].mean() == pytest.approx(load.numbers["contact_area"], rel=1e-14)
        assert about["total_contact_area"] == load.numbers["contact_area"]
        assert about["mean_pressure"] == pytest.approx(held["pressure"].mean(), rel=1e-12)
        assert ("hardness" in about) == plastic
        assert about["type"] == {"periodic": b"periodic", "open": b"nonperiodic"}[boundary]


def test_units_sizes_and_periodicity(tmp_path):
    """In each variable, in letters of ASCII; a job without a unit gives none."""
    for unit, said in (("µm", b"um"), ("length", None)):
        boundary = "open" if said else "periodic"
        held, about, top = read(export(solved(tmp_path / "out", unit, boundary=boundary), tmp_path / "files")[0])
        assert [about[axis]["length"] for axis in "xy"] == [12.0, 4.0]
        assert [about[axis]["periodic"] for axis in "xy"] == 2 * [boundary == "periodic"]
        assert [about[name].get("unit") for name in ("x", "y", "heights", "gap", "displacement")] == 5 * [said]
        assert about["pressure"]["unit"] == b"E*" and top["pressure_unit"] == b"MPa"
        assert np.array_equal(held["x"], 0.5 * np.arange(24)) and np.array_equal(held["y"], 0.25 * np.arange(16))


@pytest.mark.parametrize("form", ["nc", "x3p"])
def test_surface_topography_reads_them(tmp_path, form):
    """The same heights, size and unit as in the run, to rounding; a job on that file solves the same contact."""
    package = pytest.importorskip("SurfaceTopography", reason="tools/setup.sh test")
    results = solved(tmp_path / "out")
    path = export(results, tmp_path / "files", form)[0]
    found = package.read_topography(str(path))
    found = found.to_unit("µm")
    assert found.physical_sizes == pytest.approx((12.0, 4.0), rel=1e-12)
    assert np.allclose(found.heights(), results.field("height"), rtol=1e-14, atol=0)
    assert found.is_periodic == (form == "nc")  # .x3p cannot say it
    again = {"surface": {"kind": "file", "path": str(path)}, "solid": {"contact_modulus": 4.0}}
    again |= {"load": {"pressure": 0.1}, "output": {"length_unit": "µm"}}
    area = pgfmd.run(again)[0].numbers["contact_area"]
    assert area == results[0].numbers["contact_area"]


def test_the_command(tmp_path, capsys):
    """It names the files, seeds of an ensemble in folders of their own; missing fields and units are one line."""
    solved(tmp_path / "out")
    (tmp_path / "file").touch()
    assert main(["export", str(tmp_path / "out"), "--output", str(tmp_path / "file")]) == 1
    assert capsys.readouterr().err == f"pgfmd: error: [Errno 17] File exists: '{tmp_path / 'file'}'\n"
    assert main(["export", str(tmp_path / "out")]) == 0
    assert capsys.readouterr().out.split() == [str(tmp_path / "out" / "export" / f"load_000{i}.nc") for i in (0, 1)]
    solved(tmp_path / "out", fields=["pressure"])
    assert main(["export", str(tmp_path / "out")]) == 2
    assert "has no field height, gap: write it (fields under [output])" in capsys.readouterr().err
    pytest.importorskip("SurfaceTopography", reason="tools/setup.sh test")
    with pytest.raises(InputError, match=r"\.x3p is in metres"):
        export(solved(tmp_path / "out", "length"), tmp_path / "files", "x3p")


JOB = {
    "grid": {"n": 32},
    "surface": {"kind": "self-affine", "hurst": 0.8, "lambda_s": 8.0, "rms_slope": 0.1},
    "solid": {"contact_modulus": 1.0},
    "load": {"pressure": [0.005, 0.01]},
    "output": {"observables": ["discretisation"]},
}


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """The same surface on the grid and on one of twice the points, and three seeds."""
    top = tmp_path_factory.mktemp("compare")
    pgfmd.run(JOB, top / "coarse")
    pgfmd.run(JOB | {"grid": {"n": 32, "refine": 2}, "load": {"pressure": [0.02, 0.01]}}, top / "fine")
    pgfmd.run(JOB | {"surface": JOB["surface"] | {"seed": [1, 2, 3]}}, top / "seeds")
    return top


def rows(capsys, *arguments):
    assert main(["compare", *map(str, arguments), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_loads_are_paired_by_their_target(folders, capsys):
    """Only p̄ = .01 stands in both, as load 1; the difference and the joint error are those of the tables."""
    found = rows(capsys, folders / "coarse", folders / "fine")
    one, two = (pgfmd.Results(folders / name)[1].numbers for name in ("coarse", "fine"))
    assert {row["load"] for row in found["numbers"]} == {1}
    gap = next(row for row in found["numbers"] if row["name"] == "mean_gap")
    assert gap["difference"] == two["mean_gap"] - one["mean_gap"]
    assert gap["error"] == math.hypot(one["mean_gap_error"], two["mean_gap_error"])
    assert any("grid.refine: 1 → 2" in line for line in found["differs"])
    assert any("2 loads of one run have no partner" in line for line in found["differs"])


def test_a_ratio_needs_an_error():
    """Difference over the joint error; NaN where no error is known."""
    row = {"run": "a", "load": 0, "target": 0.01, "name": "kappa", "first": 2.0, "other": 2.5}
    assert Row(**row, first_error=0.3, other_error=0.4).ratio == pytest.approx(1.0)
    assert math.isnan(Row(**row, first_error=math.nan, other_error=math.nan).ratio)


def test_an_ensemble_is_compared_by_its_mean(folders, capsys):
    """The other value is the mean over the seeds, its error the standard error."""
    found = rows(capsys, folders / "coarse", folders / "seeds")
    mean = pgfmd.Ensemble(folders / "seeds").mean()
    row = next(row for row in found["numbers"] if row["name"] == "mean_gap" and row["load"] == 0)
    assert row["other"] == pytest.approx(mean["mean_gap"][0], rel=1e-14)
    assert row["other_error"] == pytest.approx(mean["mean_gap_error"][0], rel=1e-14)


def test_text_and_csv_show_each_number(folders, capsys):
    """A line for each number that differs, and what distinguishes the jobs; the CSV has a row for each number."""
    assert main(["compare", str(folders / "coarse"), str(folders / "fine")]) == 0
    text = capsys.readouterr().out
    assert "grid.refine: 1 → 2" in text and "mean_gap" in text and "target" not in text
    assert main(["compare", str(folders / "coarse"), str(folders / "fine"), "--csv"]) == 0
    lines = capsys.readouterr().out.split()
    assert lines[0].startswith("run,load,target,name,first") and len(lines) > 5


def test_what_cannot_be_compared_is_refused(folders, capsys):
    """One folder, another kind of load, or no load in common: one line, exit code 2."""
    pgfmd.run(JOB | {"load": {"contact_area": [0.1]}}, folders / "area")
    pgfmd.run(JOB | {"load": {"pressure": [0.03]}}, folders / "other")
    capsys.readouterr()  # the log, if a command in this process has opened it
    for others, words in (((), "two result folders"), (("area",), "imposes"), (("other",), "same target")):
        assert main(["compare", *(str(folders / name) for name in ("coarse", *others))]) == 2
        message = capsys.readouterr().err
        assert words in message and message.count("\n") == 1


def test_cite_names_the_version_and_the_sources(folders, capsys):
    """The version and commit that ran; the surface's paper; nothing that the job did not use."""
    assert main(["cite", str(folders / "coarse")]) == 0
    text = capsys.readouterr().out
    commit = pgfmd.Results(folders / "coarse").provenance["commit"]
    assert commit in text and "10.1088/0953-8984/20/35/354013" in text
    assert "Barber" not in text and text.count("{") == text.count("}")


NX, NY, LENGTHS = 20, 12, (10.0, 3.0)  # no axis can stand for another


NAMES = ("pressure", "gap", "labels")


@pytest.fixture(scope="module", params=["float64", "float32"])
def run(request, tmp_path_factory):
    """Results of three loads with every field and observable; read from another folder than that of the files."""
    folder = tmp_path_factory.mktemp("run") / "é out"
    output = {"fields": ["height", "pressure", "gap", "labels"], "observables": EVERY_OBSERVABLE}
    output |= {"length_unit": "µm", "pressure_unit": "GPa", "precision": request.param}
    load, grid = {"pressure": [0.002, 0.01, 0.02]}, {"length": LENGTHS}
    text = rough_job([NX, NY], {"lambda_s": 4.0}, load=load, output=output, grid=grid)
    simulate(job.parse(text), MPI.COMM_SELF, folder)
    return Results(folder)


def _refused(status: int, message: str):
    pytest.fail(f"{status}: {message}")


def visited(file) -> dict[str, h5py.Dataset]:
    found = {}
    file.visititems(lambda name, entry: found.update({name: entry}) if isinstance(entry, h5py.Dataset) else None)
    return found


@pytest.fixture
def xarray(run):
    """xarray with one of its two readers of netCDF-4 as the default: another one for each precision."""
    engine = {"float64": "h5netcdf", "float32": "netcdf4"}[run.job["output"]["precision"]]
    found = pytest.importorskip("xarray", reason="tools/setup.sh test")
    pytest.importorskip({"netcdf4": "netCDF4"}.get(engine, engine), reason="tools/setup.sh test")
    with found.set_options(netcdf_engine_order=[engine]):
        yield found


def test_xarray_names_dimensions_and_coordinates(run, xarray):
    """`xr.open_dataset("fields.h5")`: height (x, y), the others (load, x, y), coordinates of grid points in µm."""
    with xarray.open_dataset(run.directory / "fields.h5") as fields:
        assert fields.height.dims == ("x", "y") and {fields[name].dims for name in NAMES} == {("load", "x", "y")}
        np.testing.assert_allclose(fields.x, np.arange(NX) * (LENGTHS[0] / NX), rtol=1e-15)
        np.testing.assert_allclose(fields.y, np.arange(NY) * (LENGTHS[1] / NY), rtol=1e-15)
        assert fields["load"].values.tolist() == [0, 1, 2]
        assert (fields.pressure.units, fields.gap.units, fields.x.units) == ("GPa", "µm", "µm")
        np.testing.assert_array_equal(fields.height, run.field("height"))
        for index in range(3):
            for name in NAMES:
                np.testing.assert_array_equal(fields[name].sel(load=index), run.field(name, index))
        nearest = fields.pressure.sel(load=1, x=2.6, y=0.7, method="nearest")
        assert float(nearest) == run.field("pressure", 1)[5, 3]


def test_xarray_opens_every_group(run, xarray):
    """As a tree: each load of fields.h5 inherits x and y; of observables.h5 no axis is without a name."""
    with xarray.open_datatree(run.directory / "fields.h5") as tree:
        assert tree["load_0001"].coords.keys() >= {"x", "y"}
        np.testing.assert_array_equal(tree["load_0001/gap"], run.field("gap", 1))
    with xarray.open_datatree(run.directory / "observables.h5") as tree:
        for group in tree.subtree:
            assert not [name for name in group.dims if str(name).startswith("phony")], group.path
        np.testing.assert_array_equal(tree["loads/mean_pressure"], run.loads["mean_pressure"])
        assert tree["loads/kappa"].dims == ("load",)
        spectrum = tree["load_0002/stress_spectrum"]
        np.testing.assert_array_equal(spectrum["value"], run.load(2)["stress_spectrum"]["value"])
    for name in ("height", "load_0001"):
        with xarray.open_dataset(run.directory / "fields" / f"{name}.h5") as single:
            assert dict(single.sizes) == {"x": NX, "y": NY}


def test_vtk_reads_images_in_time(run):
    """Points lie where the grid's are, whatever the order in memory; each step has its own fields."""
    pytest.importorskip("vtkmodules", reason="tools/setup.sh test")
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOHDF import vtkHDFReader

    reader = vtkHDFReader()
    path = str(run.directory / "fields.vtkhdf")
    assert reader.CanReadFile(path)
    reader.SetFileName(path)
    reader.UpdateInformation()
    assert reader.GetNumberOfSteps() == 3
    for index in range(3):
        reader.SetStep(index)
        reader.Update()
        image = reader.GetOutput()
        points = np.array([image.GetPoint(number) for number in range(image.GetNumberOfPoints())])
        i, j = (np.rint(points[:, axis] * count / length).astype(int)
                for axis, count, length in zip((0, 1), (NX, NY), LENGTHS, strict=True))  # fmt: skip
        np.testing.assert_allclose(points, np.stack([i * LENGTHS[0] / NX, j * LENGTHS[1] / NY, 0 * i], 1), atol=1e-12)
        fields = {name: run.field(name, index) for name in NAMES} | {"height": run.field("height")}
        for name, expected in fields.items():
            values = vtk_to_numpy(image.GetPointData().GetArray(name))
            np.testing.assert_array_equal(values, expected[i, j])


def test_h5py_reads_every_dataset(run):
    """All of them say unit and description, all axes of fields have scales, and no link leads nowhere."""
    for path in sorted(run.directory.rglob("*.h5")) + [run.directory / "fields.vtkhdf"]:
        with h5py.File(path, "r") as file:
            found = visited(file)
            assert found
            for name, dataset in found.items():
                assert dataset[()] is not None
                if path.suffix == ".h5":
                    assert "units" in dataset.attrs and "description" in dataset.attrs, name
                    assert all(len(axis) == 1 for axis in dataset.dims) or dataset.is_scale, name


def test_h5web_s_server_reads_every_dataset(run):
    """h5grove, behind h5web in JupyterLab: metadata and numbers of each dataset of fields.h5 and observables.h5."""
    content = pytest.importorskip("h5grove.content", reason="tools/setup.sh test")
    for name in ("fields.h5", "observables.h5"):
        with h5py.File(run.directory / name, "r") as file:
            for key, dataset in visited(file).items():
                with content.get_content_from_file(run.directory / name, key, _refused) as served:
                    assert served.metadata()["shape"] == dataset.shape
                    np.testing.assert_array_equal(served.data(), dataset[()])


def test_a_file_of_fields_that_is_gone_reads_as_nan(run, tmp_path):
    """HDF5 raises no error then; numbers must not look like results."""
    import shutil

    folder = shutil.copytree(run.directory, tmp_path / "copy")
    (folder / "fields" / "load_0001.h5").unlink()
    with h5py.File(folder / "fields.h5", "r") as file:
        assert np.isnan(file["pressure"][1]).all() and np.isnan(file["load_0001/gap"][:]).all()
        assert (file["labels"][1] == -1).all() and np.isfinite(file["pressure"][[0, 2]]).all()
