"""What a part of a run costs, as each part declares it for `pgfmd check`.  No MPI here."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Cost:
    """Work in transforms of the grid (forward and backward, double precision); memory in bytes per grid point,
    without that of the heights, the pressure and the gap.
    """

    transforms: float = 0.0
    memory: float = 0.0
