"""The files of a result folder: their names, how they are replaced, their checksums, and who may write there.  No MPI.

One rule for every file: it is written beside the old one as .NAME.tmp, synced, and renamed.  So each is whole at every
instant.  SHA256SUMS lists checksums of the files, for `sha256sum -c`.  A file of fields above `LARGEST_LISTED` bytes is
not in that list: it holds checksums of the rows of its fields, each computed by the rank that has the row.
"""

import contextlib
import errno
import fcntl
import hashlib
import io
import os
import platform
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from time import sleep

import h5py
import numpy as np

from pgfmd.errors import InputError
from pgfmd.observables.schema import LOADS, TABLE, Dataset, GroupLayout

FORMAT_VERSION = 4  # how earlier ones differ: see `Results._modern`
# Attributes beyond 64 KiB (a long job text) need this file format; every HDF5 since 2008 reads it.
LIBVER = ("v108", "v110")

OBSERVABLES_FILE, FIELDS_FILE, FIELDS_FOLDER = "observables.h5", "fields.h5", "fields"
VTK_FILE = "fields.vtkhdf"  # the same as fields.h5, for ParaView; see `field_files`
SMALL = (OBSERVABLES_FILE, FIELDS_FILE, VTK_FILE)
CHECKPOINT_FILE = "checkpoint.h5"  # of an unfinished load, in the folder of fields; see `loads`
ENSEMBLE_FILE = "ensemble.h5"  # of a folder that holds a result folder for each of several seeds; see `ensemble`
SUMS_FILE = "SHA256SUMS"
LARGE_TABLE = 2**20  # bytes from which a group of a load is a file: observables.h5 is rewritten for each load
LARGEST_LISTED = 2**26  # bytes of a file of fields up to which rank 0 reads and hashes it alone: 30 ms at 2 GB/s
ROW_SUMS = "_sha256"  # NAME_sha256, (nx, 32) bytes, holds the checksums of the rows of the field NAME
BLOCK_BYTES = 2**24  # written, or read to be checked, at once
MISSING = -1  # a whole number of the table of loads that is not known; a real one is NaN
LOCK_NAME = ".pgfmd.lock"
PAUSE = 0.05  # seconds before a lock is tried again: `holder` holds it for a moment


@dataclass(frozen=True)
class Form:
    """Layout of the files of one run: shape (nx, ny) and lengths (lx, ly) of the global grid, slice of rows of this
    rank, precision of real fields, names of units, groups of a load, and hints for MPI-IO.
    """

    shape: tuple[int, int]
    lengths: tuple[float, float]
    rows: slice
    precision: str = "float64"
    length_unit: str = "length"
    pressure_unit: str = "pressure"
    groups: GroupLayout = field(default_factory=dict)
    hints: tuple[str, ...] = ()

    @property
    def units(self) -> dict[str, str]:
        """Names of units by what they measure, for the units of datasets."""
        return {"length": self.length_unit, "pressure": self.pressure_unit}

    @property
    def columns(self) -> dict[str, Dataset]:
        """The columns of the table of loads: those that every run has, and those of its observables."""
        return {**LOADS, **self.groups.get(TABLE, {})}


def load_name(index: int) -> str:
    """Name of a load's group: load_0000, load_0001, …"""
    return f"load_{index:04d}"


def member_name(seed: int) -> str:
    """Name of the result folder of one seed of an ensemble: seed_0001, seed_0002, …"""
    return f"seed_{seed:04d}"


def temporary(path: Path) -> Path:
    """Where the next version of `path` is written: one name, so that drafts do not pile up."""
    return path.with_name(f".{path.name}.tmp")


def commit(path: Path, sync: bool = True) -> None:
    """Rename the finished temporary file of `path` to `path`; sync: the file before, and the folder after."""
    if sync:
        _sync(temporary(path))
    os.replace(temporary(path), path)
    if sync:
        _sync(path.parent)


def replace(path: Path, content: bytes | memoryview, sync: bool = True) -> None:
    """Replace a small file as a whole.  Raises OSError; the old file stays then."""
    try:
        with named(path):
            temporary(path).write_bytes(content)
            commit(path, sync)
    except BaseException:
        temporary(path).unlink(missing_ok=True)
        raise


Change = Callable[[h5py.File], None]
"""Adds to or changes an open file."""


def revise(path: Path, change: Change) -> None:
    """Let `change` modify a small HDF5 file.  Raises OSError, also if the file is gone; the old file stays then."""
    create(path, change, path.read_bytes())


def create(path: Path, fill: Change, begun: bytes = b"") -> None:
    """Let `fill` write a small HDF5 file, in the place of one that is there.  Raises OSError.

    begun: bytes of the file that `fill` changes, if any.  All in memory, as HDF5 crashes when a disk is full.
    """
    content = io.BytesIO(begun)
    with h5py.File(content, "r+" if begun else "w", libver=LIBVER) as file:
        fill(file)
    replace(path, content.getbuffer())


class Sums:
    """SHA256SUMS of a result folder.  Rank 0.

    The line of a file is removed before the file changes, and written after: so every line is true at every instant.
    """

    def __init__(self, directory: Path) -> None:
        self.directory = directory

    @cached_property
    def _lines(self) -> dict[str, str]:
        return read_sums(self.directory)

    def forget(self, *names: str) -> None:
        """Remove the lines of files, by their paths in the folder."""
        if self._lines:
            self._write({name: digest for name, digest in self._lines.items() if name not in names})

    def note(self, *names: str) -> None:
        """Write the lines of files that hold no checksums of their own; remove those of files that are gone."""
        paths = {name: self.directory / name for name in names}
        listed = {name: path for name, path in paths.items() if path.exists() and not _summed_fields(path)}
        self._write(self._lines | {name: sha256(path) for name, path in listed.items()})

    def _write(self, lines: dict[str, str]) -> None:
        self._lines = {name: digest for name, digest in sorted(lines.items()) if (self.directory / name).exists()}
        text = "".join(f"{digest}  {name}\n" for name, digest in self._lines.items())
        replace(self.directory / SUMS_FILE, text.encode(), sync=False)


