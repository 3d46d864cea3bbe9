"""What every solver returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass
class ContactSolution:
    """Solved contact at one load.  Fields are slabs (nx_local, ny); numbers are the same on all ranks.

    pressure ≥ 0 (exactly 0 outside contact); gap = u − h (zero in hard contact); mean_pressure p̄; mean_gap ⟨gap⟩;
    elastic_energy ½⟨p u⟩ per unit area, without the q = 0 mode; certified_error, a rigorous bound on the energy error
    relative to twice the elastic energy; max_violation, the largest violation of p (u − h) = 0, u ≥ h over the rms
    height; iterations and transforms (pairs, in double-precision equivalents of the finest grid); seconds of wall time.
    """

    pressure: np.ndarray
    gap: np.ndarray
    mean_pressure: float
    mean_gap: float
    elastic_energy: float
    certified_error: float
    max_violation: float
    iterations: int
    transforms: float
    seconds: float
