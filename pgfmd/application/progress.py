"""Progress of a run on rank 0: one updating line on a terminal or in a notebook, else a line of the log per step."""

from __future__ import annotations

import logging
import math
import sys
import time
from collections.abc import Callable

from tqdm import tqdm

from pgfmd.application.estimate import duration

log = logging.getLogger("pgfmd")
STEP = logging.INFO - 1  # level of a line per step, for logs that show no updating line


def is_notebook() -> bool:
    """Whether this process is the kernel of a notebook."""
    return "ipykernel" in sys.modules and "IPython" in sys.modules


def updates() -> bool:
    """Whether one line is shown and updated: on a terminal, or in a notebook."""
    return sys.stderr.isatty() or is_notebook()


class Progress:
    """Shows how the certified error of each load falls to the tolerance, and what time is left; does nothing on other
    ranks than 0.

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
        """A load is begun."""
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
        """The load is done with: written, or not reachable."""
        self.done, self.share = self.done + 1, 0.0

    def hide(self) -> None:
        """Clear the line."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None

    def left(self) -> str:
        """The time that is left, in words, if the loads to come take as long as those done: "" before the first."""
        if self.done == 0 or self.done == self.loads:
            return ""
        done = self.done + self.share
        return f"; about {duration((self.now() - self.began) * (self.loads - done) / done)} left"
