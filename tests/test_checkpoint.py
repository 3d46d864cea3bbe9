"""Checkpoints and seals: what is saved is what is loaded, on any rank count; what is damaged is not used."""

from __future__ import annotations

import errno
import logging

import numpy as np
import pytest
from job_texts import SOLID
from mpi4py import MPI

from pgfmd.application import atomic, checksum
from pgfmd.application import job as config
from pgfmd.application import writer as output
from pgfmd.application.checkpoint import Checkpoints
from pgfmd.application.checksum import sealed, unsealed
from pgfmd.application.provenance import Origin
from pgfmd.application.results import Results
from pgfmd.parallel.collectives import slab

pytestmark = pytest.mark.mpi

SHAPE = (13, 6)  # 13 rows: uneven slabs on 2, 3 and 4 ranks
FIELD = np.arange(78.0).reshape(SHAPE) ** 1.5
JOB = SOLID + '[grid]\nn = [13, 6]\n[surface]\nkind = "sinusoid"\namplitude = 1\n[load]\npressure = [0.1, 0.2, 0.3]\n'


def checkpoints(comm, folder, job: str = "job") -> Checkpoints:
    """Those of a 13 × 6 grid over all ranks of `comm`."""
    return Checkpoints(comm, folder, SHAPE, slab(SHAPE[0], comm.size, comm.rank), job)


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
    mine.save(2, FIELD[mine.rows])
    assert np.array_equal(mine.load(2), FIELD[mine.rows])
    if comm.rank == 0:
        alone = checkpoints(MPI.COMM_SELF, shared_tmp_path)
        assert np.array_equal(alone.load(2), FIELD)
        together = alone.path.read_bytes()
        alone.save(2, 2 * FIELD)
        alone.save(2, FIELD)
        assert alone.path.read_bytes() == together
    comm.Barrier()
    assert np.array_equal(mine.load(2), FIELD[mine.rows])


def test_only_the_same_load_of_the_same_job(comm, shared_tmp_path):
    """A checkpoint of another load or job is left aside; removed ones are gone."""
    mine = checkpoints(comm, shared_tmp_path)
    assert mine.load(0) is None
    mine.save(1, FIELD[mine.rows])
    assert mine.load(0) is None and checkpoints(comm, shared_tmp_path, "another").load(1) is None
    mine.remove()
    assert mine.load(1) is None and not list(shared_tmp_path.iterdir())


def test_every_byte_counts(comm, shared_tmp_path, caplog, request):
    """Whichever byte of a checkpoint is flipped, it is recognised, and the one before is used."""
    mine = checkpoints(comm, shared_tmp_path)
    before, now = FIELD[mine.rows] + 1, FIELD[mine.rows]
    mine.save(0, before)
    mine.save(0, now)
    size = mine.path.stat().st_size
    assert size > 2000
    comm.Barrier()
    caplog.set_level(logging.CRITICAL, logger="pgfmd")
    step = 97 if comm.size > 1 else 1 if request.config.getoption("--long") else 7
    for at in range(0, size, step):
        flip(comm, mine.path, at)
        assert np.array_equal(mine.load(0), before), f"byte {at} of {size}"
        flip(comm, mine.path, at)
    assert np.array_equal(mine.load(0), now)


def test_cut_files_are_recognised(comm, shared_tmp_path):
    """A checkpoint cut short anywhere, or with bytes added, is not used; if the one before is damaged too, none is."""
    mine = checkpoints(comm, shared_tmp_path)
    mine.save(0, FIELD[mine.rows] + 1)
    mine.save(0, FIELD[mine.rows])
    whole = mine.path.read_bytes()
    comm.Barrier()  # all have read it before rank 0 cuts it
    for damaged in (*(whole[:length] for length in range(0, len(whole), 499)), whole + b"x", whole + whole):
        if comm.rank == 0:
            mine.path.write_bytes(damaged)
        comm.Barrier()
        assert np.array_equal(mine.load(0), FIELD[mine.rows] + 1)
        comm.Barrier()
    if comm.rank == 0:
        atomic.previous(mine.path).write_bytes(b"")
    comm.Barrier()
    assert mine.load(0) is None


def test_seal_covers_every_byte(comm, shared_tmp_path, monkeypatch):
    """A seal made by many ranks while they write is that of one, and names the block of rows that is damaged; the
    serial check of a file finds every byte that the ranks wrote, without HDF5.
    """
    monkeypatch.setattr("pgfmd.application.checksum.BLOCK", 100)  # two rows of 48 bytes
    mine, path = checkpoints(comm, shared_tmp_path), shared_tmp_path / "checkpoint.h5"
    mine.save(0, FIELD[mine.rows])
    assert checksum.damage(path) is None
    seal, _ = checksum.read_seal(path)
    array = seal.arrays["pressure"]
    assert (array.row_bytes, array.rows, len(array.sums)) == (48, 13, 7)
    if comm.rank == 0:
        alone = checkpoints(MPI.COMM_SELF, shared_tmp_path / "alone")
        alone.path.parent.mkdir()
        alone.save(0, FIELD)
        assert alone.path.read_bytes() == path.read_bytes()
    comm.Barrier()
    for at, words in ((array.start, "bytes"), (array.stop - 1, "bytes"), (9, "outside"), (seal.size + 3, "seal")):
        flip(comm, path, at)
        assert words in checksum.damage(path)
        block = (at - array.start) // 96
        assert words != "bytes" or f"bytes {array.start + 96 * block} to" in checksum.damage(path)
        comm.Barrier()
        flip(comm, path, at)


