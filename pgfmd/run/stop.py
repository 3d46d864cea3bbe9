"""When to write a checkpoint and when to stop: clock, signals, a STOP file, the time limits.  Alike on all ranks."""

from __future__ import annotations

import logging
import math
import os
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from mpi4py import MPI

from pgfmd.errors import Stopped

log = logging.getLogger("pgfmd")

STOP_FILE = "STOP"
SIGNALS = (signal.SIGTERM, signal.SIGUSR1)
SPARE = 2.0  # seconds kept before a time limit, beside what steps and checkpoints take
GO_ON, SAVE, STOP = range(3)


class Watch:
    """Looks at the clock and listens to signals between the steps of a solver; a context manager.

    interval : seconds between checkpoints;  time_limit : seconds that the run may take from now

    The clock and the STOP file are rank 0's, a signal may reach any rank.  Handlers of SIGTERM and SIGUSR1 are in place
    within the context, if it is entered by the main thread; a STOP file from before is taken away.
    """

    def __init__(
        self,
        comm: MPI.Comm,
        directory: str | os.PathLike,
        interval: float,
        time_limit: float,
        clock: Callable[[], float] = time.monotonic,
    ):
        self.comm, self.interval = comm, interval
        self.stop_file = Path(directory) / STOP_FILE
        self.now = clock
        self.end, self.limit = min((self.now() + time_limit, "the time limit of the job"), _batch_limit(self.now()))
        self._saved = self._seen = self.now()
        self._longest_step = self._longest_save = 0.0
        self._signal = 0
        self._handlers: dict[int, object] = {}

    def __enter__(self) -> Watch:
        if self.comm.rank == 0:
            self.stop_file.unlink(missing_ok=True)
        if threading.current_thread() is threading.main_thread():
            self._handlers = {number: signal.signal(number, self._note) for number in SIGNALS}
        return self

    def __exit__(self, *error):
        for number, handler in self._handlers.items():
            signal.signal(number, handler)

    def _note(self, number: int, frame):
        self._signal = number

    def look(self, save: Callable[[], None] | None = None):
        """Between two steps: write a checkpoint by `save()`, itself collective, if it is time to.  Collective.

        Raises Stopped on all ranks if the run is to end, after a checkpoint (if there is anything to save).  One on the
        clock that cannot be written is a warning: the run may well end before it is needed.
        """
        now = self.now()
        self._longest_step = max(self._longest_step, now - self._seen)
        worst = np.array([self._verdict(now), self._signal])
        self.comm.Allreduce(MPI.IN_PLACE, worst, MPI.MAX)
        verdict, number = map(int, worst)
        if verdict != GO_ON and save is not None:
            try:
                save()
            except OSError as error:
                if verdict == STOP:
                    raise
                log.warning("no checkpoint could be written, the run goes on: %s", error)
            self.load_done()
            self._longest_save = max(self._longest_save, self.now() - now)
        self._seen = self.now()
        if verdict == STOP:
            raise Stopped(f"stopped by {self.comm.bcast(self._reason(number))}; go on with --restart")

    def load_done(self):
        """Everything so far is written: the interval begins anew."""
        self._saved = self.now()

    def _verdict(self, now: float) -> int:
        if self._signal:
            return STOP
        if self.comm.rank != 0:
            return GO_ON
        margin = SPARE + 2 * self._longest_step + 2 * self._longest_save
        if now + margin > self.end or self.stop_file.exists():
            return STOP
        return SAVE if now - self._saved >= self.interval else GO_ON

    def _reason(self, number: int) -> str:
        if number:
            return signal.Signals(number).name
        return f"the file {self.stop_file}" if self.stop_file.exists() else self.limit


def _batch_limit(now: float) -> tuple[float, str]:
    """When the batch system ends this job, on the clock whose present reading is `now`; inf if it does not say."""
    end = os.environ.get("SLURM_JOB_END_TIME", "")
    return (now + float(end) - time.time() if end.isdigit() else math.inf), "the time limit of the batch job"
