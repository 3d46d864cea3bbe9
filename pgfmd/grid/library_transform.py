"""The same passes as `transforms.Transform`, left to mpi4py-fft: whole local arrays instead of blocks in cache.

Slower than blocked transforms (`tools/bench/benchmark.py transforms`), but it needs neither pyfftw nor shared memory,
and it shares no code with them, so that each checks the other.
"""

from __future__ import annotations

import numpy as np

from pgfmd.errors import InputError
from pgfmd.grid.transforms import ColumnAction, RowAction
from pgfmd.options.text import printable
from pgfmd.parallel.mpi import MPI, for_library
from pgfmd.parallel.threads import Threads

ROWS = 64  # rows, or columns, handed to a callback at once


class LibraryTransform:
    """Real-to-complex transforms of fields (nx_local, ny) in one precision by mpi4py-fft.  Collective to make.

    Unnormalised in both directions.  Raises InputError if there are more ranks than columns ky.
    """

    def __init__(self, comm: MPI.Comm, shape: tuple[int, int], dtype: np.dtype, threads: Threads) -> None:
        try:
            from mpi4py_fft import PFFT

            comm = for_library(comm)
        except (ImportError, RuntimeError) as error:
            raise InputError(
                f'solver.transform = "mpi4py-fft": needs that package and MPI (tools/setup.sh): {printable(str(error))}'
            ) from None
        columns = shape[1] // 2 + 1
        if comm.size > min(columns, shape[0]):
            raise InputError(
                f'solver.transform = "mpi4py-fft": {comm.size} ranks for a grid of {shape[0]} x {shape[1]} points; '
                f"at most {min(columns, shape[0])} can take part"
            )
        self.real = np.dtype(dtype)
        self.complex = np.result_type(self.real, np.complex64)
        self.cost = self.real.itemsize / 8
        self.threads = threads
        self._fft = PFFT(comm, shape, axes=(0, 1), dtype=self.real, slab=True, threads=threads.count)
        # The library's own arrays, of both directions: the field (nx_local, ny) and its spectrum (nx, nky_local).
        self._field, self._spectrum = self._fft.forward.input_array, self._fft.forward.output_array

    def rows_forward(self, fill: RowAction, filled: tuple[int, int] | None = None) -> None:
        """Real rows, made by `fill(first, stop, rows)`, to their spectrum.  Collective."""
        field = self._field
        self.threads.share(lambda _, a, b: fill(a, b, field[a:b]), len(field), ROWS)
        self._fft.forward(normalize=False)

    def columns(
        self, action: ColumnAction, forward: bool = True, backward: bool = True, count: int | None = None
    ) -> None:
        """As of `Transform`, with `ROWS` columns in a block."""
        spectrum = self._spectrum

        def one(_: int, first: int, stop: int) -> None:
            block = np.empty((stop - first, len(spectrum)), self.complex)
            if forward:
                block[...] = spectrum[:, first:stop].T
            action(block, first, stop)
            if backward:
                spectrum[:, first:stop] = block.T

        self.threads.share(one, spectrum.shape[1] if count is None else count, ROWS)

    def rows_backward(self, drain: RowAction) -> None:
        """The spectrum that the action left to real rows, handed to `drain(first, stop, rows)`.  Collective."""
        self._fft.backward(normalize=False)
        field = self._field
        self.threads.share(lambda _, a, b: drain(a, b, field[a:b]), len(field), ROWS)

    def free(self) -> None:
        """Give memory and communicators back.  Collective."""
        self._fft.destroy()