def read_sums(directory: Path) -> dict[str, str]:
    """The checksums in a result folder by the path of the file; none if it has no SHA256SUMS."""
    try:
        text = (directory / SUMS_FILE).read_text(errors="replace")
    except OSError:
        return {}
    return {name: digest for digest, name in re.findall(r"^([0-9a-f]{64})  (.+)$", text, re.MULTILINE)}


def sha256(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal.  Raises OSError."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def row_sums(rows: np.ndarray) -> np.ndarray:
    """SHA-256 of each row of a contiguous array: (rows, 32) bytes."""
    digests = b"".join(hashlib.sha256(row).digest() for row in rows)
    return np.frombuffer(digests, np.uint8).reshape(len(rows), -1)


def row_blocks(count: int, row_bytes: int) -> list[slice]:
    """`count` rows cut into blocks of at most BLOCK_BYTES, or of one row."""
    step = max(1, BLOCK_BYTES // row_bytes)
    return [slice(first, min(first + step, count)) for first in range(0, count, step)]


def rows_are_right(path: Path) -> bool | None:
    """Whether the rows of the fields in a file have the checksums that it holds of them; None if it holds none."""
    try:
        fields = _summed_fields(path)
        with h5py.File(path, "r", locking=False) as file:
            for field in (file[name] for name in fields):
                for rows in row_blocks(len(field), field.shape[1] * field.dtype.itemsize):
                    if not np.array_equal(row_sums(field[rows]), file[field.name + ROW_SUMS][rows]):
                        return False
    except Exception:  # whatever HDF5 makes of a damaged file
        return False
    return True if fields else None


def _summed_fields(path: Path) -> list[str]:
    """The fields in a file that holds checksums of their rows.  Raises OSError for a file that cannot be read."""
    if path.stat().st_size <= LARGEST_LISTED:
        return []
    with h5py.File(path, "r", locking=False) as file:
        return [name.removesuffix(ROW_SUMS) for name in file if name.endswith(ROW_SUMS)]


@contextlib.contextmanager
def named(path: Path) -> Iterator[None]:
    """Adds `path` to an OSError of the block that names no file, such as ENOSPC."""
    try:
        yield
    except OSError as error:
        if error.filename is None:
            error.filename = str(path)
        raise


def reserve(path: Path, size: int) -> None:
    """Make a file of `size` bytes with its space on the disk allocated; raises OSError if less is free."""
    folder = path.parent
    try:
        with open(path, "wb") as file:
            os.posix_fallocate(file.fileno(), 0, size)
    except OSError as error:
        path.unlink(missing_ok=True)
        if error.errno != errno.ENOSPC:
            raise
        free = shutil.disk_usage(folder).free
        message = f"{size / 1e6:.1f} MB are to be written, {free / 1e6:.1f} MB are free"
        raise OSError(errno.ENOSPC, message, str(folder)) from None


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno != errno.EINVAL:  # of file systems that cannot sync a folder
            raise
    finally:
        os.close(handle)


class OutputFolder:
    """A folder held by one run: made if missing, locked until `release`.  On one rank only.

    The lock is the kernel's (flock) and ends with its process; the file's text only says who holds it.
    Raises InputError if the folder cannot be made or written, or if another run holds it.
    """

    def __init__(self, path: str | os.PathLike):
        self.path = Path(path)
        missing = [folder for folder in (self.path, *self.path.parents) if not os.path.lexists(folder)]
        self.made: list[Path] = []
        try:
            for folder in reversed(missing):
                folder.mkdir()
                self.made.insert(0, folder)
            self._handle = self._lock()
        except InputError:
            raise
        except (OSError, ValueError) as error:
            self._remove_made()
            reason = getattr(error, "strerror", None) or str(error)
            raise InputError(f"{self.path}: cannot be written as an output folder: {reason}") from None

    def _lock(self) -> int:
        name, refused = self.path / LOCK_NAME, False
        while True:
            handle = os.open(name, os.O_RDWR | os.O_CREAT, 0o644)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                other = os.read(handle, 200).decode(errors="replace").strip()
                os.close(handle)
                if refused:
                    raise InputError(f"{self.path}: another run writes here ({other or 'just started'})") from None
                refused = True
                sleep(PAUSE)
                continue
            except OSError as error:
                if error.errno not in (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP):
                    os.close(handle)
                    raise
                # A file system without locks: the run goes on unprotected.
            # A run that has just ended removes its lock file: check that the locked file still has that name.
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(handle), os.stat(name)):
                    break
            os.close(handle)
        try:
            os.ftruncate(handle, 0)
            os.write(handle, f"process {os.getpid()} on {platform.node()}".encode())
        except OSError:  # a full disk
            name.unlink()
            os.close(handle)
            raise
        return handle

    def release(self) -> None:
        """Remove the lock, and the folders that were made here as far as they are empty."""
        (self.path / LOCK_NAME).unlink(missing_ok=True)
        os.close(self._handle)
        self._remove_made()

    def _remove_made(self) -> None:
        for folder in self.made:
            with contextlib.suppress(OSError):
                folder.rmdir()


def holder(path: str | os.PathLike) -> str | None:
    """Who holds the folder's lock at this moment; None if nobody does."""
    with contextlib.suppress(OSError), open(Path(path) / LOCK_NAME, "rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return file.read(200).decode(errors="replace").strip() or "a run that has just started"
    return None
