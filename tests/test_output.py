"""Result folders: what was written is what is read, on any rank count, and nothing half-written ever looks whole."""

import errno
import fcntl
import os
import tomllib
import warnings
import zipfile
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np
import pytest
from conftest import once, python
from job_texts import SOLID
from mpi4py import MPI

from pgfmd.application import files, hdf5_slabs, job
from pgfmd.application import writer as output
from pgfmd.application.field_files import FieldFiles
from pgfmd.application.info import damage, summary
from pgfmd.application.machine import Origin
from pgfmd.application.results import Results
from pgfmd.errors import InputError
from pgfmd.observables import schema
from pgfmd.observables.observable_kinds import LAYOUT
from pgfmd.parallel.collectives import slab

pytestmark = [pytest.mark.mpi, pytest.mark.uneven]

SHAPE, LENGTHS = (13, 6), (26.0, 6.0)  # 13 rows: uneven slabs on 2, 3 and 4 ranks
FIELD = np.arange(78.0).reshape(SHAPE) ** 1.5
JOB = '[grid]\nn = [13, 6]\n[surface]\nkind = "sinusoid"\namplitude = 1 # µm\n[load]\npressure = [0.1, 0.2, 0.3]\n'
JOB += SOLID
HISTOGRAM = {
    "pressure_histogram": {
        "edges": np.arange(4.0), "center": np.arange(3) + 0.5, "density": np.array([0.5, 0.25, 0.25]),
    }
}  # fmt: skip


@contextmanager
def writer(comm, folder, mode="new", **options):
    """A writer of a 13 × 6 grid; all ranks wait for each other before and, unless an error ends it, after."""
    comm.Barrier()
    form = output.Form(SHAPE, LENGTHS, slab(SHAPE[0], comm.size, comm.rank), groups=LAYOUT, **options)
    with output.ResultWriter(comm, folder, Origin(JOB, job.as_toml(job.parse(JOB)), 3), form, mode) as result:
        yield result
    comm.Barrier()


def refused(comm, folder, words, mode="new"):
    """A writer is refused in these words."""
    with pytest.raises(InputError, match=words), writer(comm, folder, mode):
        pass


def write_load(result, index, factor=1.0):
    """One load with recognisable numbers."""
    local = FIELD[result.form.rows] * factor
    row = {"mean_pressure": 0.1 * factor, "contact_area": 0.25, "iterations": 7}
    result.write_load(index, row, HISTOGRAM, {"pressure": local, "gap": -local})


@pytest.fixture(params=["as built", "in place"])
def transport(request, monkeypatch):
    """Both ways to the file: with MPI in h5py (if it has it) and past HDF5; blocks so small that there are many."""
    if request.param == "in place":
        monkeypatch.setattr(hdf5_slabs, "is_collective", lambda comm: False)
    monkeypatch.setattr(files, "BLOCK_BYTES", 100)
    monkeypatch.setattr(hdf5_slabs, "COLLECTIVE_BYTES", 48)  # one row: on some ranks more pieces than rows
    return request.param


def test_what_is_written_is_read(comm, shared_tmp_path, transport):
    """Fields, rows and groups come back bit for bit from any rank count and either transport."""
    folder = shared_tmp_path / "a folder é"
    with writer(comm, folder) as result:
        result.write_heights(FIELD[result.form.rows])
        for index in range(3):
            write_load(result, index, index + 1.0)
        result.finish({"solve": 1.5})
    read = Results(folder)
    assert (len(read), read.status, read.phases, read.shape, read.lengths) == (
        3,
        "complete",
        {"solve": 1.5},
        SHAPE,
        LENGTHS,
    )
    np.testing.assert_array_equal(read.field("height"), FIELD)
    np.testing.assert_array_equal(read.field("pressure", -1), 3 * FIELD)
    np.testing.assert_array_equal(read.field("gap", 1, slice(4, 9)), -2 * FIELD[4:9])
    np.testing.assert_array_equal(np.concatenate([rows for _, rows in read.blocks("gap", 0, size=100)]), -FIELD)
    np.testing.assert_array_equal(read.loads["mean_pressure"], 0.1 * np.array([1.0, 2.0, 3.0]))
    assert np.isnan(read.loads["kappa"]).all() and read.loads["iterations"].tolist() == [7, 7, 7]
    assert list(read.load(2)) == ["pressure_histogram"]
    np.testing.assert_array_equal(read.load(2)["pressure_histogram"]["density"], [0.5, 0.25, 0.25])
    assert read.fields() == ["height"] and read.fields(0) == ["gap", "pressure"]
    assert read.job == tomllib.loads(job.as_toml(job.parse(JOB))) and read.provenance["job_toml"] == JOB
    assert read.provenance["ranks"] == comm.size
    assert "3 of 3 completed" in summary(read)


