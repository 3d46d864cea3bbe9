"""Progress of a run on rank 0: a bar on a terminal, one aligned line per outer step in a log file."""

from __future__ import annotations

import logging
import math
import sys
import time

from tqdm import tqdm

log = logging.getLogger("pgfmd")


def is_notebook() -> bool:
    """Whether this process is the kernel of a notebook."""
    return "ipykernel" in sys.modules and "IPython" in sys.modules


class Progress:
    """Shows how the certified error of one load falls to the tolerance; does nothing on other ranks than 0."""

    def __init__(self, rank: int, label: str, shape: tuple[int, int], tolerance: float):
        self.active, self.label, self.shape, self.tolerance = rank == 0, label, shape, tolerance
        self.began = time.perf_counter()
        self.bar = None
        if self.active and (sys.stderr.isatty() or is_notebook()):
            decades = max(1.0, -math.log10(tolerance))
            form = "{desc} |{bar}| {elapsed} {postfix}"
            self.bar = tqdm(total=decades, desc=label, bar_format=form, leave=False)

    def step(self, shape: tuple[int, int], error: float, contact: float, transforms: float) -> None:
        """One outer step on a grid of that shape: certified error, relative contact area, transforms on that grid."""
        if not self.active:
            return
        if self.bar is None:
            if shape == self.shape:
                log.info(
                    "%s  error %8.1e  area %.5f  transforms %6.1f  %8.1f s",
                    self.label, error, contact, transforms, time.perf_counter() - self.began,
                )  # fmt: skip
            return
        if shape == self.shape and 0 < error < 1:
            self.bar.n = min(self.bar.total, -math.log10(error))
        self.bar.set_postfix_str(f"{shape[0]} × {shape[1]}, error {error:.1e}")

    def close(self) -> None:
        """Clear the bar."""
        if self.bar is not None:
            self.bar.close()
