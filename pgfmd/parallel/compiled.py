"""`compiled`: numba's decorator for the loops of this package.  One process compiles a loop, others load it.

A loop is compiled at its first call with arguments of new types, once for a machine; a default job needs some thirty.
"""

from __future__ import annotations

import gc
import logging
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import numba
from numba.core import caching, event
from numba.core.runtime.nrt import rtsys

from pgfmd.options.text import counted
from pgfmd.parallel.private_cache import HEAD_START, lock, private_folder

log = logging.getLogger("pgfmd")

FIRST = 4.0  # seconds until the first line of progress; each further one comes after twice as long


def compiled(**options: Any) -> Callable[[Callable], Any]:
    """A decorator: the function is compiled, and releases the GIL.

    options: of `numba.njit`.  To compile faster: inline="always" for a function that loops call in one place each, and
    no_cpython_wrapper=True for one that they call in several; called from Python that would crash.
    """

    settings: dict[str, Any] = {"nogil": True, "no_cfunc_wrapper": True, "error_model": "numpy"} | options

    def decorate(function: Callable) -> Any:
        loop: Any = numba.njit(**settings)(function)
        if private_folder() is not None:
            loop._cache = _SharedCache(function)
        return loop

    return decorate


class _SharedCache(caching.FunctionCache):
    """Numba's cache of one function.  While a process compiles it, others that need it wait, then load it.

    The lock is the kernel's (flock) and ends with its process; without locks, each process compiles.  A process holds
    only the locks of the function it compiles and of the callers of that: no deadlock.
    """

    _lock: IO | None = None

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled code, or None if this process is to compile it.

        Unlike numba's own method it leaves `target_context.refresh`, a quarter of a second, to the compiler.
        """
        rtsys.initialize(target_context)  # loaded code needs it
        found = self._load_overload(sig, target_context)
        if found is None:
            self._lock = lock(Path(self.cache_path) / f"{self._impl.filename_base}.lock", HEAD_START)
            found = self._load_overload(sig, target_context)
            if found is not None:
                self.release()
            elif not self._cache_file._load_index():
                self._remove_outdated()
        return found

    def _remove_outdated(self) -> None:
        """Removes code of an older version of the source.  Numba writes a new index first, then the files of code that
        it names, under the names of the old ones.  A process that reads in between would run old code, perhaps
        for other types ("can't unbox array from PyObject into native value"); if it finds no file, it waits.
        """
        for outdated in Path(self.cache_path).glob(f"{self._impl.filename_base}.*.nbc"):
            outdated.unlink(missing_ok=True)

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save the compiled code, and let waiting processes load it."""
        try:
            super().save_overload(sig, data)
        finally:
            self.release()

    def release(self) -> None:
        """Let other processes load or compile it."""
        if self._lock is not None:
            self._lock.close()
            self._lock = None


class _Compiling(event.Listener):
    """Logs the progress of compiling, and disables garbage collection meanwhile, which would take a tenth of the time.
    """

    def __init__(self) -> None:
        self.depth, self.count, self.seconds = 0, 0, 0.0
        self._began, self._next = 0.0, FIRST
        self._collects = False

    def on_start(self, _: event.Event) -> None:
        """A function begins to compile, perhaps within another one."""
        self.depth += 1
        if self.depth > 1:
            return
        self._began, self._collects = time.monotonic(), gc.isenabled()
        gc.disable()
        if self.count == 0:
            log.info("compiling for this machine: some seconds, the first time only")

    def on_end(self, ended: event.Event) -> None:
        """It is compiled, or compiling failed or was interrupted: then others may try."""
        cache = ended.data["dispatcher"]._cache
        if ended._exc_details is not None and isinstance(cache, _SharedCache):  # `is_failed` of numba says the opposite
            cache.release()
        self.depth -= 1
        if self.depth > 0:
            return
        if self._collects:
            gc.enable()
        now = time.monotonic()
        self.count, self.seconds = self.count + 1, self.seconds + now - self._began
        if self.seconds > self._next:
            self._next = 2 * self.seconds
            log.info("compiled %s in %.1f s", counted(self.count, "loop"), self.seconds)


event.register("numba:compile", _Compiling())