def test_files_are_plain_hdf5(comm, shared_tmp_path):
    """The documented layout, opened by h5py alone: links resolve; all say their unit, description and origin."""
    with writer(comm, shared_tmp_path / "out", length_unit="µm", pressure_unit="GPa") as result:
        result.write_heights(FIELD[result.form.rows])
        write_load(result, 0)
    with h5py.File(shared_tmp_path / "out" / "fields.h5", "r") as file:
        np.testing.assert_array_equal(file["load_0000/pressure"][:], FIELD)
        attributes = dict(file["load_0000/pressure"].attrs)
        assert attributes["units"] == "GPa" and attributes["description"] == schema.FIELDS["pressure"].description
        assert file["height"].attrs["units"] == "µm"
        assert file["height"].chunks is None
    with h5py.File(shared_tmp_path / "out" / "observables.h5", "r") as file:
        assert list(file["loads"]) == sorted(["load", *schema.LOADS, *LAYOUT["loads"]])
        assert file["load_0000/pressure_histogram/density"].attrs["units"] == "1/(GPa)"
        assert file["loads/elastic_energy"].attrs["units"] == "GPa*µm"
        assert file.attrs["format_version"] == files.FORMAT_VERSION and "HDF5" in file.attrs["libraries"]
        tomllib.loads(file.attrs["effective_toml"])


def test_axes_have_names_and_coordinates(comm, shared_tmp_path):
    """Axes are HDF5 dimension scales, as netCDF readers and xarray need them: x and y of fields, bins, loads."""
    with writer(comm, shared_tmp_path / "out", length_unit="µm") as result:
        for index in range(2):
            write_load(result, index)
    with h5py.File(shared_tmp_path / "out" / "fields" / "load_0001.h5", "r") as file:
        for name in ("pressure", "gap"):
            x, y = (axis[0] for axis in file[name].dims)
            np.testing.assert_array_equal(x, np.arange(13) * 2.0)
            np.testing.assert_array_equal(y, np.arange(6) * 1.0)
            assert (x.name, y.name, x.attrs["units"]) == ("/x", "/y", "µm")
        assert file.attrs["software"] == "pgfmd" and file.attrs["format_version"] == files.FORMAT_VERSION
    with h5py.File(shared_tmp_path / "out" / "observables.h5", "r") as file:
        group = file["load_0001/pressure_histogram"]
        assert group["density"].dims[0][0] == group["center"] and group["edges"].is_scale
        assert file["loads/kappa"].dims[0][0] == file["loads/load"] and file["loads/load"][:].tolist() == [0, 1]


def test_single_precision_and_integers(comm, shared_tmp_path, transport):
    """Real fields are rounded once to the precision asked for; labels stay integers."""
    with writer(comm, shared_tmp_path / "out", precision="float32") as result:
        labels = np.arange(78, dtype=np.int32).reshape(SHAPE)
        result.write_load(0, {}, None, {"gap": FIELD[result.form.rows], "labels": labels[result.form.rows]})
    read = Results(shared_tmp_path / "out")
    assert read.field("gap", 0).dtype == np.float32 and read.field("labels", 0).dtype == np.int32
    np.testing.assert_array_equal(read.field("gap", 0), FIELD.astype(np.float32))
    np.testing.assert_array_equal(read.field("labels", 0), labels)


