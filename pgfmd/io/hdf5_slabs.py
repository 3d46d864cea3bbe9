"""Distributed fields into one HDF5 file: by all ranks together where h5py has MPI, else through rank 0.

Only `output` uses it.  Every rank holds at least one row: an empty selection in a collective write hangs (h5py issue
965).
"""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from mpi4py import MPI

from pgfmd.io import atomic, checksum
from pgfmd.parallel.collectives import from_root, raise_together, slab

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


def is_collective(comm: MPI.Comm) -> bool:
    """Whether the ranks write together."""
    return comm.size > 1 and bool(h5py.get_config().mpi)


def create_dataset(file: h5py.File, name: str, shape: tuple[int, int], dtype: np.dtype) -> h5py.Dataset:
    """A dataset in one piece, whose place in the file is fixed at once and filled with nothing."""
    layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    layout.set_layout(h5py.h5d.CONTIGUOUS)
    layout.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    layout.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    layout.set_obj_track_times(False)  # the same numbers make the same bytes, at any time
    space = h5py.h5s.create_simple(shape)
    return h5py.Dataset(h5py.h5d.create(file.id, name.encode(), h5py.h5t.py_create(dtype, logical=True), space, layout))


def write(comm: MPI.Comm, path: Path, rows: slice, fields: dict[str, Field], create: Create):
    """Write a new file of `fields`; this rank holds the global `rows`.  Collective.

    create(file, name) makes the dataset of a field by `create_dataset`; rank 0 calls it.  The file gets its whole size
    on the disk before the first number: HDF5 crashes or hangs when a disk is full; so it never meets one.
    Raises on all ranks what fails on one; OSError if the disk is full.
    """
    count = comm.allreduce(rows.stop - rows.start)
    size = count * sum(field.row_bytes for field in fields.values())
    from_root(comm, _lay_out, path, size, list(fields), create)
    (_write_together if is_collective(comm) else _write_through_root)(comm, path, rows, fields)


def add_seal(comm: MPI.Comm, path: Path):
    """Append the seal to a finished file; the ranks share its blocks.  Collective.  Raises OSError on all ranks."""
    size = from_root(comm, os.path.getsize, path)
    tail = checksum.tail(size, _digests(comm, path, size))
    from_root(comm, atomic.append, path, tail)


def damage(comm: MPI.Comm, path: Path) -> str | None:
    """What is wrong with a sealed file, in words; None if every byte is the one that was written.  Collective."""
    size, expected, fault = from_root(comm, checksum.read_tail, path)
    if fault is not None:
        return fault
    for number, digests in enumerate(zip(_digests(comm, path, size), expected, strict=True)):
        if digests[0] != digests[1]:
            start = number * checksum.BLOCK
            return f"its bytes {start} to {min(start + checksum.BLOCK, size) - 1} are not those that were written"
    return None


def _digests(comm: MPI.Comm, path: Path, size: int) -> list[bytes]:
    """Digest of each block of a file, in order; the ranks take turns.  Collective."""
    mine: dict[int, bytes] = {}
    with raise_together(comm):
        mine = checksum.digest_blocks(path, range(comm.rank * checksum.BLOCK, size, comm.size * checksum.BLOCK), size)
    parts = {start: digest for part in comm.allgather(mine) for start, digest in part.items()}
    return [parts[start] for start in sorted(parts)]


def _lay_out(path: Path, size: int, names: list[str], create: Create):
    """The file with everything but the numbers, in space that is reserved beforehand.  On rank 0."""
    atomic.reserve(path, size + METADATA_BYTES)
    with open(path, "r+b", buffering=0) as raw:
        blank = _Blank(raw)
        with h5py.File(blank, "w", libver=LIBVER) as file:
            for name in names:
                create(file, name)
        raw.truncate(blank.size)


class _Blank(io.RawIOBase):
    """A file that has its space on the disk, shown to HDF5 as one of `size` bytes, none at first."""

    def __init__(self, raw: io.FileIO):
        self._raw, self.size = raw, 0

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        return (
            self._raw.seek(offset + self.size, os.SEEK_SET) if whence == os.SEEK_END else self._raw.seek(offset, whence)
        )

    def tell(self) -> int:
        return self._raw.tell()

    def readinto(self, buffer) -> int:
        return self._raw.readinto(buffer)

    def write(self, data) -> int:
        count = self._raw.write(data)
        self.size = max(self.size, self._raw.tell())
        return count

    def truncate(self, size: int | None = None) -> int:
        self.size = self._raw.tell() if size is None else size
        return self.size


def _write_together(comm: MPI.Comm, path: Path, rows: slice, fields: dict[str, Field]):
    """Each rank writes its own rows, all at the same time.  Collective.

    Every single call of HDF5 is followed by an agreement: an error that shows on one rank reaches all of them.
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
                if part.start == part.stop:  # fewer rows than pieces here: write the last one once more
                    part = slice(count - 1, count)
                with raise_together(comm):  # all have their numbers before any of them enters the write
                    block = field.block(part)
                with raise_together(comm), dataset.collective:
                    dataset[rows.start + part.start : rows.start + part.stop] = block
    finally:
        with raise_together(comm):
            file.close()


def _write_through_root(comm: MPI.Comm, path: Path, rows: slice, fields: dict[str, Field]):
    """The slabs go to rank 0 in turn, in blocks of rows; rank 0 writes.  Collective."""
    slabs = comm.gather((rows.start, rows.stop))
    with raise_together(comm):
        if comm.rank == 0:
            _receive(comm, path, slabs, fields)
            return
        for field in fields.values():
            for part in _blocks(rows.stop - rows.start, field.row_bytes):
                comm.Send([field.block(part).reshape(-1).view(np.uint8), MPI.BYTE], 0)


def _receive(comm: MPI.Comm, path: Path, slabs: list[tuple[int, int]], fields: dict[str, Field]):
    """Rank 0's side: it takes every block even after a failure, so that nobody is left waiting."""
    failure = None

    def attempt(function: Callable, *arguments):
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
                else:
                    block = np.empty((part.stop - part.start, field.local.shape[1]), field.dtype)
                    comm.Recv([block.reshape(-1).view(np.uint8), MPI.BYTE], source)
                attempt(_put, file, name, slice(start + part.start, start + part.stop), block)
    if file is not None:
        file.close()
    if failure is not None:
        raise failure


def _put(file: h5py.File, name: str, rows: slice, block: np.ndarray):
    file[name][rows] = block


def _blocks(count: int, row_bytes: int) -> list[slice]:
    """`count` rows cut into blocks of about MESSAGE_BYTES, at least one row each."""
    pieces = min(-(-count * row_bytes // MESSAGE_BYTES), count)
    return [slab(count, pieces, number) for number in range(pieces)]
