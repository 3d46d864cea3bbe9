"""The log of a run, DIR/run.log; later runs in the folder append to it."""

from __future__ import annotations

import logging
import time
from logging.handlers import MemoryHandler
from pathlib import Path

LOG_FILE = "run.log"
log = logging.getLogger("pgfmd")


class LogFile:
    """A context manager in which rank 0 buffers log lines until `open`, then writes them to a file.

    A run with wrong input never opens it, and leaves the folder as it was.  A log that cannot be written does not end
    the run.
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
                message = " ".join(str(error).split()) or type(error).__name__
                self._file.handle(log.makeRecord(log.name, logging.ERROR, "", 0, message, (), None))
            log.removeHandler(self._file)
            self._file.close()


class _LossyFile(logging.FileHandler):
    """A log file that drops lines if the disk is full."""

    def handleError(self, record: logging.LogRecord) -> None:
        """Drop the line; the run goes on."""
