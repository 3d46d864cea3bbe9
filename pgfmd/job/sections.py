"""The section [run] of a job.  No MPI here."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pgfmd.options.rules import assignment, many, number
from pgfmd.options.section import Section, key


@dataclass(frozen=True, kw_only=True)
class Run(Section):
    """Checkpoints and time limit of a run, for machines that stop long jobs; how its files are written.  Not compared
    by --restart: it does not change results.
    """

    where = "run"
    checkpoint_interval: float = key(
        number(low=0, infinite=True),
        1800.0,
        "between checkpoints of an unfinished load; 0: each step; inf: none",
        unit="s",
    )
    time_limit: float = key(
        number(above=0, infinite=True), math.inf, "of the run; it stops in time, to be restarted", unit="s"
    )
    io_hints: tuple[str, ...] = key(
        many(assignment()),
        (),
        "for MPI-IO, which ignores unknown ones; stripes are set on the folder (lfs setstripe)",
        example=["cb_nodes=8", "romio_cb_write=enable"],
    )
