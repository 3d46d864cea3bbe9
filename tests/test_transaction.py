"""Results that replace others: whatever the instant at which a run is killed, the folder holds the old or the new ones.

The kill is played: from a certain change of the folder on (a file put in place, renamed, removed, a folder made or
removed) nothing is carried out any more, neither by the run nor by what cleans up after it.
"""

import os
from contextlib import contextmanager

import h5py
import numpy as np
import pytest
from conftest import broad, contents
from mpi4py import MPI

from pgfmd.application.files import Form, holder, read_sums, sha256
from pgfmd.application.loads import Checkpoints
from pgfmd.application.machine import Origin
from pgfmd.application.results import Results
from pgfmd.application.writer import ResultWriter
from pgfmd.errors import InputError, SolverError, Stopped
from pgfmd.parallel.collectives import slab

SHAPE = (7, 4)
FIELD = np.arange(28.0).reshape(SHAPE)
CHANGES = ("replace", "unlink", "mkdir", "rmdir")
FILES = ["observables.h5", "fields.h5", "fields.vtkhdf"]


class Killed(BaseException):
    """The process is gone."""


@contextmanager
def killed_at(monkeypatch, number: int):
    """From the change of that number on, each raises Killed."""
    left = iter(range(number))

    def last_changes(original):
        def change(*arguments, **keywords):
            if next(left, None) is None:
                raise Killed
            return original(*arguments, **keywords)

        return change

    with monkeypatch.context() as patch:
        for name in CHANGES:
            patch.setattr(os, name, last_changes(getattr(os, name)))
        yield


def run(folder, factor: float, mode: str, fields: bool = True, comm=MPI.COMM_SELF, stop=None) -> None:
    """A run of two loads with checkpoints, all numbers `factor` times those of the first; `stop`: how it may end."""
    rows = slab(SHAPE[0], comm.size, comm.rank)
    origin, form = Origin(f"# {factor}", f"factor = {factor}", 2), Form(SHAPE, SHAPE, rows)
    writer = None
    try:
        with ResultWriter(comm, folder, origin, form, mode) as writer:
            checkpoints = Checkpoints(comm, writer.fields_folder, form, origin.effective_toml)
            writer.begin()
            writer.write_heights(factor * FIELD[rows])
            for index in writer.pending:
                checkpoints.save(index, factor * FIELD[rows])
                checkpoints.save(index, factor * FIELD[rows])
                if stop is not None:
                    raise stop
                written = {"pressure": (index + 1) * factor * FIELD[rows]} if fields else {}
                writer.write_load(index, {"mean_pressure": factor * (index + 1)}, None, written)
                checkpoints.remove()
            writer.finish()
    finally:
        if writer is not None and writer._lock is not None:  # the kernel would free the lock of a killed process
            os.close(writer._lock._handle)


def factor_in(folder) -> float:
    """Of which run the results are; fails if they are a mixture, or incomplete beyond what their run says."""
    read = Results(folder)
    assert len(read) in (1, 2)
    factor = float(read.loads["mean_pressure"][0])
    assert read.job == {"factor": factor} and read.provenance["job_toml"] == f"# {factor}"
    np.testing.assert_array_equal(read.field("height"), factor * FIELD)
    for index in range(len(read)):
        assert read.loads["mean_pressure"][index] == factor * (index + 1)
        for name in read.fields(index):
            np.testing.assert_array_equal(read.field(name, index), (index + 1) * factor * FIELD)
    links = folder / "fields.h5"
    if links.exists():  # as h5py shows it to whoever knows nothing of this program
        with h5py.File(links, "r") as file:
            np.testing.assert_array_equal(file["height"][:], factor * FIELD)
            for index in range(len(read)):
                for name in read.fields(index):
                    np.testing.assert_array_equal(file[f"load_{index:04}/{name}"][:], (index + 1) * factor * FIELD)
                    np.testing.assert_array_equal(file[name][index], (index + 1) * factor * FIELD)
    if (folder / "fields.vtkhdf").exists():
        with h5py.File(folder / "fields.vtkhdf", "r") as file:
            for images in file["VTKHDF/PointData"].values():
                first = images[0] if images.ndim == 3 else images[:]
                np.testing.assert_array_equal(first, factor * FIELD)
    for name, digest in read_sums(folder).items():  # every line is true at every instant
        assert not (folder / name).exists() or digest == sha256(folder / name)
    return factor


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """What is on the disk, and when, is not what is tested here."""
    monkeypatch.setattr(os, "fsync", lambda handle: None)


@pytest.mark.parametrize(
    ("fields", "repeated", "stride"), broad([(True, 1, 3), (True, 1, 1), (False, 1, 1), (True, 2, 1)])
)
def test_old_or_new_at_every_instant(tmp_path, monkeypatch, fields, repeated, stride):
    """A run with --overwrite killed at each change of the folder in turn, or one in `stride`: old before one instant,
    new after.  The run is repeated, killed or not, and ends with the new results and nothing else, in either folder of
    fields; what every second kill leaves is continued before."""
    found, number = [], 0
    while True:
        folder = tmp_path / str(number)
        for turn in range(repeated):
            run(folder, 1.0 + turn, "overwrite", fields)
        old = float(repeated)
        with killed_at(monkeypatch, number):
            try:
                run(folder, 9.0, "overwrite", fields)
                break
            except Killed:
                pass
        found.append(factor_in(folder))
        assert found[-1] in (old, 9.0)
        if (number + repeated + fields) % 2 == 0:  # what is there can be continued
            run(folder, found[-1], "restart", fields)
            assert factor_in(folder) == found[-1] and Results(folder).status == "complete"
        run(folder, 9.0, "overwrite", fields)
        assert factor_in(folder) == 9.0
        left = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
        where = Results(folder).provenance["fields_folder"]
        loads = {f"{where}/load_{index:04}.h5" for index in range(2) if fields}
        both = {"observables.h5", "fields.h5", "fields.vtkhdf", "SHA256SUMS"}
        assert left == both | loads | {f"{where}/height.h5"}
        number += stride
    assert number > 20 and found == sorted(found, key=lambda factor: factor == 9.0) and {old, 9.0} == set(found)