@pytest.mark.parametrize("scale", [1e-300, 1e-60, 1e-38, 1e38, 1e60])
def test_single_precision_never_loses_a_field(comm, shared_tmp_path, transport, scale):
    """A field whose largest value, on any rank, is out of float32's range stays float64; others are rounded."""
    field, small = FIELD * (scale / np.abs(FIELD).max()), FIELD * 1e-10
    with warnings.catch_warnings(), writer(comm, shared_tmp_path / "out", precision="float32") as result:
        warnings.simplefilter("error")
        result.write_load(0, {}, None, {"gap": field[result.form.rows], "pressure": small[result.form.rows]})
    read = Results(shared_tmp_path / "out")
    assert np.abs(read.field("gap", 0) / field - 1)[field != 0].max() < (1e-7 if scale == 1e38 else 1e-15)
    assert read.field("pressure", 0).dtype == np.float32


def test_long_job_text(comm, shared_tmp_path):
    """A job text beyond the 64 KiB of HDF5's compact attributes is kept whole."""
    text = JOB + "# " + 100_000 * "x"
    layout = output.Form(SHAPE, LENGTHS, slab(13, comm.size, comm.rank))
    with output.ResultWriter(comm, shared_tmp_path / "out", Origin(text, text), layout) as result:
        result.begin()
    assert Results(shared_tmp_path / "out").provenance["job_toml"] == text


def test_results_are_not_replaced_unasked(comm, shared_tmp_path):
    """Existing results are refused, and live on until a run that may replace them has completed its first load."""
    folder = shared_tmp_path / "out"
    with writer(comm, folder) as result:
        write_load(result, 0)
    refused(comm, folder, "holds results already.*--overwrite")
    with writer(comm, folder, mode="overwrite"):
        pass
    np.testing.assert_array_equal(Results(folder).field("pressure", 0), FIELD)
    with writer(comm, folder, mode="overwrite") as result:
        result.write_heights(-FIELD[result.form.rows])
    np.testing.assert_array_equal(Results(folder).field("pressure", 0), FIELD)
    with writer(comm, folder, mode="overwrite") as result:
        write_load(result, 0, 2.0)
    np.testing.assert_array_equal(Results(folder).field("pressure", 0), 2 * FIELD)
    with h5py.File(folder / "fields.h5") as file:
        np.testing.assert_array_equal(file["load_0000/pressure"][:], 2 * FIELD)
    assert [path.name for path in (folder / "fields-2").iterdir()] == ["load_0000.h5"]
    assert not (folder / "fields").exists()


def test_restart_continues(comm, shared_tmp_path):
    """A restart finds the loads that are complete and adds to them; the result is that of one run."""
    folder = shared_tmp_path / "out"
    with writer(comm, folder) as result:
        write_load(result, 0)
    with writer(comm, folder, mode="restart") as result:
        assert result.completed == 1 and job.parse(result.earlier.job) == job.parse(JOB)
        write_load(result, 1, 2.0)
        result.finish()
    read = Results(folder)
    assert len(read) == 2 and read.status == "complete"
    np.testing.assert_array_equal(read.field("pressure", 0), FIELD)
    np.testing.assert_array_equal(read.field("pressure", 1), 2 * FIELD)
    with writer(comm, shared_tmp_path / "empty", mode="restart") as result:
        assert result.completed == 0 and result.earlier.job is None


def test_a_load_that_was_left_out_is_pending(comm, shared_tmp_path):
    """A run that skipped a load, which no pressure reached, and was broken off after a later one goes on with it."""
    folder = shared_tmp_path / "out"
    with writer(comm, folder) as result:
        write_load(result, 1)
    assert Results(folder).fields(0) == [] and Results(folder).fields(1) == ["gap", "pressure"]
    with writer(comm, folder, mode="restart") as result:
        assert result.pending == [0, 2]
        write_load(result, 0)
        assert result.pending == [2]


def test_two_runs_in_one_folder_are_refused(comm, shared_tmp_path):
    """While a run holds its folder, another one is refused, with who holds it; afterwards it is not."""
    with writer(comm, shared_tmp_path / "out"):
        refused(comm, shared_tmp_path / "out", "another run writes here", mode="overwrite")
        comm.Barrier()
    with writer(comm, shared_tmp_path / "out", mode="overwrite"):
        pass


def test_lock_dies_with_its_process(comm, shared_tmp_path):
    """A killed run leaves no lock behind: the lock is the kernel's, the file only a name."""
    if comm.rank == 0:
        name = str(shared_tmp_path / "o")
        code = f"import os; from pgfmd.application import files; files.OutputFolder({name!r}); os._exit(9)"
        assert python(code).returncode == 9
        assert (shared_tmp_path / "o" / files.LOCK_NAME).exists()
    with writer(comm, shared_tmp_path / "o"):
        pass
    assert not (shared_tmp_path / "o" / files.LOCK_NAME).exists()


