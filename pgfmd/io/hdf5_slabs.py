"""Distributed fields in one sealed HDF5 file: written by all ranks together where h5py has MPI, else through rank 0.

Every rank holds at least one row: an empty selection in a collective write hangs (h5py issue 965).
"""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
from mpi4py import MPI

from pgfmd.io import atomic, checksum
from pgfmd.io.checksum import SealedArray
from pgfmd.parallel.collectives import from_root, raise_together, slab

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer, WriteableBuffer

# Attributes beyond 64 KiB (a long job text) need this file format; every HDF5 since 2008 reads it.
LIBVER = ("v108", "v110")
COLLECTIVE_BYTES = 2**30  # of one rank in one collective write; MPI-IO counts overflow from 2 GiB
MESSAGE_BYTES = 2**26  # of one message to rank 0
METADATA_BYTES = 2**16  # more than HDF5 needs beside the numbers


@dataclass(frozen=True)
class Field:
    """This rank's slab of a field, shape (rows, ny), and the type it has in the file."""

    local: np.ndarray
    dtype: np.dtype

    def block(self, rows: slice) -> np.ndarray:
        """Local rows in the type of the file, contiguous; a copy only where the type differs."""
        return np.ascontiguousarray(self.local[rows], self.dtype)

    @property
    def row_bytes(self) -> int:
        """Bytes of one row in the file."""
        return self.local.shape[1] * self.dtype.itemsize


Create = Callable[[h5py.File, str], h5py.Dataset]
Note = Callable[[str, int, np.ndarray], None]
"""note(field name, first global row, rows as they are in the file): each rank calls it once for each of its blocks."""


def is_collective(comm: MPI.Comm) -> bool:
    """Whether the ranks write together."""
    return comm.size > 1 and bool(h5py.get_config().mpi)


def create_dataset(file: h5py.File, name: str, shape: tuple[int, int], dtype: np.dtype) -> h5py.Dataset:
    """A contiguous dataset, whose space in the file is allocated at once and not filled."""
    layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    layout.set_layout(h5py.h5d.CONTIGUOUS)
    layout.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    layout.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    layout.set_obj_track_times(False)  # the same numbers make the same bytes, at any time
    space = h5py.h5s.create_simple(shape)
    return h5py.Dataset(h5py.h5d.create(file.id, name.encode(), h5py.h5t.py_create(dtype, logical=True), space, layout))


def write(comm: MPI.Comm, path: Path, rows: slice, fields: dict[str, Field], create: Create) -> None:
    """Write a new, sealed file of `fields`; this rank holds the global `rows`.  Collective.

    create(file, name) makes the dataset of a field by `create_dataset`; rank 0 calls it.  HDF5 crashes or hangs when a
    disk is full; so the space of the whole file is reserved before HDF5 writes.  An error on one rank is raised on all
    of them; OSError if the disk is full.
    """
    count = comm.allreduce(rows.stop - rows.start)
    size = count * sum(field.row_bytes for field in fields.values())
    size += 8 * (count + max(field.local.shape[1] for field in fields.values()))  # coordinates of the points
    arrays = from_root(comm, _lay_out, path, size, list(fields), create)
    sums = {name: array.blank_sums() for name, array in arrays.items()}
    transport = _write_together if is_collective(comm) else _write_through_root
    transport(comm, path, rows, fields, lambda name, first, block: arrays[name].add(sums[name], first, block))
    arrays = {name: replace(array, sums=_sum_over_ranks(comm, sums[name])) for name, array in arrays.items()}
    from_root(comm, _seal, path, arrays)


def replace_by(comm: MPI.Comm, path: Path, rows: slice, fields: dict[str, Field], create: Create, keep: bool) -> None:
    """`write` under a temporary name, then rename; after a failure the temporary file is removed.  Collective.

    keep: the version that it replaces stays as `atomic.previous(path)`.  Raises like `write`.
    """
    draft = atomic.temporary(path)
    try:
        write(comm, draft, rows, fields, create)
        from_root(comm, atomic.commit, path, keep)
    except BaseException:
        if comm.rank == 0:
            with suppress(OSError):
                draft.unlink(missing_ok=True)
        raise


def read(comm: MPI.Comm, path: Path, rows: slice, name: str) -> tuple[np.ndarray | None, str | None]:
    """Read this rank's rows of a field in a sealed file, and check them against the seal: (rows, None), or (None, what
    is wrong with the file).  Collective.
    """
    seal, fault = from_root(comm, checksum.read_seal, path)
    if seal is None:
        return None, fault
    with raise_together(comm):
        with h5py.File(path, "r", locking=False) as file:
            local = file[name][rows]
    array = seal.arrays[name]
    sums = array.blank_sums()
    array.add(sums, rows.start, local)
    fault = array.difference(np.array(_sum_over_ranks(comm, sums), np.uint64))
    return (local if fault is None else None), fault


def _seal(path: Path, arrays: dict[str, SealedArray]) -> None:
    with atomic.named(path):
        checksum.add_seal(path, arrays)


