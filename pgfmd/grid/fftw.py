"""One-dimensional FFTW plans for blocks of rows; FFTW's wisdom, kept on disk, so that each plan is measured once."""

from __future__ import annotations

import contextlib
import importlib.abc
import os
import platform
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np

from pgfmd.errors import InputError
from pgfmd.parallel.private_cache import keep, kept, locked, private_folder


class _Without(importlib.abc.MetaPathFinder):
    """In this thread, until its block ends, a module counts as not installed, unless it has been imported before."""

    def __init__(self, name: str) -> None:
        self.name, self.thread = name, threading.get_ident()

    def __enter__(self) -> None:
        sys.meta_path.insert(0, self)

    def __exit__(self, *error: object) -> None:
        sys.meta_path.remove(self)

    def find_spec(self, name: str, *_: object) -> None:
        if name == self.name and threading.get_ident() == self.thread:
            raise ModuleNotFoundError(name)


try:
    with _Without("scipy.fftpack"):  # pyfftw would import it, and 150 modules with it: .1 s of .5 s
        import pyfftw
except ImportError:
    pyfftw = None

PRECISIONS = 3  # FFTW exports its wisdom as three texts: for double, single and long double precision
SEPARATOR = b"\0"
_planner = threading.Lock()  # pyfftw guards planning with a lock of its own, but not its wisdom
_loaded: tuple[int, int] | None = None  # inode and time of the wisdom file that was read last


def plan(source: np.ndarray, target: np.ndarray, forward: bool) -> Callable[[], None]:
    """A function without arguments that transforms `source` into `target` along the last axis, unnormalised.

    Real to complex, complex to complex (also in place) or complex to real, as the types say.  Planning overwrites both
    arrays; the function overwrites `source` too.  Threads may plan at once.  Raises InputError without pyfftw.
    """
    if pyfftw is None:
        raise InputError('solver.transform = "blocked": needs the package pyfftw; install it, or choose "mpi4py-fft"')
    direction = "FFTW_FORWARD" if forward else "FFTW_BACKWARD"

    def made(*flags: str) -> Callable[[], None]:
        flags = ("FFTW_MEASURE", "FFTW_DESTROY_INPUT", *flags)
        return pyfftw.FFTW(source, target, axes=(source.ndim - 1,), direction=direction, flags=flags, threads=1).execute

    def known() -> Callable[[], None] | None:
        with contextlib.suppress(RuntimeError):  # no wisdom
            return made("FFTW_WISDOM_ONLY")
        return None

    with _planner:
        if (found := known()) or (path := wisdom_file()) is None:
            return found or made()
        _load_wisdom(path)
        if found := known():
            return found
        with locked(path) or contextlib.nullcontext():  # one process plans, others wait and load
            _load_wisdom(path)
            if not (found := known()):
                found = made()
                _save_wisdom(path)
        return found


def wisdom_file() -> Path | None:
    """The wisdom file of this processor model and pyFFTW version; None if there is no private folder."""
    folder, model = private_folder(), platform.processor() or platform.machine()
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next((line.split(":", 1)[1] for line in lines if line.startswith("model name")), model)
    name = "".join(c if c.isalnum() else "-" for c in f"{pyfftw.__version__}-{model.strip()}")
    return None if folder is None else folder / f"fftw-{name}"


def _load_wisdom(path: Path) -> None:
    """Import the wisdom of other processes; a file that cannot be read is ignored."""
    global _loaded
    with contextlib.suppress(OSError):
        found = os.stat(path)
        if (stamp := (found.st_ino, found.st_mtime_ns)) == _loaded:
            return
        wisdom, _loaded = tuple((kept(path) or b"").split(SEPARATOR)), stamp
        if len(wisdom) == PRECISIONS:
            pyfftw.import_wisdom(wisdom)


def _save_wisdom(path: Path) -> None:
    keep(path, SEPARATOR.join(pyfftw.export_wisdom()))
