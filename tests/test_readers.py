"""Result files in other programs: xarray and netCDF name every axis, VTK (so ParaView) sees images in time, h5py and
h5grove (which serves h5web in JupyterLab) read every dataset.

The grid is rectangular, with other spacings along x than along y, so that no axis can stand for another.
"""

import h5py
import numpy as np
import pytest
from job_texts import EVERY_OBSERVABLE, rough_job

from pgfmd.application import job
from pgfmd.application.results import Results
from pgfmd.application.simulate import simulate

NX, NY, LENGTHS = 20, 12, (10.0, 3.0)


def text_of(precision: str) -> str:
    """A job that writes everything."""
    output = {"fields": ["height", "pressure", "gap", "labels"], "observables": EVERY_OBSERVABLE}
    output |= {"length_unit": "µm", "pressure_unit": "GPa", "precision": precision}
    load, grid = {"pressure": [0.002, 0.01, 0.02]}, {"length": LENGTHS}
    return rough_job([NX, NY], {"lambda_s": 4.0}, load=load, output=output, grid=grid)


NAMES = ("pressure", "gap", "labels")


@pytest.fixture(scope="module", params=["float64", "float32"])
def run(request, tmp_path_factory):
    """Results of three loads with every field and observable; read from another folder than that of the files."""
    from mpi4py import MPI

    folder = tmp_path_factory.mktemp("run") / "é out"
    simulate(job.parse(text_of(request.param)), MPI.COMM_SELF, folder)
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