def test_a_run_that_fails_leaves_the_old_results(tmp_path):
    """Whatever ends it before its first load is written: byte for byte."""
    folder = tmp_path / "out"
    run(folder, 1.0, "new")
    before = contents(folder)
    for error in (InputError("not reachable"), SolverError("no descent"), OSError(28, "full"), ValueError("alone")):
        with pytest.raises(type(error)):
            run(folder, 2.0, "overwrite", stop=error)
        assert contents(folder) == before


def test_the_first_error_is_the_one_that_is_raised(tmp_path, monkeypatch):
    """What then fails, whatever it is, while the end of the run is written, hides neither it nor holds the folder."""

    def fails(*_):
        raise RuntimeError("cannot be noted")

    monkeypatch.setattr(ResultWriter, "_note_failure", fails)
    with pytest.raises(SolverError, match="no descent"):
        run(tmp_path / "out", 1.0, "new", stop=SolverError("no descent"))
    assert holder(tmp_path / "out") is None


def test_a_run_that_is_stopped_goes_on_from_its_checkpoint(tmp_path):
    """With --overwrite again; the old results and their checkpoint are not touched by it."""
    folder = tmp_path / "out"
    with pytest.raises(Stopped):
        run(folder, 1.0, "new", stop=Stopped())
    before = contents(folder)
    with pytest.raises(Stopped):
        run(folder, 2.0, "overwrite", stop=Stopped())
    after = contents(folder)
    assert {path: after[path] for path in before} == before
    assert {str(path.relative_to(folder)) for path in after.keys() - before.keys()} == {"fields-2/checkpoint.h5"}
    for job, fields in ((1.0, "fields"), (2.0, "fields-2")):
        form = Form(SHAPE, SHAPE, slice(0, 7))
        checkpoints = Checkpoints(MPI.COMM_SELF, folder / fields, form, f"factor = {job}")
        np.testing.assert_array_equal(checkpoints.load(0), job * FIELD)


@pytest.mark.mpi
@pytest.mark.parametrize("name", [*FILES, "fields/load_0001.h5"])
@pytest.mark.parametrize("content", ["text", "hdf5"])
def test_foreign_files_are_refused(comm, shared_tmp_path, name, content):
    """A file of somebody else where one is to be written is named in one line; nothing is touched."""
    folder = shared_tmp_path / "out"
    if comm.rank == 0:
        (folder / "fields").mkdir(parents=True)
        if content == "text":
            (folder / name).write_text("not yours")
        else:
            with h5py.File(folder / name, "w") as file:
                file["data"] = 1
        before = (folder / name).read_bytes()
    comm.Barrier()
    for mode in ("overwrite", "restart"):
        with pytest.raises(InputError, match=f"{name}: was not written by pgfmd|{name}: cannot be continued"):
            run(folder, 1.0, mode, comm=comm)
        comm.Barrier()
    if comm.rank == 0:
        assert (folder / name).read_bytes() == before
        assert sorted(path.name for path in folder.rglob("*") if path.is_file()) == [name.rpartition("/")[2]]


@pytest.mark.mpi
def test_foreign_files_stay(comm, shared_tmp_path):
    """Those that are in nobody's way, whatever their name ends in, are there after --overwrite and --restart."""
    folder = shared_tmp_path / "out"
    run(folder, 1.0, "new", comm=comm)
    foreign = [folder / name for name in ("STOP", "notes.h5", "fields/mine.h5", "fields/load_0000.h5.bak")]
    if comm.rank == 0:
        for path in foreign:
            path.write_text("not yours")
    comm.Barrier()
    for factor, mode in ((2.0, "overwrite"), (2.0, "restart"), (3.0, "overwrite")):
        run(folder, factor, mode, comm=comm)
        comm.Barrier()
        assert factor_in(folder) == factor and all(path.read_text() == "not yours" for path in foreign)
        comm.Barrier()


@pytest.mark.parametrize("name", FILES)
def test_own_files_are_known_though_damaged(tmp_path, name):
    """A file of this program that was cut short may be replaced."""
    folder = tmp_path / "out"
    with pytest.raises(Stopped):
        run(folder, 1.0, "new", stop=Stopped())
    path = folder / name
    path.write_bytes(path.read_bytes()[:-50])
    run(folder, 2.0, "overwrite")
    assert factor_in(folder) == 2.0


@pytest.mark.parametrize("mode", ["overwrite", "restart"])
def test_a_failure_is_not_that_of_the_next_run(tmp_path, mode):
    """While another run goes on in the folder, and when it is complete, nothing says why the one before it failed."""
    folder = tmp_path / "out"
    said = []
    with pytest.raises(OSError, match="full"):
        run(folder, 1.0, "new", stop=OSError(28, "full"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Checkpoints, "remove", lambda self: said.append(Results(folder).provenance))
        run(folder, 1.0, mode)
    assert len(said) == 2 and not any("error" in each for each in (*said, Results(folder).provenance)), said
    assert Results(folder).status == "complete"