@pytest.mark.parametrize("place", ["file/out", "file", "/proc/pgfmd", "nul\0"], ids=ascii)
def test_unwritable_folder_is_refused_on_all_ranks(comm, shared_tmp_path, place):
    """A folder that cannot be made is a wrong input, on all ranks together, before anything is computed."""
    once(comm, (shared_tmp_path / "file").write_text, "not a folder")
    refused(comm, shared_tmp_path / place, "cannot be written as an output folder")
    assert [path.name for path in shared_tmp_path.iterdir()] == ["file"]


def test_a_disk_too_full_for_the_lock_holds_nothing(tmp_path, monkeypatch):
    """Refused with the reason, nothing is left, and the same process can try again."""

    def fails(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as full:
        full.setattr(os, "write", fails)
        with pytest.raises(InputError, match="cannot be written as an output folder: No space left"):
            files.OutputFolder(tmp_path / "o")
    assert not list(tmp_path.iterdir())
    files.OutputFolder(tmp_path / "o").release()


def test_nothing_written_leaves_nothing(comm, shared_tmp_path):
    """A run that fails on its input before it writes leaves no folder behind."""
    with pytest.raises(InputError, match="NaN"), writer(comm, shared_tmp_path / "a" / "b"):
        raise InputError("NaN in the heights")
    comm.Barrier()
    assert not list(shared_tmp_path.iterdir())


def test_failure_keeps_completed_loads(comm, shared_tmp_path, transport, monkeypatch):
    """A disk that fills up in the second load: OSError on all ranks, the first load whole, no trace of the second."""
    folder = shared_tmp_path / "out"

    def full(*arguments):
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match="are free"), writer(comm, folder) as result:
        write_load(result, 0)
        monkeypatch.setattr(files.os, "posix_fallocate", full)
        write_load(result, 1)
    comm.Barrier()
    read = Results(folder)
    assert len(read) == 1 and read.status == "failed" and "free" in read.provenance["error"]
    np.testing.assert_array_equal(read.field("pressure", 0), FIELD)
    assert sorted(path.name for path in (folder / "fields").iterdir()) == ["load_0000.h5"]


@pytest.mark.parametrize(("kind", "step"), [
    (files.Sums, "forget"), (files, "reserve"), (files, "commit"), (FieldFiles, "write_views"),
    (files, "revise"), (files.Sums, "note"),
])  # fmt: skip
def test_a_folder_lost_at_any_step_is_named(comm, shared_tmp_path, monkeypatch, kind, step):
    """Moved away before any step of a load: an OSError on all ranks names it; nothing is made where it was."""
    folder, original = shared_tmp_path / "out", getattr(kind, step)

    def moved_first(*arguments, **options):
        if folder.exists():
            folder.rename(shared_tmp_path / "elsewhere")
        return original(*arguments, **options)

    with pytest.raises(OSError, match=str(folder)), writer(comm, folder) as result:
        write_load(result, 0)
        comm.Barrier()
        monkeypatch.setattr(kind, step, moved_first)
        write_load(result, 1)
    comm.Barrier()
    assert not folder.exists()
    assert len(Results(shared_tmp_path / "elsewhere")) == (2 if step == "note" else 1)  # that comes last


def test_a_reader_does_not_refuse_a_run(comm, shared_tmp_path, monkeypatch):
    """Whoever asks who holds a folder has its lock for a moment; a run that begins then waits for that moment."""
    folder = shared_tmp_path / f"of rank {comm.rank}"
    folder.mkdir()
    reader = os.open(folder / files.LOCK_NAME, os.O_RDONLY | os.O_CREAT)
    fcntl.flock(reader, fcntl.LOCK_SH)
    monkeypatch.setattr(files, "sleep", lambda _: os.close(reader))
    files.OutputFolder(folder).release()


