"""Distributed fields in one HDF5 file, written by all ranks.  HDF5 writes if h5py has MPI; else each rank writes its
rows at their offset, since HDF5 stores a contiguous dataset as plain numbers.  The bytes are the same.

Every rank holds at least one row: an empty selection in a collective write hangs (h5py issue 965).
"""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import h5py
import numpy as np

from pgfmd.application import files
from pgfmd.application.files import Form
from pgfmd.parallel.collectives import from_root, node_of, raise_together, slab
from pgfmd.parallel.mpi import MPI

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer, WriteableBuffer

COLLECTIVE_BYTES = 2**30  # most of one rank in one collective write: counts of MPI-IO overflow at 2 GiB
METADATA_BYTES = 2**16  # more than HDF5 needs for metadata
ALIGNMENT = 1 << 20  # bytes: datasets of at least this size start at a multiple of it, on a page and a Lustre stripe


@dataclass(frozen=True)
class Field:
    """This rank's slab of a field, shape (rows, ny), and its type in the file."""

    local: np.ndarray
    dtype: np.dtype

    def block(self, rows: slice) -> np.ndarray:
        """Local rows in the type of the file, contiguous; a copy only where the type differs."""
        return np.ascontiguousarray(self.local[rows], self.dtype)

    @property
    def row_bytes(self) -> int:
        """Bytes of one row in the file."""
        return self.local.shape[1] * self.dtype.itemsize

    def sums(self) -> Field:
        """The SHA-256 of each row as the file has it: (rows, 32) bytes."""
        parts = [files.row_sums(self.block(part)) for part in files.row_blocks(len(self.local), self.row_bytes)]
        return Field(np.concatenate(parts), np.dtype(np.uint8))


Create = Callable[[h5py.File, str], h5py.Dataset]


def is_collective(comm: MPI.Comm) -> bool:
    """Whether the ranks write by collective HDF5 calls."""
    return comm.size > 1 and bool(h5py.get_config().mpi)


def version() -> str:
    """The version of HDF5, and whether h5py has MPI."""
    return f"{h5py.version.hdf5_version} {'with' if h5py.get_config().mpi else 'without'} MPI"


def create_dataset(file: h5py.File, name: str, shape: tuple[int, int], dtype: np.dtype) -> h5py.Dataset:
    """A contiguous dataset; its space in the file is allocated at once, and not filled."""
    layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    layout.set_layout(h5py.h5d.CONTIGUOUS)
    layout.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    layout.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    layout.set_obj_track_times(False)  # the same numbers make the same bytes, at any time
    space = h5py.h5s.create_simple(shape)
    return h5py.Dataset(h5py.h5d.create(file.id, name.encode(), h5py.h5t.py_create(dtype, logical=True), space, layout))


def replace_by(comm: MPI.Comm, form: Form, path: Path, fields: dict[str, Field], create: Create) -> None:
    """Write a file of `fields` beside `path`, then rename it; after a failure it is removed.  Collective.

    form: its shape, rows and hints count.  create(file, name) makes the dataset of a field by `create_dataset`, on rank
    0.  HDF5 crashes or hangs when a disk is full; so the whole file is reserved before HDF5 writes.  All ranks raise an
    error of one; OSError: a full disk.
    """
    draft, nx = files.temporary(path), form.shape[0]
    sizes = [nx * field.row_bytes for field in fields.values()]
    sizes += [8 * nx, 8 * max(field.local.shape[1] for field in fields.values())]  # coordinates of the points
    size = sum(sizes) + ALIGNMENT * sum(each >= ALIGNMENT for each in sizes)
    try:
        offsets = from_root(comm, _lay_out, draft, size, list(fields), create)
        if is_collective(comm):
            _write_together(comm, form, draft, fields)
        else:
            _write_in_place(comm, form.rows, draft, fields, offsets)
        from_root(comm, files.commit, path)
    except BaseException:
        if comm.rank == 0:
            with suppress(OSError):
                draft.unlink(missing_ok=True)
        raise


