"""What every solver returns, and when and how it gives up."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from pgfmd.errors import SolverError, Uncertifiable
from pgfmd.grid.slab_grid import SlabGrid

Precision = type[np.float32] | type[np.float64]

STEPS = 12  # of an outer iteration without halving the least error, before giving up
SOLVER_SHARE = 0.8  # part of the tolerance that is the solver's, where pressures are stored in single precision


class SolverState(Protocol):
    """The state of any solver between steps: pressure and gap (nx_local, ny) in its own units, the level in contact as
    the gap is measured (that of distances is base + level), certified error, points in contact, iterations, an estimate
    of ‖p − p*‖/‖p‖, and the shift: row i of the fields is row i + shift of the periodic cell, other than 0 only within
    a relaxation.
    """

    pressure: np.ndarray
    gap: np.ndarray
    base: float
    level: float
    error: float
    contact: int
    iterations: int
    pressure_error: float
    shift: int


Monitor = Callable[[SlabGrid, SolverState], None]
"""(grid, state): called after each outer step.  On several ranks fields may be shifted: see `pressure_in_place`."""


def pressure_in_place(grid: SlabGrid, state: SolverState) -> np.ndarray:
    """The pressure (nx_local, ny) of a state that a monitor sees, each row in its place in the cell.  Collective."""
    if state.shift == 0:
        return state.pressure
    first = grid.rows.start - state.shift
    return grid.layout.fetch(state.pressure, first, first + len(state.pressure))


@dataclass(frozen=True)
class Certificate:
    """A bound on the distance of a solution from a minimum of its energy.

    error: of E − E* over 2 E_el.  minimum: "global", or "local": the nearest, where the energy has several.  bound:
    "proved", or "estimated" where a number in it is.  control: what was held when the energy was minimised.
    """

    error: float
    minimum: str = "global"
    bound: str = "proved"
    control: str = "pressure"


@dataclass
class ContactSolution:
    """Solved contact at one load.  Fields are slabs (nx_local, ny); numbers are the same on all ranks.

    pressure (exactly 0 outside hard contact, unless the wall attracts); gap = u − h + plastic_depth (zero in hard
    contact); plastic_depth, by how much a wall of limited hardness has yielded (0 elsewhere and under other walls);
    mean_pressure p̄; mean_gap ⟨gap⟩ and mean_plastic_depth of the whole surface; elastic_energy E_el = ½⟨p u⟩ per unit
    area, without the q = 0 mode; certificate, that of the energy that the solution minimises (convex laws: J of
    `physics.laws.law`; errors of gaps and of E_el are of first order in p − p*, and the active set computes them in
    single precision where that certifies p), or the reason why there is none; max_violation, the largest violation of
    the law over the rms height; iterations and transforms (pairs, in double-precision equivalents of the finest grid);
    seconds of wall time; threshold, the pressure above which a point counts as in contact (0 but under laws that touch
    everywhere; −inf: points of gap 0 do); approach of the solid from where the undeformed one touches the highest
    point; pressure_error, an estimate of ‖p − p*‖₂/‖p*‖₂ (NaN where the solver gives none);
    details, further numbers of the solver; cut, mean_gap less what it was before gaps in contact were set to 0, on an
    open patch.
    """

    pressure: np.ndarray
    gap: np.ndarray
    mean_pressure: float
    mean_gap: float
    elastic_energy: float
    certificate: Certificate | str
    max_violation: float = 0.0
    iterations: int = 0
    transforms: float = 0.0
    seconds: float = 0.0
    threshold: float = 0.0
    approach: float = math.nan
    pressure_error: float = math.nan
    plastic_depth: np.ndarray = None  # type: ignore[assignment]  # zeros, if not given
    mean_plastic_depth: float = 0.0
    details: Mapping[str, float] = field(default_factory=dict)
    cut: float = 0.0

    def __post_init__(self) -> None:
        if self.plastic_depth is None:
            self.plastic_depth = np.zeros(self.pressure.shape)  # pages that are not written take no memory

    @property
    def certified_error(self) -> float:
        """That of the certificate; NaN without one."""
        return self.certificate.error if isinstance(self.certificate, Certificate) else math.nan

    def pressure_in_contact(self) -> np.ndarray:
        """The pressure (nx_local, ny), 0 at points that do not count as in contact, and the least positive number at
        those that touch under tension; not a copy if that changes none.
        """
        if self.threshold == -math.inf:
            out = np.maximum(self.pressure, np.finfo(float).tiny)
            return np.multiply(out, self.gap == 0, out=out)
        return np.where(self.pressure > self.threshold, self.pressure, 0.0) if self.threshold > 0 else self.pressure


Solve = Callable[..., ContactSolution | None]
"""solve(problem, start=pressure to start from, or None, …): the contact, or None if that fails.  Collective."""


class Patience:
    """Decides when to give up: after so many steps none of which has halved the least error so far."""

    def __init__(self, steps: int = STEPS) -> None:
        self.steps = self.left = steps
        self.best = math.inf

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
