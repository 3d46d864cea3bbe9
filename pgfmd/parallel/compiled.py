"""`compiled`: numba's decorator for the loops of this package.  One process compiles a loop, others load it.

A loop is compiled at its first call with arguments of new types, once for a machine; a default job needs some thirty.
Numba's own cache would not do.  It has one index of a loop's types, which processes that compile the same loop for
different types overwrite, so that code for other types is loaded; it runs code whose helpers in other files have
changed; each process compiles; a full disk ends the run; and a start with a first solve takes 1.22 s of processor time,
not .93 s.
"""

from __future__ import annotations

import functools
import hashlib
import logging
import pickle
import sys
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

from pgfmd.parallel.private_cache import keep, kept, locked, private_folder

log = logging.getLogger("pgfmd")


def compiled(**options: Any) -> Callable[[Callable], Any]:
    """A decorator: the function is compiled, and releases the GIL.

    options: of `numba.njit`.  To compile faster: inline="always" for a function that loops call in one place each.
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
        lock, self._lock = self._lock, None  # at once: threads may end at the same time
        if lock is not None:
            lock.close()


def _content(loop: Any) -> Iterator[object]:
    """What a loop compiles to, but for the types: its options, byte code, constants and the loops that it calls."""
    function = loop.py_func
    code, names = function.__code__, function.__globals__
    options = {name: sorted(value) if isinstance(value, set) else value for name, value in loop.targetoptions.items()}
    yield function.__module__, function.__qualname__, options
    yield code.co_code, code.co_consts, code.co_names, code.co_varnames
    for value in map(names.get, code.co_names):
        if isinstance(value, Dispatcher):
            yield from _content(value)
        elif not isinstance(value, ModuleType):  # of NumPy and Python; constants are to be imported by name
            yield value


@functools.cache
def _announce() -> None:
    log.info("compiling for this machine: some seconds, the first time only")
