"""Progress of a run on rank 0: one updating line on a terminal or in a notebook, else a line of the log per step; and
the log file of a run, DIR/run.log, to which later runs in the folder append.
"""

from __future__ import annotations

import logging
import math
import sys
import time
from collections.abc import Callable
from logging.handlers import MemoryHandler
from pathlib import Path

from tqdm import tqdm

from pgfmd.options.text import duration, reason

log = logging.getLogger("pgfmd")
LOG_FILE = "run.log"
STEP = logging.INFO - 1  # level of a line per step, for logs that show no updating line


def updates() -> bool:
    """Whether one line is shown and updated: on a terminal, or in a notebook."""
    return sys.stderr.isatty() or {"ipykernel", "IPython"} <= sys.modules.keys()


class Progress:
    """Shows, on rank 0, the certified error of each load as it falls to the tolerance, and the time that is left.

    loads: how many are to be solved; shape: of the grid; clock: in seconds
    """

    def __init__(
        self,
        rank: int,
        loads: int,
        shape: tuple[int, int],
        tolerance: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.active, self.loads, self.shape, self.tolerance, self.now = rank == 0, loads, shape, tolerance, clock
        self.done, self.share, self.label = 0, 0.0, ""
        self.began = self.load_began = clock()
        self._decades = max(1.0, -math.log10(tolerance))
        self._bar: tqdm | None = None

    def begin(self, label: str) -> None:
        """A load begins."""
        self.label, self.share, self.load_began = label, 0.0, self.now()
        if self.active and updates():
            form = "{desc} |{bar}| {elapsed} {postfix}"
            self._bar = tqdm(total=self._decades, desc=label, bar_format=form, leave=False)

    def step(self, shape: tuple[int, int], error: float, contact: float, transforms: float) -> None:
        """One outer step on a grid of that shape: certified error, relative contact area, transforms on that grid."""
        if not self.active:
            return
        if shape == self.shape:
            if 0 < error < 1:
                self.share = min(1.0, -math.log10(error) / self._decades)
            log.log(
                STEP, "%s  error %8.1e  area %.5f  transforms %6.1f  %8.1f s",
                self.label, error, contact, transforms, self.now() - self.load_began,
            )  # fmt: skip
        if self._bar is not None:
            self._bar.n = self.share * self._decades
            self._bar.set_postfix_str(f"{shape[0]} × {shape[1]}, error {error:.1e}{self.left()}")

    def end(self) -> None:
        """The load has ended: written, or unreachable."""
        self.done, self.share = self.done + 1, 0.0

    def hide(self) -> None:
        """Clear the line."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None

    def left(self) -> str:
        """The time that is left, in words, if further loads take as long as those done; "" before the first."""
        if self.done == 0 or self.done == self.loads:
            return ""
        done = self.done + self.share
        return f"; about {duration((self.now() - self.began) * (self.loads - done) / done)} left"


class LogFile:
    """A context manager in which rank 0 buffers log lines until `open`, then writes them to a file.

    A run with wrong input never opens the file, so that the folder stays as it was.  A run goes on without its log if
    that cannot be written.
    """

    def __init__(self, rank: int) -> None:
        self._active, self._began = rank == 0, time.time()
        self._file: logging.FileHandler | None = None
        self._kept = MemoryHandler(10**4, flushLevel=logging.CRITICAL + 1, flushOnClose=False)

    def open(self, directory: Path, title: str) -> None:
        """Open the file in that folder; write `title`, dated when this object was made, and the buffered lines."""
        if not self._active or self._file is not None:
            return
        try:
            self._file = _LossyFile(directory / LOG_FILE, encoding="utf-8")
        except OSError as error:
            log.warning("%s: no log is written there: %s", directory / LOG_FILE, error.strerror)
            return
        self._file.setFormatter(logging.Formatter("%(asctime)s  %(message)s", "%Y-%m-%d %H:%M:%S"))
        began = log.makeRecord(log.name, logging.INFO, "", 0, title, (), None)
        began.created = self._began
        self._file.handle(began)
        self._kept.setTarget(self._file)
        self._kept.flush()
        log.removeHandler(self._kept)
        log.addHandler(self._file)

    def __enter__(self) -> LogFile:
        if self._active:
            log.addHandler(self._kept)
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        log.removeHandler(self._kept)
        self._kept.close()
        if self._file is not None:
            if error is not None:
                self._file.handle(log.makeRecord(log.name, logging.ERROR, "", 0, reason(error), (), None))
            log.removeHandler(self._file)
            self._file.close()


class _LossyFile(logging.FileHandler):
    """A log file that drops lines if the disk is full."""

    def handleError(self, record: logging.LogRecord) -> None:
        """Drop the line; the run goes on."""