def test_large_fields_begin_on_pages(comm, shared_tmp_path, transport, monkeypatch):
    """Fields as large as `ALIGNMENT` begin at a multiple of it, and are read as they were written."""
    monkeypatch.setattr(hdf5_slabs, "ALIGNMENT", 512)
    with writer(comm, shared_tmp_path / "out") as result:
        write_load(result, 0)
    with h5py.File(shared_tmp_path / "out" / "fields" / "load_0000.h5", "r", locking=False) as file:
        assert [file[name].id.get_offset() % 512 for name in ("pressure", "gap")] == [0, 0]
    np.testing.assert_array_equal(Results(shared_tmp_path / "out").field("gap", 0), -FIELD)


@pytest.mark.parametrize("nodes", ["one node", "a node for each rank"])
def test_both_transports_write_the_same_bytes(comm, shared_tmp_path, monkeypatch, nodes):
    """HDF5 with MPI and ranks in place, on one node or on nodes in turns, write the same files byte for byte."""
    if nodes != "one node":
        monkeypatch.setattr(files, "BLOCK_BYTES", 100)
        monkeypatch.setattr(hdf5_slabs, "node_of", lambda comm: MPI.COMM_SELF)
    for name, collective in (("together", hdf5_slabs.is_collective(comm)), ("in place", False)):
        monkeypatch.setattr(hdf5_slabs, "is_collective", lambda comm, collective=collective: collective)
        with writer(comm, shared_tmp_path / name, precision="float32") as result:
            write_load(result, 0)
    found = [(shared_tmp_path / name / "fields" / "load_0000.h5").read_bytes() for name in ("together", "in place")]
    assert found[0] == found[1]


def test_error_while_writing_reaches_all_ranks(comm, shared_tmp_path, monkeypatch):
    """An I/O error of the last rank in the middle of a field: the same error everywhere, no hang, nothing left."""
    monkeypatch.setattr(hdf5_slabs, "is_collective", lambda comm: False)
    monkeypatch.setattr(files, "BLOCK_BYTES", 2**17)  # one row
    rows, shape, calls, block = slab(13, comm.size, comm.rank), (13, 2**14), [], hdf5_slabs.Field.block

    def failing(field, part):
        calls.append(part)
        if len(calls) == 2 and comm.rank == comm.size - 1:
            raise OSError(errno.EIO, "Input/output error")
        return block(field, part)

    result = output.ResultWriter(comm, shared_tmp_path / "out", Origin(), output.Form(shape, LENGTHS, rows))
    with pytest.raises((OSError, RuntimeError), match="Input/output error"), result:
        monkeypatch.setattr(hdf5_slabs.Field, "block", failing)
        result.write_load(0, {}, None, {"gap": np.zeros((rows.stop - rows.start, shape[1]))})
    comm.Barrier()
    assert len(Results(shared_tmp_path / "out")) == 0
    assert not list((shared_tmp_path / "out" / "fields").iterdir())


def test_hints_reach_mpi_io(comm, shared_tmp_path, monkeypatch):
    """Files that all ranks write are opened with the job's hints, of any characters, and are the same."""
    if not hdf5_slabs.is_collective(comm):
        pytest.skip("the ranks do not write through MPI-IO")
    given, opened, open_file = ("cb_nodes=1", "of_another=a=b;c"), [], h5py.File

    def recorded(*arguments, **options):
        file = open_file(*arguments, **options)
        if options.get("driver") == "mpio":
            opened.append(dict(file.id.get_access_plist().get_fapl_mpio()[1].items()))
        return file

    monkeypatch.setattr(hdf5_slabs.h5py, "File", recorded)
    with writer(comm, shared_tmp_path / "out", hints=given) as result:
        result.write_heights(FIELD[result.form.rows])
    assert len(opened) == 1 and {"cb_nodes": "1", "of_another": "a=b;c"}.items() <= opened[0].items()
    monkeypatch.undo()
    comm.Barrier()
    np.testing.assert_array_equal(Results(shared_tmp_path / "out").field("height"), FIELD)


def test_wrong_slab_on_one_rank(comm, shared_tmp_path):
    """A slab of the wrong shape on the last rank is an error on all ranks, not a hang in a collective write."""
    with (
        pytest.raises((ValueError, RuntimeError), match="slab of shape"),
        writer(comm, shared_tmp_path / "out") as result,
    ):
        local = FIELD[result.form.rows]
        result.write_heights(local[:-1] if comm.rank == comm.size - 1 else local)


