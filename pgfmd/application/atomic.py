"""Files that are replaced as a whole, never in part; one writer per folder.  No MPI."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import io
import os
import platform
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from time import sleep

from pgfmd.application.checksum import sealed, unsealed
from pgfmd.errors import InputError

LOCK_NAME = ".pgfmd.lock"
PAUSE = 0.05  # seconds before a lock is asked for again: `holder` has it for a moment


def temporary(path: Path) -> Path:
    """Where the next version of `path` is written: always the same name, so that none pile up."""
    return path.with_name(f".{path.name}.tmp")


def previous(path: Path) -> Path:
    """Where the previous version of `path` is kept, if it is."""
    return path.with_name(f".{path.name}.previous")


def successor(path: Path) -> Path:
    """Where a version of `path` is kept that will replace it later."""
    return path.with_name(f".{path.name}.new")


def commit(path: Path, keep: bool = False, sync: bool = True) -> None:
    """Rename the finished temporary file of `path` to `path`; the file is synced to the disk before, the folder after.

    keep : the version that it replaces stays as `previous(path)`;  sync : False leaves that to the caller
    """
    if sync:
        _sync(temporary(path))
    if keep and path.exists():
        previous(path).unlink(missing_ok=True)
        try:
            os.link(path, previous(path))  # a link, so that `path` exists at every instant
        except OSError:
            os.replace(path, previous(path))  # a file system without hard links
    os.replace(temporary(path), path)
    if sync:
        _sync(path.parent)


def sync_files(folder: Path) -> None:
    """Sync the files of a folder, and the folder, to the disk.  Raises OSError."""
    for path in (*folder.glob("*.h5"), folder):
        with named(path):
            _sync(path)


def revise(
    path: Path, change: Callable[[io.BytesIO], None], keep: bool = False, anew: bool = False, sync: bool = True
) -> None:
    """Let `change` modify the content of the small, sealed file `path` (empty for a new file), and replace the file.

    keep, sync : see `commit`;  anew : `change` gets empty content even if the file exists

    `change` works in memory, since HDF5 crashes when a disk is full.  Raises OSError then; the old file stays.
    """
    content = io.BytesIO(unsealed(path.read_bytes()) if path.exists() and not anew else b"")
    change(content)
    try:
        with named(path):
            temporary(path).write_bytes(sealed(content.getbuffer()))
            commit(path, keep, sync)
    except BaseException:
        temporary(path).unlink(missing_ok=True)
        raise


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
    """Make a file of `size` bytes whose space on the disk is taken; raises OSError if less is free."""
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
        if error.errno != errno.EINVAL:  # file systems that cannot sync a folder say so this way
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
            self.discard()
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
        os.ftruncate(handle, 0)
        os.write(handle, f"process {os.getpid()} on {platform.node()}".encode())
        return handle

    def release(self) -> None:
        """Remove the lock."""
        (self.path / LOCK_NAME).unlink(missing_ok=True)
        os.close(self._handle)

    def discard(self) -> None:
        """Remove the folders that were made here, as far as they are empty."""
        for folder in self.made:
            with contextlib.suppress(OSError):
                folder.rmdir()


def holder(path: str | os.PathLike) -> str | None:
    """Who holds the folder's lock at this moment; None if nobody does."""
    try:
        handle = os.open(Path(path) / LOCK_NAME, os.O_RDONLY)
    except OSError:
        return None
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
        return None
    except BlockingIOError:
        return os.read(handle, 200).decode(errors="replace").strip() or "a run that has just started"
    except OSError:
        return None
    finally:
        os.close(handle)
