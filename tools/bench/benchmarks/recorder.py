"""The clock of one run, which stops while the error is measured."""

import math
import time
from collections.abc import Callable

import numpy as np

LEVELS = (1e-3, 1e-4, 1e-6)  # pressure errors at which costs are compared, and pressures certified


class EnoughError(Exception):
    """Raised by a recorder to end a run: accurate enough, or too long."""


class Recorder:
    """Notes what it cost to get to a pressure, and how far that is from a reference (rows, n); its own work is free.

    A point has `seconds` of wall time, `cpu` (processor time of this process, all threads together), `transforms`, and
    the relative `pressure_error` and `area_error`; and, if it is the first to pass one of `LEVELS`, `certified_error`
    and `energy_error`, which `certify` gives for its pressure, else NaN.  On several ranks `comm` makes the errors
    those of the whole field; the clocks of all ranks stand still together.
    """

    def __init__(
        self, reference: np.ndarray, comm=None, floor: float = 0.0, budget: float = np.inf,
        certify: Callable[[np.ndarray], tuple[float, float]] | None = None,
    ):  # fmt: skip
        self.reference, self.comm, self.floor, self.budget, self.certify = reference, comm, floor, budget, certify
        self.norm, self.contact = self._sums([np.vdot(reference, reference), np.count_nonzero(reference > 0)])
        self.points: list[dict] = []
        self.truncated = False

    def start(self) -> None:
        """Everything from here on counts: set-up, planning, solution."""
        self._barrier()
        self._paused = self._paused_cpu = 0.0
        self._began, self._began_cpu = time.perf_counter(), time.process_time()

    def note(self, pressure: np.ndarray, transforms: float, scale: float = 1.0, may_stop: bool = False) -> None:
        """Take a point.  Collective.  With `may_stop` raises EnoughError once the floor or the budget is passed."""
        now, cpu = time.perf_counter(), time.process_time()
        difference = contact = 0.0
        for first in range(0, len(pressure), 256):
            rows = np.asarray(pressure[first : first + 256])
            rows = rows * scale
            contact += np.count_nonzero(rows > 0)
            rows -= self.reference[first : first + 256]
            difference += np.vdot(rows, rows)
        difference, contact = self._sums([difference, contact])
        point = {
            "seconds": now - self._began - self._paused,
            "cpu": cpu - self._began_cpu - self._paused_cpu,
            "transforms": float(transforms),
            "pressure_error": float(np.sqrt(difference / self.norm)),
            "area_error": float(abs(contact - self.contact) / self.contact),
        }
        least = min((earlier["pressure_error"] for earlier in self.points), default=math.inf)
        passed = self.certify and any(point["pressure_error"] <= level < least for level in LEVELS)
        found = self.certify(np.asarray(pressure) * scale) if passed else (math.nan, math.nan)
        point |= dict(zip(("certified_error", "energy_error"), found, strict=True))
        self.points.append(point)
        # Rank 0 decides for all.
        over = self._from_root(point["seconds"] > self.budget)
        enough = point["pressure_error"] <= self.floor
        self._barrier()
        self._paused += time.perf_counter() - now
        self._paused_cpu += time.process_time() - cpu
        if may_stop and (over or enough):
            self.truncated = over and not enough
            raise EnoughError

    def add_tail(self) -> None:
        """Charge what came after the last point to every one, as if the run had ended there."""
        last = self.points[-1]
        rest = time.perf_counter() - self._began - self._paused - last["seconds"]
        rest_cpu = time.process_time() - self._began_cpu - self._paused_cpu - last["cpu"]
        for point in self.points:
            point["seconds"] += rest
            point["cpu"] += rest_cpu

    def _sums(self, values):
        if self.comm is None:
            return [float(value) for value in values]
        return [float(self.comm.allreduce(float(value))) for value in values]

    def _from_root(self, value):
        return value if self.comm is None else self.comm.bcast(value)

    def _barrier(self) -> None:
        if self.comm is not None:
            self.comm.Barrier()