def _lay_out(path: Path, size: int, names: list[str], create: Create) -> dict[str, int]:
    """Reserve space and write the file without the numbers; returns the offset of each field in bytes.  Rank 0."""
    files.reserve(path, size + METADATA_BYTES)
    with open(path, "r+b", buffering=0) as raw:
        target = _ReservedFile(raw)
        aligned = {"alignment_threshold": ALIGNMENT, "alignment_interval": ALIGNMENT}
        with h5py.File(target, "w", libver=files.LIBVER, **aligned) as file:
            offsets = {name: create(file, name).id.get_offset() for name in names}
        raw.truncate(target.size)
    return offsets


class _ReservedFile(io.RawIOBase):
    """A file with reserved space, which HDF5 sees as empty at first, then with the `size` that HDF5 has written.

    If HDF5 opened the file by its name, it would truncate it, and free the space.  If 4 to 64 kB were then left on the
    disk, HDF5 1.10 and 1.14 would end the process by SIGSEGV when they close the file.
    """

    def __init__(self, raw: io.FileIO):
        self._raw, self.size = raw, 0

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        from_end = whence == os.SEEK_END
        return self._raw.seek(self.size + offset) if from_end else self._raw.seek(offset, whence)

    def tell(self) -> int:
        return self._raw.tell()

    def readinto(self, buffer: WriteableBuffer) -> int:
        return self._raw.readinto(buffer)

    def write(self, data: ReadableBuffer) -> int:
        count = self._raw.write(data)
        self.size = max(self.size, self._raw.tell())
        return count

    def truncate(self, size: int | None = None) -> int:
        self.size = self._raw.tell() if size is None else size
        return self.size


def _write_together(comm: MPI.Comm, form: Form, path: Path, fields: dict[str, Field]) -> None:
    """Write by collective HDF5 calls; all ranks raise an error of one.  Collective."""
    rows = form.rows
    with raise_together(comm):
        info = MPI.Info.Create(dict(hint.split("=", 1) for hint in form.hints))
        try:
            file = h5py.File(path, "r+", driver="mpio", comm=comm, info=info, libver=files.LIBVER)
        finally:
            info.Free()  # HDF5 has copied them
    try:
        for name, field in fields.items():
            with raise_together(comm):
                dataset = file[name]
            count = rows.stop - rows.start
            pieces = -(-comm.allreduce(count, MPI.MAX) * field.row_bytes // COLLECTIVE_BYTES)
            for number in range(pieces):
                part = slab(count, pieces, number)
                if part.start == part.stop:  # fewer rows than pieces: write the last one again
                    part = slice(count - 1, count)
                with raise_together(comm):  # all have their numbers before any of them enters the write
                    block = field.block(part)
                with raise_together(comm), dataset.collective:
                    dataset[rows.start + part.start : rows.start + part.stop] = block
    except Exception:  # all ranks raise it; an interrupt of one alone must not block in the collective close
        with raise_together(comm):
            file.close()
        raise
    with raise_together(comm):
        file.close()


def _write_in_place(
    comm: MPI.Comm, rows: slice, path: Path, fields: dict[str, Field], offsets: dict[str, int]
) -> None:
    """Each rank writes its rows at their offset in the file, without HDF5.  Collective.

    The ranks of a node write at the same time, the nodes in turn: network file systems may lose simultaneous writes of
    several nodes.
    """
    mine = node_of(comm).bcast(comm.rank)  # the lowest rank of this node
    for turn in sorted(set(comm.allgather(mine))):
        with raise_together(comm):
            if turn == mine:
                _put_rows(path, rows, fields, offsets)


def _put_rows(path: Path, rows: slice, fields: dict[str, Field], offsets: dict[str, int]) -> None:
    with files.named(path), open(path, "r+b") as file:
        for name, field in fields.items():
            for part in files.row_blocks(rows.stop - rows.start, field.row_bytes):
                file.seek(offsets[name] + (rows.start + part.start) * field.row_bytes)
                file.write(field.block(part).data)
        file.flush()
        os.fsync(file.fileno())
