"""`compiled`: numba's decorator for the loops of this package.  One process compiles a loop, others load it.

A loop is compiled at its first call with arguments of new types, once for a machine; a default job needs some thirty.
Numba's own cache does not serve:

- processes that compile a loop for different types overwrite its index of types, and then load code for other types
- it loads code although a loop that this calls, in another file, has changed
- every process compiles, and a full disk ends the run
- a start with a first solve takes 1.22 s of processor time, not .93 s

Compiled loops and FFTW's wisdom are executed.  So the user must own the folder that keeps them, and nobody else may
write in it or replace it.  The first of these that can be made, with mode 0700, is used:

    $PGFMD_CACHE/pgfmd, $XDG_CACHE_HOME/pgfmd, ~/.cache/pgfmd
    pgfmd-UID in the folder of temporary files, then in /dev/shm    (a container's user may have no home)
"""

from __future__ import annotations

import contextlib
import fcntl
import functools
import hashlib
import logging
import os
import pickle
import stat
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import IO, Any

import numba
from numba.core.caching import NullCache
from numba.core.compiler import CompileResult
from numba.core.dispatcher import Dispatcher
from numba.core.runtime.nrt import rtsys
from numba.core.serialize import dumps

LONGEST, PAUSE = 60.0, 0.01
"""Longest wait for a lock, whose holder may have been suspended (a loop compiles in 1 to 5 s), and first pause between
attempts, in seconds."""
DIGEST = 32  # bytes of the checksum before the content of a file

log = logging.getLogger("pgfmd")


@functools.cache
def private_folder() -> Path | None:
    """The folder described above, made if missing; None if none is private.  Logs why $PGFMD_CACHE is not used."""
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
    """Write a file, whole or not at all.  A failure, as on a full disk, is logged once for a folder."""
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
    """Takes the lock of this path; waits at most LONGEST for a process that holds it, which may then have made the
    file.  The lock ends when the returned file is closed or the process ends.  None if it cannot be had: go on without.
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
                    time.sleep(max(PAUSE, waited / 10))  # longer and longer, to spare a file server
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
    """Whether others may write, or a group that is not the user's own (the one with the user's number)."""
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


def compiled(**options: Any) -> Callable[[Callable], Any]:
    """A decorator: the function is compiled, and releases the GIL.

    options: of `numba.njit`; inline="always" compiles faster where each loop calls the function in one place.
    """
    settings: dict[str, Any] = {"nogil": True, "no_cfunc_wrapper": True, "error_model": "numpy"} | options

    def decorate(function: Callable) -> Any:
        loop: Any = numba.njit(**settings)(function)
        loop._cache = cache = _Cache(loop)
        compile_or_load = loop.compile

        def compile(types: tuple) -> Any:
            try:
                return compile_or_load(types)
            finally:
                cache.unlock()  # also after an error or an interrupt: other processes may try

        loop.compile = compile
        return loop

    return decorate


class _Cache(NullCache):
    """Compiled code of one loop in the private folder: a file for each combination of types.

    A file's name says all that the code depends on.  So files never change, and readers need no lock.  While a process
    compiles a loop, others that need it wait, then load it.  A process holds only the locks of the loop that it
    compiles and of the callers of that loop: no deadlock.
    """

    def __init__(self, loop: Any) -> None:
        self._loop = loop
        self._lock: IO | None = None

    def load_overload(self, types: tuple, context: Any) -> CompileResult | None:
        """The compiled code, or None if this process is to compile it.

        Unlike numba's own method it leaves `context.refresh`, a quarter of a second, to the compiler.
        """
        rtsys.initialize(context)  # loaded code needs it
        path = self._file(types, context.codegen())
        code = kept(path)
        if code is None and self._lock is None:
            self._lock = locked(path)
            code = kept(path)
        if code is None:
            _announce()
            return None
        return CompileResult._rebuild(context, *pickle.loads(code))

    def save_overload(self, types: tuple, code: Any) -> None:
        """Keep the compiled code for other processes."""
        if not code.library.has_dynamic_globals:
            keep(self._file(types, code.codegen), dumps(code._reduce()))

    def _file(self, types: tuple, codegen: Any) -> Path | None:
        depends = (*_content(self._loop), types, codegen.magic_tuple(), numba.__version__, sys.version)
        folder, name = private_folder(), hashlib.sha256(repr(depends).encode()).hexdigest()[:32]
        return None if folder is None else folder / "loops" / f"{self._loop.__name__}-{name}"

    def unlock(self) -> None:
        """Let other processes load or compile the loop."""
        lock, self._lock = self._lock, None  # one statement: several threads may get here at once
        if lock is not None:
            lock.close()


def _content(loop: Any) -> Iterator[object]:
    """What compiled code depends on besides types: options, byte code, constants, and the loops that the loop calls."""
    function = loop.py_func
    code, names = function.__code__, function.__globals__
    options = {name: sorted(value) if isinstance(value, set) else value for name, value in loop.targetoptions.items()}
    yield function.__module__, function.__qualname__, options
    yield code.co_code, code.co_consts, code.co_names, code.co_varnames
    for value in map(names.get, code.co_names):
        if isinstance(value, Dispatcher):
            yield from _content(value)
        elif not isinstance(value, ModuleType):  # modules are not looked into: constants must be imported by name
            yield value


@functools.cache
def _announce() -> None:
    log.info("compiling for this machine: some seconds, the first time only")
