"""A folder that keeps compiled loops and FFTW's wisdom for later runs.

Its content is executed.  So the user must own it, and nobody else may be able to write in it or to replace it.  The
first of these that can be made and is private is used:

    $PGFMD_CACHE/pgfmd, $XDG_CACHE_HOME/pgfmd, ~/.cache/pgfmd
    pgfmd-UID in the folder of temporary files, then in /dev/shm    (a container's user may have no home)

It is made with mode 0700.  This module needs neither MPI nor numba to be imported.
"""

from __future__ import annotations

import contextlib
import fcntl
import functools
import hashlib
import logging
import os
import stat
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO

LONGEST, PAUSE = 60.0, 0.01
"""Seconds that a process waits at most for another one, which may have been stopped (a loop compiles in 1 to 5), and
between its first looks."""
DIGEST = 32  # bytes of the checksum before the content of a file

log = logging.getLogger("pgfmd")


@functools.cache
def private_folder() -> Path | None:
    """The folder, made if missing; None if there is no private one.  The log says why $PGFMD_CACHE is not taken."""
    for folder in _candidates():
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            writable = os.access(folder, os.W_OK | os.X_OK)
            if writable and is_private(folder):
                return folder
            reason = "others can write or replace it" if writable else "may not be written"
        except OSError as error:
            reason = str(error.strerror)
        if folder.parent == Path(os.environ.get("PGFMD_CACHE") or "/"):
            log.warning("PGFMD_CACHE: %s: %s; another folder keeps compiled loops", folder, reason)
    return None


def kept(path: Path | None) -> bytes | None:
    """What `keep` has written there; None if nothing, or if it is damaged."""
    with contextlib.suppress(OSError):
        if path is not None:
            content = path.read_bytes()
            if hashlib.sha256(content[DIGEST:]).digest() == content[:DIGEST]:
                return content[DIGEST:]
    return None


def keep(path: Path | None, content: bytes) -> None:
    """Write a file by a rename, so that no reader sees half of it.  Where that fails, as on a full disk, the log says
    so once for a folder, and nothing is left there.
    """
    if path is None:
        return
    try:
        path.parent.mkdir(exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent) as folder:  # removed in any case
            file = Path(folder) / path.name
            file.write_bytes(hashlib.sha256(content).digest() + content)
            os.replace(file, path)
    except OSError as error:
        _warn(path.parent, error.strerror)


def locked(path: Path | None) -> IO | None:
    """Waits until no other process holds the lock that belongs to this path, at most LONGEST, and takes it.  The lock
    ends when the returned file is closed or the process ends.  None where there is no lock to be had: then go on
    without.  After it, look again before making a file.
    """
    with contextlib.suppress(OSError):
        if path is not None:
            path.parent.mkdir(exist_ok=True)
            file, began = open(path.with_suffix(".lock"), "w"), time.monotonic()
            while (waited := time.monotonic() - began) < LONGEST:
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    return file
                except BlockingIOError:
                    time.sleep(max(PAUSE, waited / 10))  # a file server is not to be asked too often
    return None


@functools.cache
def _warn(folder: Path, reason: str) -> None:
    log.warning("%s: %s; compiled loops and FFTW's plans are not kept for later runs", folder, reason)


def is_private(folder: Path) -> bool:
    """Whether this user owns a folder, and nobody else but root can write in it, or rename it or a folder above it."""
    status = os.lstat(folder)
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.geteuid() or _others_write(status):
        return False
    above = [os.stat(each) for each in folder.resolve().parents]
    return all(
        each.st_uid in (0, os.geteuid()) and (not _others_write(each) or each.st_mode & stat.S_ISVTX) for each in above
    )


def _others_write(status: os.stat_result) -> bool:
    """Write permission for others, or for a group that is not the user's own (the one with the user's number)."""
    mode = status.st_mode
    return bool(mode & stat.S_IWOTH or mode & stat.S_IWGRP and status.st_gid != os.geteuid())


def _candidates() -> Iterator[Path]:
    for name in ("PGFMD_CACHE", "XDG_CACHE_HOME"):
        if value := os.environ.get(name):
            yield Path(value) / "pgfmd"
    with contextlib.suppress(RuntimeError):  # no HOME, and no such user
        yield Path.home() / ".cache" / "pgfmd"
    with contextlib.suppress(FileNotFoundError):  # no folder of temporary files has space for one
        yield Path(tempfile.gettempdir()) / f"pgfmd-{os.geteuid()}"
    yield Path("/dev/shm") / f"pgfmd-{os.geteuid()}"
