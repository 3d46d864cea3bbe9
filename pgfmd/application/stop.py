"""When to write a checkpoint and when to stop: clock, signals, a STOP file, time limits.  All ranks decide alike."""

from __future__ import annotations

import logging
import math
import os
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from pgfmd.errors import NoProgress, Stopped
from pgfmd.parallel.collectives import shared
from pgfmd.parallel.mpi import MPI

log = logging.getLogger("pgfmd")

STOP_FILE = "STOP"  # made by a user; it stays
BATCH_STOP_FILE = ".pgfmd.stop"  # made by a batch script that continues later; removed when the next run begins
SIGNALS = (signal.SIGTERM, signal.SIGUSR1, signal.SIGINT, signal.SIGHUP)
SPARE = 2.0  # seconds left before a time limit, in addition to two steps and two checkpoints
GO_ON, SAVE, STOP = range(3)


class Interruptions:
    """Decides between the steps of a solver whether to save or stop; a context manager.

    interval: seconds between checkpoints; time_limit: seconds that the run may take from now; resumption: the option
    that continues this run, for the message.

    Rank 0 reads the clock and looks for files; a signal may reach any rank.  Within the context, if the main thread
    enters it, SIGTERM, SIGUSR1, SIGINT and SIGHUP ask the run to stop, unless they are ignored (as SIGHUP under nohup);
    a second SIGINT ends it at once.  A STOP file from before the context does not count until it is touched again.
    """

    def __init__(
        self,
        comm: MPI.Comm,
        directory: str | os.PathLike,
        interval: float,
        time_limit: float,
        clock: Callable[[], float] = time.monotonic,
    ):
        self.comm, self.interval, self.now = comm, interval, clock
        self.stop_file, self.batch_stop_file = Path(directory) / STOP_FILE, Path(directory) / BATCH_STOP_FILE
        self.resumption = "--restart"
        self._started = self._last_save = self._last_step = self.now()
        end = os.environ.get("SLURM_JOB_END_TIME", "")
        batch = self._started + float(end) - time.time() if end.isdigit() else math.inf
        limits = (self._started + time_limit, "the time limit of the job"), (batch, "the time limit of the batch job")
        self.end, self.limit = min(limits)
        self._longest_step = self._longest_save = 0.0
        self._steps, self._progress = 0, False
        self._signal = 0
        self._earlier_stop: tuple[int, int] | None = None
        self._handlers: dict[int, Any] = {}

    def __enter__(self) -> Interruptions:
        if self.comm.rank == 0:
            self._earlier_stop = _file_stamp(self.stop_file)
            self.batch_stop_file.unlink(missing_ok=True)
        if threading.current_thread() is threading.main_thread():
            heeded = [number for number in SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
            self._handlers = {number: signal.signal(number, self._on_signal) for number in heeded}
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self._signal = number
        if number == signal.SIGINT:
            signal.signal(number, signal.default_int_handler)

    def load_begins(self, resumed: bool) -> None:
        """The solution of a load begins; resumed: from a checkpoint."""
        self._steps = -1 if resumed else 0  # the first step only evaluates the checkpoint

    def load_done(self) -> None:
        """A load is written: the interval begins anew."""
        self._last_save, self._progress = self.now(), True

    def between_steps(self, save: Callable[[], None] | None = None) -> None:
        """If it is time, write a checkpoint by `save()`, which is collective, or stop the run.  Collective.

        save: None if there is nothing to save.  Raises on all ranks Stopped, after a last checkpoint, if the run is to
        end; NoProgress instead if a time limit ends it and the run made no progress past its starting checkpoint.  A
        checkpoint before the last that cannot be written gives a warning only.
        """
        now = self.now()
        self._longest_step = max(self._longest_step, now - self._last_step)
        worst = np.array([self._verdict(now), self._signal])
        self.comm.Allreduce(MPI.IN_PLACE, worst, MPI.MAX)
        verdict, number = map(int, worst)
        self._steps += save is not None
        if verdict != GO_ON and save is not None:
            try:
                save()
                self._progress |= self._steps > 0
            except OSError as error:
                if verdict == STOP or not shared(self.comm, error):
                    raise
                log.warning("no checkpoint could be written, the run goes on: %s", error)
            self._last_save = self.now()
            self._longest_save = max(self._longest_save, self._last_save - now)
        self._last_step = self.now()
        if verdict == STOP:
            raise self.comm.bcast(self._reason(number))

    def _verdict(self, now: float) -> int:
        if self._signal:
            return STOP
        if self.comm.rank != 0:
            return GO_ON
        margin = SPARE + 2 * self._longest_step + 2 * self._longest_save
        if now + margin > self.end or self._stop_file():
            return STOP
        return SAVE if now - self._last_save >= self.interval else GO_ON

    def _stop_file(self) -> Path | None:
        """The file that asks the run to stop."""
        if _file_stamp(self.stop_file) not in (None, self._earlier_stop):
            return self.stop_file
        return self.batch_stop_file if self.batch_stop_file.exists() else None

    def _reason(self, number: int) -> Stopped | NoProgress:
        reason = signal.Signals(number).name if number else f"the file {self._stop_file()}"
        if number or self._stop_file():
            return Stopped(f"stopped by {reason}; continue with {self.resumption}")
        if self._progress:
            return Stopped(f"stopped by {self.limit}; continue with {self.resumption}")
        return NoProgress(
            f"{self.limit} is too short: {self.end - self._started:.0f} s passed without a checkpoint "
            "ahead of the last one; allow more time, or take more ranks"
        )


def _file_stamp(path: Path) -> tuple[int, int] | None:
    """(inode, time of change), which differ after a touch; None if there is no file."""
    try:
        status = os.stat(path)
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns
