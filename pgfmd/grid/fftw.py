"""One-dimensional FFTW plans for blocks of rows, and the wisdom that makes planning instant the second time."""

from __future__ import annotations

import atexit
import contextlib
import os
import platform
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from pgfmd.errors import InputError
from pgfmd.parallel.private_cache import private_folder

sys.modules.setdefault("scipy.fftpack", None)  # type: ignore[arg-type]  # pyfftw would import it: a tenth of the start
try:
    import pyfftw
except ImportError:
    pyfftw = None
finally:
    if sys.modules["scipy.fftpack"] is None:
        del sys.modules["scipy.fftpack"]

PRECISIONS = 3  # FFTW exports its wisdom as three texts: for double, single and long double precision
BETWEEN = b"\0"
_loaded = False


def plan(source: np.ndarray, target: np.ndarray, forward: bool) -> Callable[[], None]:
    """A function without arguments that transforms `source` into `target` along the last axis, unnormalised.

    Real to complex, complex to complex (also in place) or complex to real, as the types say.  Planning overwrites both
    arrays; the function overwrites `source` too.  The planner is not thread-safe; the plans are.  Raises InputError
    without pyfftw.
    """
    if pyfftw is None:
        raise InputError('solver.transform = "blocked": needs the package pyfftw; install it, or choose "mpi4py-fft"')
    _load_wisdom()
    direction = "FFTW_FORWARD" if forward else "FFTW_BACKWARD"
    flags = ("FFTW_MEASURE", "FFTW_DESTROY_INPUT")
    return pyfftw.FFTW(source, target, axes=(source.ndim - 1,), direction=direction, flags=flags, threads=1).execute


def wisdom_file() -> Path | None:
    """Where wisdom is kept, per processor model and pyFFTW version; None if no private folder can be had."""
    folder, model = private_folder(), platform.processor() or platform.machine()
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next((line.split(":", 1)[1] for line in lines if line.startswith("model name")), model)
    name = "".join(c if c.isalnum() else "-" for c in f"{pyfftw.__version__}-{model.strip()}")
    return None if folder is None else folder / f"wisdom-{name}"


def _load_wisdom() -> None:
    """Wisdom of earlier runs, once per process; a file that cannot be read is as good as none."""
    global _loaded
    if not _loaded:
        _loaded = True
        atexit.register(save_wisdom)
        path = wisdom_file()
        with contextlib.suppress(OSError):
            wisdom = () if path is None else tuple(path.read_bytes().split(BETWEEN))
            if len(wisdom) == PRECISIONS:
                pyfftw.import_wisdom(wisdom)


def save_wisdom() -> None:
    """Keep what was learnt, for the next run; by a rename, so that no reader sees half a file.  Quiet where it
    cannot.
    """
    path = wisdom_file()
    if path is None:
        return
    with contextlib.suppress(OSError):
        new = BETWEEN.join(pyfftw.export_wisdom())
        if path.exists() and path.read_bytes() == new:
            return
        with tempfile.TemporaryDirectory(dir=path.parent) as folder:  # which is removed, whatever happens
            file = Path(folder) / path.name
            file.write_bytes(new)
            os.replace(file, path)
