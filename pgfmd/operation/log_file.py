"""What a run says is kept beside its results, in DIR/run.log; later runs in the folder add to it."""

from __future__ import annotations

import logging
import time
from logging.handlers import MemoryHandler
from pathlib import Path

LOG_FILE = "run.log"
log = logging.getLogger("pgfmd")


class LogFile:
    """A context manager, within which rank 0 keeps what is logged; after `open` it goes to a file.

    A run that is refused does not open it, and so leaves its folder as it was.  A log that cannot be written does not
    end the run.
    """

    def __init__(self, rank: int) -> None:
        self._active, self._began = rank == 0, time.time()
        self._file: logging.FileHandler | None = None
        self._kept = MemoryHandler(10**4, flushLevel=logging.CRITICAL + 1, flushOnClose=False)

    def open(self, directory: Path, title: str) -> None:
        """Begin, or go on with, the file in that folder; `title`, of the time when this object was made, stands before
        what was logged since.
        """
        if not self._active or self._file is not None:
            return
        try:
            self._file = _Quiet(directory / LOG_FILE, encoding="utf-8")
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


class _Quiet(logging.FileHandler):
    """A file whose disk may be full."""

    def handleError(self, record: logging.LogRecord) -> None:
        """A line is lost; the run goes on."""
