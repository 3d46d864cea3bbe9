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
import os
import stat
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from pgfmd.parallel.mpi import first_of_node

HEAD_START, PAUSE = 2.0, 0.01
"""Seconds that a rank which is not the first of its node waits at most for that one to take a lock, and between its
looks.  The first loop of a process takes longest to compile, so that one rank should compile all."""


@functools.cache
def private_folder() -> Path | None:
    """The folder, made if missing; None if there is no private one."""
    for folder in _candidates():
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            if os.access(folder, os.W_OK | os.X_OK) and is_private(folder):
                return folder
        except OSError:
            continue
    return None


def lock(path: Path, head_start: float = 0.0) -> IO | None:
    """Sleeps until no other process holds the lock of this file, and takes it; the lock ends when the returned file is
    closed or the process ends.  None where the file system has no locks.  After it, look again before making a file.

    head_start: seconds that the first rank of this node gets to take it before this one does.
    """
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        file = open(path, "w+")  # readable too: NFS shares a lock only then
        until = time.monotonic() + (0 if first_of_node() else head_start)
        while time.monotonic() < until and not is_held(file):
            time.sleep(PAUSE)
        fcntl.flock(file, fcntl.LOCK_EX)
        return file
    return None


def is_held(file: IO) -> bool:
    """Whether another process holds the lock of the file for itself."""
    try:
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)  # shared: others that look do not matter
    except BlockingIOError:
        return True
    fcntl.flock(file, fcntl.LOCK_UN)
    return False


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
    try:
        yield Path.home() / ".cache" / "pgfmd"
    except RuntimeError:  # no HOME, and no such user
        pass
    for folder in (tempfile.gettempdir(), "/dev/shm"):
        yield Path(folder) / f"pgfmd-{os.geteuid()}"


def keep_compiled_code() -> None:
    """Have numba keep compiled code in the private folder, not beside the source, where others may write.  Call it
    before loops are imported.  Without a private folder each process compiles for itself (`compiled`).
    """
    folder = private_folder()
    if folder is None:
        return
    os.environ["NUMBA_CACHE_DIR"] = str(folder / "kernels")
    if sys.modules.get("numba"):  # imported already: it has read the variable
        sys.modules["numba"].config.CACHE_DIR = os.environ["NUMBA_CACHE_DIR"]
