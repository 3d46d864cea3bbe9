"""Checkpoints of a load that is not solved yet: its latest pressure, from which the solver can continue.

    checkpoint.h5               pressure (nx, ny), the load's index, the effective job; sealed
    .checkpoint.h5.previous     the checkpoint before it, read if checkpoint.h5 is damaged
    .checkpoint.h5.new          the checkpoint of a run that is to replace results, until it has replaced them

A checkpoint can be read on any number of ranks.  A damaged one cannot make a result wrong, since every solver certifies
what it returns; it would only cost time.  Its seal (`checksum`) saves that.
"""

from __future__ import annotations

import logging
import os
from pathlib import Path

import h5py
import numpy as np

from pgfmd.application import atomic, checksum, hdf5_slabs
from pgfmd.application.files import CHECKPOINT_FILE
from pgfmd.parallel.collectives import from_root
from pgfmd.parallel.mpi import MPI

log = logging.getLogger("pgfmd")


class Checkpoints:
    """The checkpoints in a result folder.  Every method is collective.

    rows : slice of the global rows of the grid of that `shape` (nx, ny) which this rank holds
    job : a text that is the same for the same job; checkpoints of another job are ignored
    hints : for MPI-IO, each "name=value"

    aside : `save` writes the file .new, since checkpoint.h5 belongs to results that are still to be replaced
    """

    def __init__(
        self,
        comm: MPI.Comm,
        directory: str | os.PathLike,
        shape: tuple[int, int],
        rows: slice,
        job: str,
        hints: tuple[str, ...] = (),
    ):
        self.comm, self.shape, self.rows, self.job = comm, shape, rows, job
        self.ranks = hdf5_slabs.Ranks(comm, rows, hints)
        self.path = Path(directory) / CHECKPOINT_FILE
        self.aside = False

    def save(self, index: int, pressure: np.ndarray) -> None:
        """Write the pressure (nx_local, ny), in any unit, of the unfinished load `index`.  Collective.

        The last good checkpoint stays until this one is whole and on the disk.  Raises OSError on all ranks.
        """

        def create(file: h5py.File, name: str) -> h5py.Dataset:
            file.attrs.update(software="pgfmd", load=index, job=self.job)
            return hdf5_slabs.create_dataset(file, name, self.shape, pressure.dtype)

        path = atomic.successor(self.path) if self.aside else self.path
        fields = {"pressure": hdf5_slabs.Field(pressure, pressure.dtype)}
        hdf5_slabs.replace_by(self.ranks, path, fields, create, not self.aside)

    def load(self, index: int) -> np.ndarray | None:
        """The newest good pressure (nx_local, ny), in an arbitrary unit, of load `index`; None if there is none.
        Collective.
        """
        for path in (atomic.successor(self.path), self.path, atomic.previous(self.path)):
            if not from_root(self.comm, self._belongs, path, index):
                continue
            pressure, fault = hdf5_slabs.read(self.comm, path, self.rows, "pressure")
            if fault is None:
                log.info("load %d continues from its checkpoint", index + 1)
                return pressure
            log.warning("%s: %s; it is not used", path, fault)
        return None

    def _belongs(self, path: Path, index: int) -> bool:
        """Whether the file is a checkpoint of that load of this job with a good seal; the numbers are not read."""
        if not path.exists():
            return False
        _, fault = checksum.read_seal(path)
        if fault is not None:
            log.warning("%s: %s; it is not used", path, fault)
            return False
        with h5py.File(path, "r", locking=False) as file:
            return file.attrs["load"] == index and file.attrs["job"] == self.job

    def remove(self) -> None:
        """Remove all checkpoints; the next one is written to checkpoint.h5 (`aside` becomes False).  Collective."""
        from_root(self.comm, self._remove)
        self.aside = False

    def _remove(self) -> None:
        for path in (self.path, atomic.previous(self.path), atomic.successor(self.path)):
            path.unlink(missing_ok=True)
            atomic.temporary(path).unlink(missing_ok=True)