@pytest.mark.parametrize("shape", [(1, 1), (5, 3), (64, 7)])
@pytest.mark.parametrize("block", [8, 100, 2**24])
def test_sums_of_rows(shape, block, monkeypatch):
    """Sums of parts in any order add up to that of the whole; one changed bit, two changed bits and rows that change
    places are seen.
    """
    monkeypatch.setattr("pgfmd.application.checksum.BLOCK", block)
    rows = np.random.default_rng(1).random(shape)
    array = checksum.array_at(0, 8 * shape[1], shape[0])

    def sums(rows, cuts=()):
        found = array.blank_sums()
        for first, stop in reversed(list(zip([0, *cuts], [*cuts, shape[0]], strict=True))):
            array.add(found, first, rows[first:stop])
        return found.tolist()

    whole = sums(rows)
    assert sums(rows, range(1, shape[0], 2)) == whole
    for flips in ([0], [63], [0, 64 * rows.size - 1], [63, 64 * rows.size - 1]):
        changed = rows.copy()
        for bit in flips:
            changed.reshape(-1).view(np.uint64)[bit // 64] ^= np.uint64(1 << bit % 64)
        assert sums(changed) != whole or len(set(flips)) < len(flips)
    if shape[0] > 1:
        assert sums(rows[::-1].copy()) != whole


def test_seals_of_any_length():
    """Empty contents have seals too; a file that has none is refused, if strict."""
    for content in (b"", b"x", bytes(2**24 + 1)):
        assert unsealed(sealed(content)) == content
    assert unsealed(b"x" * 500, strict=False) == b"x" * 500
    with pytest.raises(OSError, match="no seal"):
        unsealed(b"x" * 500)
    with pytest.raises(OSError, match="another version"):
        unsealed(sealed(b"x").replace(b"seal 2", b"seal 1"))


def test_full_disk_keeps_the_last_one(comm, shared_tmp_path, monkeypatch):
    """If there is no space for a checkpoint the last one stays, and nothing half-written."""
    mine = checkpoints(comm, shared_tmp_path)
    mine.save(0, FIELD[mine.rows])

    def full(*arguments):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(atomic.os, "posix_fallocate", full)
    with pytest.raises(OSError, match="are free"):
        mine.save(0, 2 * FIELD[mine.rows])
    assert np.array_equal(mine.load(0), FIELD[mine.rows])
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


@pytest.mark.parametrize(
    ("name", "pending", "height"),
    [
        ("fields/load_0000.h5", [0, 2], True),
        ("fields/load_0001.h5", [1, 2], True),
        ("fields/height.h5", [2], False),
        ("fields.h5", [2], True),
        ("observables.h5", [1, 2], True),
    ],
)
@pytest.mark.parametrize("how", ["flipped", "cut short", "missing"])
def test_damaged_results_are_made_again(comm, shared_tmp_path, name, pending, height, how):
    """A byte beside the numbers of a result file is damaged, or the file cut short or gone: what it held, and only
    that, is to be made again.
    """
    restart = written(comm, shared_tmp_path / "out")
    path = shared_tmp_path / "out" / name
    if how == "missing" and name == "observables.h5":
        pytest.skip("without it nothing can be continued: the run begins anew")
    if how == "flipped":
        flip(comm, path, 50)
    elif comm.rank == 0 and how == "missing":
        path.unlink()
    elif comm.rank == 0:
        path.write_bytes(path.read_bytes()[:-100])
    comm.Barrier()
    with restart() as writer:
        assert writer.pending == pending and writer.earlier.has_height == height
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


def test_every_byte_of_the_results_counts(comm, shared_tmp_path, caplog):
    """Whichever byte of the table of loads is flipped, the version before it is used."""
    if comm.size > 1:
        pytest.skip("the files are the same for any rank count, and read by one rank")
    restart = written(comm, shared_tmp_path / "out")
    path = shared_tmp_path / "out" / "observables.h5"
    caplog.set_level(logging.CRITICAL, logger="pgfmd")
    for at in range(0, path.stat().st_size, 101):
        flip(comm, path, at)
        with restart() as writer:
            assert writer.pending == [1, 2], f"byte {at}"
        flip(comm, path, at)
