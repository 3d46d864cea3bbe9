"""Checkpoints of a load that is not solved yet: the pressure so far, from which the solver can go on.

    checkpoint.h5               pressure (nx, ny), the load's index, the effective job; sealed
    .checkpoint.h5.previous     the one before, used if that one is damaged

Files of one rank count are read on any other.  A start that is wrong cannot make a wrong result, since every solver
certifies what it returns; the seal is what keeps a damaged one from costing time.
"""

from __future__ import annotations

import logging
import os
from contextlib import suppress
from pathlib import Path

import h5py
import numpy as np
from mpi4py import MPI

from pgfmd.io import atomic, hdf5_slabs
from pgfmd.io.schema import CHECKPOINT_FILE
from pgfmd.parallel.collectives import from_root, raise_together

log = logging.getLogger("pgfmd")


class Checkpoints:
    """The checkpoints in a result folder.  Every method is collective.

    rows : slice of the global rows of the grid of that `shape` (nx, ny) which this rank holds
    job : a text that is the same for the same job; checkpoints of another job are left aside
    """

    def __init__(self, comm: MPI.Comm, directory: str | os.PathLike, shape: tuple[int, int], rows: slice, job: str):
        self.comm, self.shape, self.rows, self.job = comm, shape, rows, job
        self.path = Path(directory) / CHECKPOINT_FILE

    def save(self, index: int, pressure: np.ndarray):
        """Write the pressure (nx_local, ny), in any unit, of the unfinished load `index`.  Collective.

        The last good checkpoint stays until this one is whole and on the disk.  Raises OSError on all ranks.
        """
        draft = atomic.temporary(self.path)

        def create(file: h5py.File, name: str) -> h5py.Dataset:
            file.attrs.update(software="pgfmd", load=index, job=self.job)
            return hdf5_slabs.create_dataset(file, name, self.shape, pressure.dtype)

        try:
            fields = {"pressure": hdf5_slabs.Field(pressure, pressure.dtype)}
            hdf5_slabs.write(self.comm, draft, self.rows, fields, create)
            hdf5_slabs.add_seal(self.comm, draft)
            from_root(self.comm, atomic.commit, self.path, True)
        except BaseException:
            if self.comm.rank == 0:
                with suppress(OSError):
                    draft.unlink(missing_ok=True)
            raise

    def load(self, index: int) -> np.ndarray | None:
        """The newest good pressure (nx_local, ny), in an arbitrary unit, of load `index`; None if there is none.
        Collective.
        """
        for path in (self.path, atomic.previous(self.path)):
            if not from_root(self.comm, path.exists):
                continue
            fault = hdf5_slabs.damage(self.comm, path)
            if fault is not None:
                log.warning("%s: %s; it is not used", path, fault)
                continue
            with raise_together(self.comm):
                pressure = self._read(path, index)
            if pressure is not None:
                log.info("load %d goes on from its checkpoint", index + 1)
                return pressure
        return None

    def _read(self, path: Path, index: int) -> np.ndarray | None:
        with h5py.File(path, "r", locking=False) as file:
            if file.attrs["load"] != index or file.attrs["job"] != self.job:
                return None
            return file["pressure"][self.rows]

    def remove(self):
        """Remove all checkpoints.  Collective."""
        from_root(self.comm, self._remove)

    def _remove(self):
        for path in (self.path, atomic.previous(self.path), atomic.temporary(self.path)):
            path.unlink(missing_ok=True)