def _sum_over_ranks(comm: MPI.Comm, sums: np.ndarray) -> list[int]:
    """The sums of all ranks, modulo 2⁶⁴.  Collective."""
    comm.Allreduce(MPI.IN_PLACE, sums, MPI.SUM)
    return [int(number) for number in sums]


def _lay_out(path: Path, size: int, names: list[str], create: Create) -> dict[str, SealedArray]:
    """Reserve space; write a file with all but the numbers; returns where each field lies.  Rank 0."""
    atomic.reserve(path, size + METADATA_BYTES)
    with open(path, "r+b", buffering=0) as raw:
        target = _ReservedFile(raw)
        with h5py.File(target, "w", libver=LIBVER) as file:
            datasets = [create(file, name) for name in names]
            arrays = {
                name: checksum.array_at(found.id.get_offset(), found.shape[1] * found.dtype.itemsize, found.shape[0])
                for name, found in zip(names, datasets, strict=True)
            }
        raw.truncate(target.size)
    return arrays


class _ReservedFile(io.RawIOBase):
    """A file with reserved space, which HDF5 sees as one of `size` bytes: 0 at first, then what HDF5 has written.

    If HDF5 opened the file by its name, it would truncate it and so give the space back.  Where 4 to 64 kB are then
    left on the disk, HDF5 1.10 and 1.14 end the process by SIGSEGV when they close the file.
    """

    def __init__(self, raw: io.FileIO):
        self._raw, self.size = raw, 0

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        return (
            self._raw.seek(offset + self.size, os.SEEK_SET) if whence == os.SEEK_END else self._raw.seek(offset, whence)
        )

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


def _write_together(comm: MPI.Comm, path: Path, rows: slice, fields: dict[str, Field], note: Note) -> None:
    """Each rank writes its own rows, all at the same time.  Collective.

    After each call of HDF5 the ranks agree whether it failed: an error on one rank is raised on all of them.
    """
    with raise_together(comm):
        file = h5py.File(path, "r+", driver="mpio", comm=comm, libver=LIBVER)
    try:
        for name, field in fields.items():
            with raise_together(comm):
                dataset = file[name]
            count = rows.stop - rows.start
            pieces = -(-comm.allreduce(count, MPI.MAX) * field.row_bytes // COLLECTIVE_BYTES)
            for number in range(pieces):
                part = slab(count, pieces, number)
                again = part.start == part.stop  # fewer rows than pieces here: write the last one once more
                if again:
                    part = slice(count - 1, count)
                with raise_together(comm):  # all have their numbers before any of them enters the write
                    block = field.block(part)
                    if not again:
                        note(name, rows.start + part.start, block)
                with raise_together(comm), dataset.collective:
                    dataset[rows.start + part.start : rows.start + part.stop] = block
    finally:
        with raise_together(comm):
            file.close()


def _write_through_root(comm: MPI.Comm, path: Path, rows: slice, fields: dict[str, Field], note: Note) -> None:
    """The slabs go to rank 0 in turn, in blocks of rows; rank 0 writes.  Collective."""
    slabs = comm.gather((rows.start, rows.stop))
    with raise_together(comm):
        if slabs is not None:
            _receive(comm, path, slabs, fields, note)
            return
        for name, field in fields.items():
            for part in _blocks(rows.stop - rows.start, field.row_bytes):
                block = field.block(part)
                note(name, rows.start + part.start, block)
                comm.Send([block.reshape(-1).view(np.uint8), MPI.BYTE], 0)


def _receive(comm: MPI.Comm, path: Path, slabs: list[tuple[int, int]], fields: dict[str, Field], note: Note) -> None:
    """Rank 0's side: it takes every block even after a failure, so that nobody is left waiting."""
    failure: Exception | None = None

    def attempt(function: Callable, *arguments: Any) -> Any:
        nonlocal failure
        if failure is None:
            try:
                return function(*arguments)
            except Exception as error:  # raised below, when every block has been received
                failure = error
        return None

    file = attempt(lambda: h5py.File(path, "r+", libver=LIBVER, locking=False))
    for source, (start, stop) in enumerate(slabs):
        for name, field in fields.items():
            for part in _blocks(stop - start, field.row_bytes):
                if source == 0:
                    block = field.block(part)
                    attempt(note, name, start + part.start, block)
                else:
                    block = np.empty((part.stop - part.start, field.local.shape[1]), field.dtype)
                    comm.Recv([block.reshape(-1).view(np.uint8), MPI.BYTE], source)
                attempt(_put, file, name, slice(start + part.start, start + part.stop), block)
    if file is not None:
        file.close()
    if failure is not None:
        raise failure


def _put(file: h5py.File, name: str, rows: slice, block: np.ndarray) -> None:
    file[name][rows] = block


def _blocks(count: int, row_bytes: int) -> list[slice]:
    """`count` rows cut into blocks of about MESSAGE_BYTES, at least one row each."""
    pieces = min(-(-count * row_bytes // MESSAGE_BYTES), count)
    return [slab(count, pieces, number) for number in range(pieces)]
