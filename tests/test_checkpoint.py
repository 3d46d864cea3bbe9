"""Checkpoints and checksums: what is saved is what is loaded, on any rank count; what is damaged is not used."""

import errno
import hashlib
import shutil
import subprocess

import h5py
import numpy as np
import pytest
from conftest import contents, once
from job_texts import SOLID
from mpi4py import MPI

from pgfmd.application import files
from pgfmd.application import job as config
from pgfmd.application import writer as output
from pgfmd.application.info import damage
from pgfmd.application.job import parse
from pgfmd.application.loads import Checkpoints
from pgfmd.application.machine import Origin
from pgfmd.application.results import Results
from pgfmd.application.simulate import simulate
from pgfmd.errors import InputError
from pgfmd.parallel.collectives import slab

pytestmark = pytest.mark.mpi

SHAPE = (13, 6)  # 13 rows: uneven slabs on 2, 3 and 4 ranks
FIELD = np.arange(78.0).reshape(SHAPE) ** 1.5
JOB = SOLID + '[grid]\nn = [13, 6]\n[surface]\nkind = "sinusoid"\namplitude = 1\n[load]\npressure = [0.1, 0.2, 0.3]\n'


def checkpoints(comm, folder, job: str = "job") -> Checkpoints:
    """Those of a 13 × 6 grid over all ranks of `comm`."""
    return Checkpoints(comm, folder, files.Form(SHAPE, SHAPE, slab(SHAPE[0], comm.size, comm.rank)), job)


def flip(comm, path, at: int):
    """Turn one bit of a file's byte over; the same byte always gets the same bit."""
    if comm.rank == 0:
        data = bytearray(path.read_bytes())
        data[at] ^= 1 << at % 8
        path.write_bytes(data)
    comm.Barrier()


def test_any_rank_count_goes_on(comm, shared_tmp_path):
    """What all ranks save, one rank loads, and the other way round, bit for bit; its bytes do not depend on ranks."""
    mine = checkpoints(comm, shared_tmp_path)
    mine.save(2, FIELD[mine.form.rows])
    assert np.array_equal(mine.load(2), FIELD[mine.form.rows])
    if comm.rank == 0:
        alone = checkpoints(MPI.COMM_SELF, shared_tmp_path)
        assert np.array_equal(alone.load(2), FIELD)
        together = alone.path.read_bytes()
        alone.save(2, 2 * FIELD)
        alone.save(2, FIELD)
        assert alone.path.read_bytes() == together
    comm.Barrier()
    assert np.array_equal(mine.load(2), FIELD[mine.form.rows])


def test_only_the_same_load_of_the_same_job(comm, shared_tmp_path):
    """A checkpoint of another load or job is left aside; removed ones are gone."""
    mine = checkpoints(comm, shared_tmp_path)
    assert mine.load(0) is None
    mine.save(1, FIELD[mine.form.rows])
    assert mine.load(0) is None and checkpoints(comm, shared_tmp_path, "another").load(1) is None
    mine.remove()
    assert mine.load(1) is None and not list(shared_tmp_path.iterdir())


def test_damage_is_recognised(comm, shared_tmp_path, caplog):
    """A checkpoint whose numbers have changed, that lacks its end or is no HDF5, is not used; the log says so."""
    mine = checkpoints(comm, shared_tmp_path)
    mine.save(0, FIELD[mine.form.rows])
    whole = mine.path.read_bytes()
    comm.Barrier()  # all have read it before rank 0 changes it
    at = whole.index(FIELD[5].tobytes())
    changed = [whole[: at + 6] + bytes([whole[at + 6] ^ 64]) + whole[at + 7 :], whole[:20] + b"x" + whole[21:]]
    for damaged in (*changed, *(whole[:length] for length in range(0, len(whole) - 1, 499)), b"no file of HDF5"):
        once(comm, mine.path.write_bytes, damaged)
        caplog.clear()
        assert mine.load(0) is None
        assert comm.rank > 0 or "it is not used" in caplog.text
        comm.Barrier()
    if comm.rank == 0:
        mine.path.write_bytes(whole)
    comm.Barrier()
    assert np.array_equal(mine.load(0), FIELD[mine.form.rows])