def test_broken_off_run_reads_as_interrupted(comm, shared_tmp_path):
    """A run that was killed says so, with the loads that it completed."""
    with writer(comm, shared_tmp_path / "out") as result:
        write_load(result, 0)
        assert Results(shared_tmp_path / "out").status == "running"
        comm.Barrier()
    assert Results(shared_tmp_path / "out").status == "interrupted"
    assert "1 of 3 completed" in summary(Results(shared_tmp_path / "out"))


def test_foreign_folders_are_refused(comm, shared_tmp_path):
    """A reader says what is wrong with a folder: missing, empty, damaged, foreign, from the future."""
    mine = shared_tmp_path / f"rank {comm.rank}"
    with pytest.raises(InputError, match="no such folder"):
        Results(mine)
    mine.mkdir()
    with pytest.raises(InputError, match="holds no observables.h5"):
        Results(mine)
    (mine / "observables.h5").write_bytes(b"damaged")
    with pytest.raises(InputError, match="cannot be read"):
        Results(mine)
    with h5py.File(mine / "observables.h5", "w") as file:
        file["x"] = 1
    with pytest.raises(InputError, match="not written by pgfmd"):
        Results(mine)
    with h5py.File(mine / "observables.h5", "a") as file:
        file.attrs.update(software="pgfmd", format_version=99)
    with pytest.raises(InputError, match="format 99 is newer"):
        Results(mine)


def test_missing_fields_and_loads_are_named(comm, shared_tmp_path):
    """Asking for what is not there is answered in one line."""
    with writer(comm, shared_tmp_path / "out") as result:
        write_load(result, 0)
    read = Results(shared_tmp_path / "out")
    with pytest.raises(InputError, match="no load 1: 1 were completed"):
        read.load(1)
    with pytest.raises(InputError, match="no field height of the run"):
        read.field("height")


def test_schema_is_well_formed():
    """Every dataset of the format has a unit that formats and a description of one line."""
    for about in (about for table in (schema.LOADS, schema.FIELDS, *LAYOUT.values()) for about in table.values()):
        assert about.unit.format(length="m", pressure="Pa") and about.description.isprintable()


def unpack(comm, version, folder):
    """Unpacks a run that the program wrote in that format, on rank 0; 1: 24 × 20 points, one load."""
    if comm.rank == 0:
        with zipfile.ZipFile(Path(__file__).parent / "data" / f"format_{version}.zip") as archive:
            archive.extractall(folder)
    comm.Barrier()


def check_format_1(load, pressure, height, threshold_area):
    """The groups of that load obey the laws of the present format; rounding over 480 terms."""
    spectra = {
        "stress": pressure, "contact": (pressure > 0) * 1.0, "height": height,
        "bearing": (height > load["bearing"]["threshold"]) * 1.0,
    }  # fmt: skip
    for name, field in spectra.items():
        group = load[f"{name}_spectrum"]
        power = np.abs(np.fft.fft2(field, norm="forward")) ** 2
        kx, ky = (np.fft.fftfreq(n, 1 / n) for n in field.shape)
        q = 2 * np.pi * np.hypot(kx[:, None] / 12, ky / 10)
        inside = (q > group["edges"][0]) & (q <= group["edges"][-1])
        assert group["count"].sum() == inside.sum()
        assert np.sum(group["count"] * group["value"]) == pytest.approx(power[inside].sum(), rel=1e-11, abs=0)
    assert load["lowpass_area"].keys() == {"q", "area_corrected"}
    assert load["lowpass_area"]["area_corrected"][-1] == threshold_area


def test_format_1_is_read(comm, shared_tmp_path):
    """Results of the version before: spectra come in the present normalisation, the corrected area under its name."""
    unpack(comm, 1, shared_tmp_path)
    read = Results(shared_tmp_path)
    check_format_1(read.load(0), read.field("pressure", 0), read.field("height"), read.loads["contact_area_corrected"])


def test_format_1_is_not_continued(comm, shared_tmp_path):
    """Loads of two versions in one folder would be a mixture: that is refused; such results may be replaced."""
    unpack(comm, 1, shared_tmp_path)
    refused(comm, shared_tmp_path, "cannot be continued: it was written by pgfmd", mode="restart")
    with writer(comm, shared_tmp_path, mode="overwrite") as result:
        write_load(result, 0)
    np.testing.assert_array_equal(Results(shared_tmp_path).field("pressure", 0), FIELD)


