"""Checkpoints of a load that is not solved yet: its latest pressure, from which the solver can continue.

fields/checkpoint.h5 holds the pressure (nx, ny), the load's index and the effective job.  Any number of ranks reads it.
A damaged one cannot make a result wrong, since every solver certifies what it returns; it would only cost time.
"""

from __future__ import annotations

import logging
import math
import os
from pathlib import Path

import h5py
import numpy as np

from pgfmd.application import hdf5_slabs
from pgfmd.application.files import CHECKPOINT_FILE, temporary
from pgfmd.parallel.collectives import Reduction, from_root, raise_together
from pgfmd.parallel.mpi import MPI

log = logging.getLogger("pgfmd")
ROUNDING = 1e-9  # relative difference of sums over 2⁵⁰ points on different rank counts is far smaller


class Checkpoints:
    """The checkpoint in a folder of fields.  Every method is collective.

    rows: slice of the global rows of the grid of that `shape` (nx, ny) which this rank holds.  job: a text that is the
    same for the same job; checkpoints of another job are ignored.  hints: for MPI-IO, each "name=value".
    """

    def __init__(
        self,
        comm: MPI.Comm,
        folder: str | os.PathLike,
        shape: tuple[int, int],
        rows: slice,
        job: str,
        hints: tuple[str, ...] = (),
    ):
        self.comm, self.shape, self.rows, self.job = comm, shape, rows, job
        self.ranks = hdf5_slabs.Ranks(comm, rows, hints)
        self.path = Path(folder) / CHECKPOINT_FILE

    def save(self, index: int, pressure: np.ndarray) -> None:
        """Write the pressure (nx_local, ny), in any unit, of the unfinished load `index`.  Collective.

        The last checkpoint stays until this one is whole and on the disk.  Raises OSError on all ranks.
        """
        total = self._total(pressure)

        def create(file: h5py.File, name: str) -> h5py.Dataset:
            file.attrs.update(software="pgfmd", load=index, job=self.job, total=total)
            return hdf5_slabs.create_dataset(file, name, self.shape, pressure.dtype)

        hdf5_slabs.replace_by(
            self.ranks, self.path, {"pressure": hdf5_slabs.Field(pressure, pressure.dtype)}, create
        )

    def load(self, index: int) -> np.ndarray | None:
        """The pressure (nx_local, ny), in an arbitrary unit, of load `index`; None if none is saved, or a damaged one.
        Collective.
        """
        total = from_root(self.comm, self._total_of, index)
        if total is None:
            return None
        try:
            with raise_together(self.comm), h5py.File(self.path, "r", locking=False) as file:
                pressure = file["pressure"][self.rows]
                if pressure.shape[1] != self.shape[1]:
                    raise OSError("another shape")
        except Exception as error:  # raised on all ranks
            log.warning("%s: %s; it is not used", self.path, error)
            return None
        if not math.isclose(self._total(pressure), total, rel_tol=ROUNDING):
            log.warning("%s: the pressure is not the one that was written; it is not used", self.path)
            return None
        log.info("load %d continues from its checkpoint", index + 1)
        return pressure

    def remove(self) -> None:
        """Remove the checkpoint.  Collective."""
        from_root(self.comm, self._remove)

    def _total(self, pressure: np.ndarray) -> float:
        """Σ |p| over all points, to twelve digits, which do not depend on the ranks.  Collective."""
        return float(f"{Reduction(self.comm).sum(np.abs(pressure)):.11e}")

    def _total_of(self, index: int) -> float | None:
        """Σ |p| that the checkpoint says, if it is one of that load of this job.  Rank 0."""
        if not self.path.exists():
            return None
        try:
            with h5py.File(self.path, "r", locking=False) as file:
                same = file.attrs["load"] == index and file.attrs["job"] == self.job
                return float(file.attrs["total"]) if same else None
        except Exception as error:  # whatever HDF5 makes of a damaged file
            log.warning("%s: %s; it is not used", self.path, error)
            return None

    def _remove(self) -> None:
        for path in (self.path, temporary(self.path)):
            path.unlink(missing_ok=True)