def test_full_disk_keeps_the_last_one(comm, shared_tmp_path, monkeypatch):
    """If there is no space for a checkpoint the last one stays, and nothing half-written."""
    mine = checkpoints(comm, shared_tmp_path)
    mine.save(0, FIELD[mine.form.rows])

    def full(*arguments):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(files.os, "posix_fallocate", full)
    with pytest.raises(OSError, match="are free"):
        mine.save(0, 2 * FIELD[mine.form.rows])
    assert np.array_equal(mine.load(0), FIELD[mine.form.rows])
    comm.Barrier()
    assert [path.name for path in shared_tmp_path.iterdir()] == ["checkpoint.h5"]


def written(comm, folder):
    """A run of three loads whose first two are complete."""
    rows = slab(SHAPE[0], comm.size, comm.rank)
    job = config.as_toml(config.parse(JOB))
    parts = Origin(JOB, job, 3), output.Form(SHAPE, SHAPE, rows)
    with output.ResultWriter(comm, folder, *parts) as writer:
        writer.write_heights(FIELD[rows])
        for index in range(2):
            writer.write_load(index, {"mean_pressure": 0.1}, None, {"pressure": (index + 1) * FIELD[rows]})
    comm.Barrier()
    return lambda: output.ResultWriter(comm, folder, *parts, "restart")


@pytest.mark.parametrize(("name", "pending", "height"), [
    ("fields/load_0000.h5", [0, 2], True), ("fields/load_0001.h5", [1, 2], True), ("fields/height.h5", [2], False),
    ("fields.h5", [2], True),
])  # fmt: skip
@pytest.mark.parametrize("how", ["flipped", *(pytest.param(how, marks=pytest.mark.mpi("breadth"))
                                             for how in ("cut short", "missing"))])  # fmt: skip
def test_damaged_results_are_made_again(comm, shared_tmp_path, caplog, name, pending, height, how):
    """A byte beside the numbers is damaged, or a file cut short or gone: only what it held is made again, and a line
    says so; not of heights that are not there, as a run need not keep them, nor of the file of links."""
    restart = written(comm, shared_tmp_path / "out")
    path = shared_tmp_path / "out" / name
    if how == "flipped":
        flip(comm, path, 50)
    elif comm.rank == 0 and how == "missing":
        path.unlink()
    elif comm.rank == 0:
        path.write_bytes(path.read_bytes()[:-100])
    comm.Barrier()
    with restart() as writer:
        assert writer.pending == pending and writer.earlier.has_height == height
        said = name.startswith("fields/") and (height or how != "missing") and comm.rank == 0
        assert sum("it will be made again" in line for line in caplog.messages) == said
        rows = writer.form.rows
        writer.begin()
        if not height:
            writer.write_heights(FIELD[rows])
        for index in writer.pending:
            writer.write_load(index, {"mean_pressure": 0.1}, None, {"pressure": (index + 1) * FIELD[rows]})
        writer.finish()
    comm.Barrier()
    read = Results(shared_tmp_path / "out")
    assert read.status == "complete" and np.array_equal(read.field("height"), FIELD)
    for index in range(3):
        np.testing.assert_array_equal(read.field("pressure", index), (index + 1) * FIELD)
    comm.Barrier()
    with restart() as writer:
        assert writer.pending == [] and not writer.earlier.damaged


def test_every_byte_of_the_results_counts(comm, shared_tmp_path):
    """Whichever byte of the table of loads is flipped, a restart refuses it and touches nothing."""
    if comm.size > 1:
        pytest.skip("the files are the same for any rank count, and read by one rank")
    restart = written(comm, shared_tmp_path / "out")
    path = shared_tmp_path / "out" / "observables.h5"
    for at in range(0, path.stat().st_size, 101):
        flip(comm, path, at)
        before = contents(path.parent)
        with pytest.raises(InputError, match="observables.h5: cannot be continued: its bytes are not those"):
            restart()
        assert contents(path.parent) == before
        flip(comm, path, at)
    with restart() as writer:
        assert writer.pending == [2]