def test_format_2_is_read(comm, shared_tmp_path):
    """Its negative gap is now a gap ≥ 0 and the plastic depth; what was made from it, and cannot be made again, NaN."""
    unpack(comm, 2, shared_tmp_path)
    with h5py.File(shared_tmp_path / "fields" / "load_0001.h5") as file:
        before = file["gap"][()]
    assert before.min() < 0
    results = Results(shared_tmp_path)
    load = results.load(1)
    assert set(results.fields(1)) == {"pressure", "gap", "plastic_depth"}
    np.testing.assert_array_equal(load.field("gap"), np.where(before > 0, before, 0))
    np.testing.assert_array_equal(load.field("plastic_depth", slice(3, 5)), np.where(before < 0, -before, 0)[3:5])
    assert np.isnan(results.loads["mean_gap"]).all() and np.isfinite(results.loads["displacement"]).all()
    assert np.isnan(load["gap_histogram"]["density"]).all() and np.isnan(load["gap_spectrum"]["value"]).all()
    assert np.isfinite(load["pressure_histogram"]["density"]).all()


def test_large_groups_have_files_of_their_own(comm, shared_tmp_path, monkeypatch):
    """They read as before; observables.h5 does not grow by them; a load whose file is damaged is solved again, results
    that replace others remove theirs, and without its file a group is refused in one line."""
    monkeypatch.setattr(files, "LARGE_TABLE", 40)
    large = {"pressure_histogram": {"edges": np.arange(1e4), "center": np.arange(9999) + 0.5, "density": np.ones(9999)}}
    folder = shared_tmp_path / "out"

    def write(result, index):
        result.write_load(index, {"mean_pressure": 0.1, "contact_area": 0.25}, large)

    with writer(comm, folder) as result:
        for index in range(2):
            write(result, index)
        result.finish()
    path = folder / "fields" / "load_0001_pressure_histogram.h5"
    assert (folder / "observables.h5").stat().st_size < 1e5 < path.stat().st_size
    table = Results(folder)[1]["pressure_histogram"]
    assert list(table) == sorted(large["pressure_histogram"])
    np.testing.assert_array_equal(table["edges"], np.arange(1e4))
    with h5py.File(folder / "observables.h5", "r") as file:
        axis = file["load_0001/pressure_histogram/density"].dims[0][0]
        assert axis.name == "/center" and axis.attrs["units"] == "pressure"
    assert files.read_sums(folder)["fields/load_0001_pressure_histogram.h5"] == files.sha256(path)
    with open(path, "rb") as held:
        fcntl.flock(held, fcntl.LOCK_SH)  # as another reader, which HDF5's locks would refuse
        assert len(Results(folder)[1]["pressure_histogram"]["center"]) == 9999 and path not in damage(Results(folder))
    once(comm, path.write_bytes, path.read_bytes()[:1000])
    assert path in damage(Results(folder))
    with writer(comm, folder, mode="restart") as result:
        assert result.pending == [1, 2]
        write(result, 1)
    np.testing.assert_array_equal(Results(folder)[1]["pressure_histogram"]["edges"], np.arange(1e4))
    once(comm, path.unlink)
    assert list(Results(folder)[1]) == ["pressure_histogram"] and "pressure_histogram" in Results(folder)[1]
    with pytest.raises(InputError, match="load_0001_pressure_histogram.h5: cannot be read: .*No such file"):
        Results(folder)[1]["pressure_histogram"]
    comm.Barrier()
    monkeypatch.setattr(files, "LARGE_TABLE", 10**6)
    with writer(comm, folder, mode="restart") as result:
        write(result, 1)
    assert path not in damage(Results(folder))
    assert [path.name for path in path.parent.iterdir()] == ["load_0000_pressure_histogram.h5"]
    comm.Barrier()
    monkeypatch.setattr(files, "LARGE_TABLE", 40)
    with writer(comm, folder, mode="overwrite") as result:
        write(result, 0)
    assert [path.name for path in (folder / "fields-2").iterdir()] == ["load_0000_pressure_histogram.h5"]
    assert not (folder / "fields").exists()
