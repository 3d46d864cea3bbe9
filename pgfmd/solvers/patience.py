"""How long an outer iteration goes on while its error does not fall."""

from __future__ import annotations

import math

from pgfmd.errors import SolverError, Uncertifiable
from pgfmd.grid.slab_grid import SlabGrid

STEPS = 12  # without halving the least error, before giving up


class Patience:
    """Decides when to give up: after so many steps none of which has halved the least error so far."""

    def __init__(self, steps: int = STEPS) -> None:
        self.steps = self.left = steps
        self.best = math.inf

    @property
    def lost(self) -> int:
        """Steps since the least error was halved."""
        return self.steps - self.left

    def take(self, error: float, best: float | None = None) -> bool:
        """Counts a step; returns whether to go on.  best: the bound to report, where `error` is an estimate."""
        self.left = self.steps if error < 0.5 * self.best else self.left - 1
        self.best = min(self.best, error if best is None else best)
        return self.left > 0

    def failure(self, law: str, grid: SlabGrid, iterations: int, tolerance: float) -> SolverError:
        """What to raise when no step is left."""
        return SolverError(
            f"{law} wall: the certified error stays at {self.best:.1e}, above the tolerance {tolerance:.1e}, after "
            f"{iterations} iterations on {grid.shape[0]} x {grid.shape[1]} points; allow a larger tolerance"
        )


def uncertifiable(rounding: float, tolerance: float) -> Uncertifiable:
    """What to raise where rounding in double precision alone may be an error above the tolerance."""
    return Uncertifiable(
        f"the tolerance {tolerance:.1e} cannot be certified: rounding in double precision may amount to "
        f"{rounding:.1e}; allow a larger tolerance"
    )


SOLVER_SHARE = 0.8  # part of the tolerance that is the solver's, where pressures are stored in single precision


def too_fine_for_single(least: float) -> Uncertifiable:
    """What to raise where single precision cannot certify the tolerance, only about `least`."""
    return Uncertifiable(
        f"the error cannot be certified below about {least:.1e}, by rounding in single precision; allow a larger "
        'tolerance, or take solver.storage = "float64"'
    )