def test_sha256sum_reads_the_checksums(comm, shared_tmp_path):
    """The manifest is that of the usual tool, which finds every file as it was written, and one flipped bit."""
    written(comm, shared_tmp_path / "out")
    if comm.rank == 0 and shutil.which("sha256sum"):
        folder = shared_tmp_path / "out"
        check = ["sha256sum", "--check", "--strict", "SHA256SUMS"]
        run = subprocess.run(check, cwd=folder, capture_output=True, text=True, check=False)
        names = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.suffix in (".h5", ".vtkhdf")}
        assert run.returncode == 0 and {line.removesuffix(": OK") for line in run.stdout.splitlines()} == names
        path = folder / "fields" / "load_0001.h5"
        flip(MPI.COMM_SELF, path, path.stat().st_size // 2)
        assert damage(Results(folder)) == {path: "its bytes are not those that were written"}
        run = subprocess.run(check, cwd=folder, capture_output=True, text=True, check=False)
        assert run.returncode == 1 and "fields/load_0001.h5: FAILED" in run.stdout
    comm.Barrier()


@pytest.mark.parametrize("at", ["pressure", "pressure_sha256"])
def test_large_fields_hold_the_checksums_of_their_rows(comm, shared_tmp_path, monkeypatch, at):
    """Large files have SHA-256 of each row in place of a line in the manifest; a flipped bit of either is found."""
    monkeypatch.setattr(files, "LARGEST_LISTED", FIELD.nbytes - 1)
    folder = shared_tmp_path / "out"
    written(comm, folder)
    if comm.rank == 0:
        path = folder / "fields" / "load_0001.h5"
        with h5py.File(path, "r") as file:
            expected = [hashlib.sha256(row.tobytes()).digest() for row in 2 * FIELD]
            assert [row.tobytes() for row in file["pressure_sha256"]] == expected
            place = file[at].id.get_offset() + 9
        assert files.read_sums(folder).keys() == {"observables.h5", "fields.h5", "fields.vtkhdf"}
        assert damage(Results(folder)) == {}
        flip(MPI.COMM_SELF, path, place)
        assert damage(Results(folder)) == {path: "its bytes are not those that were written"}
    comm.Barrier()


@pytest.mark.parametrize("what", ["inputs", "job", "version"])
def test_only_the_same_run_is_continued(comm, shared_tmp_path, monkeypatch, what):
    """--restart refuses other input files, another load or version by name, on all ranks, and changes no byte."""
    heights, folder = shared_tmp_path / "heights.npy", shared_tmp_path / "out"
    surface = np.cos(2 * np.pi * np.arange(16) / 16)[:, None] * np.ones(16)
    once(comm, np.save, heights, surface)
    tables = {"grid": {"n": 16}, "surface": {"kind": "file", "path": str(heights)}, "solid": {"contact_modulus": 1},
              "load": {"pressure": [0.01, 0.02, 0.03]}, "output": {"fields": ["height", "pressure"]}}  # fmt: skip
    job = parse(config.tables_as_toml(tables))
    simulate(job, comm, folder)
    comm.Barrier()
    before = contents(folder)
    comm.Barrier()
    simulate(job, comm, folder, restart=True)  # the same: nothing to do
    comm.Barrier()
    assert {path.name for path in contents(folder)} == {path.name for path in before}
    before = contents(folder)
    comm.Barrier()
    words = {"inputs": f"content of {heights} has changed", "job": "load.pressure", "version": "by pgfmd 0"}[what]
    if what == "inputs" and comm.rank == 0:
        np.save(heights, 2 * surface)
    if what == "job":
        job = parse(config.tables_as_toml(tables | {"load": {"pressure": [0.01, 0.02, 0.04]}}))
    if what == "version":
        monkeypatch.setattr("pgfmd.application.restart.THIS_VERSION", "9.9")
    comm.Barrier()
    with pytest.raises(InputError, match=words):
        simulate(job, comm, folder, restart=True)
    comm.Barrier()
    assert contents(folder) == before
    comm.Barrier()
    simulate(job, comm, folder, overwrite=True)
    comm.Barrier()
    assert np.ptp(Results(folder).field("height")) == pytest.approx(4 if what == "inputs" else 2)
