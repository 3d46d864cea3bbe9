"""A contact under a law that attracts, as a function of its gaps: energy, forces, free points.

Gaps count in the range ρ of the law, pressures in σ₀ = w/ρ.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from pgfmd.grid.aligned import new_field
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.transforms import ColumnAction, sink
from pgfmd.physics.laws.adhesive_laws import AttractiveWall
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.nondimensional import mean_compliance

FLOOR = 1e-3  # part of the law's energy that counts as elastic where there is less of that
APART = 100.0  # mean gap beyond which nothing sticks, over the sum of heights, reach of the law, and of the solid
NOTHING = 1e-10  # energy per point, over w, that is none


@dataclass(frozen=True)
class Hold:
    """What is held: the mean gap (spring inf), or the force of a spring on it, load + spring · (mean gap − gap).
    beyond: how much larger the gap is in truth, where the surfaces are apart in any case: digits would be lost
    """

    name: str
    gap: float = 0.0
    load: float = 0.0
    spring: float = math.inf
    beyond: float = 0.0

    @property
    def fixed(self) -> bool:
        """Whether the mean gap itself is held."""
        return math.isinf(self.spring)

    def force(self, mean: float) -> float:
        """The mean pressure that is imposed at a mean gap."""
        return 0.0 if self.fixed else self.load + self.spring * (mean - self.gap)

    def energy(self, mean: float) -> float:
        """Its potential per point."""
        return 0.0 if self.fixed else self.load * mean + self.spring * (mean - self.gap) ** 2 / 2


class Actions(NamedTuple):
    """Of an inner problem.  fixed: whether its unknowns sum to 0; firm: whether points that are not free are unknowns
    too, of an approximate inverse −1/weight.
    """

    soften: ColumnAction
    stiffen: ColumnAction
    fixed: bool
    firm: bool = False


@dataclass
class AdhesiveState:
    """A contact in units of the law.  gap, stress: g and K(g + h) (nx_local, ny); mean: mean gap; elastic: ⟨u, Ku⟩/2
    and law: ΣW, per point; square: ⟨r, Gr⟩ per point; curvature: an estimate of the least θ with K + W'' ≥ θK, from
    inner iterations; error: energy error over 2 E_el
    """

    gap: np.ndarray
    stress: np.ndarray
    mean: float = 0.0
    elastic: float = 0.0
    law: float = 0.0
    pull: float = 0.0  # μ
    square: float = math.inf
    curvature: float = 1.0
    curvatures: tuple[float, ...] = ()  # of the last three directions; 1 where one was negative
    error: float = math.inf
    contact: int = 0
    attracted: int = 0  # points with a gap below ρ
    iterations: int = 0
    inner: int = 0
    refused: int = 0
    single: bool = False  # whether the stress has the errors of single precision
    residual: float = math.inf
    level: float = 0.0  # this and what follows is for monitors only
    pressure_error: float = math.nan
    shift: int = 0
    base: float = 0.0
    pressure: np.ndarray = field(default_factory=lambda: np.empty(0))

    @property
    def energy(self) -> float:
        """Elastic energy and that of the law, per point, over w."""
        return self.elastic + self.law

    @property
    def scale(self) -> float:
        """4 E_el, by which errors are divided, plus a little of the law's energy if hardly anything is deformed."""
        return 4 * max(self.elastic, 0.0) + FLOOR * abs(self.law) + NOTHING


class AdhesiveModel:
    """The energy of one surface, its derivatives and free points.  Collective to make.

    With open boundaries the unknowns are the gaps on the whole torus of the transforms, where the stiffness is the
    inverse of the compliance: beyond the patch the rigid surface lies so deep that it neither touches nor attracts.
    The mean mode then has a stiffness, as that of a slab on a base (`spring`).

    grid: of the unknowns;  patch: of the surface;  share: points of the patch over those of the torus
    """

    def __init__(self, problem: ContactProblem) -> None:
        assert isinstance(problem.law, AttractiveWall)
        self.patch, self.law, self.problem = problem.grid, problem.law, problem
        self.length, self.pressure = self.law.units
        patch, reduce = self.patch, self.patch.reduction
        self.top = reduce.max(problem.heights)
        solid = problem.solid.in_units(self.length, self.pressure)
        self.grid, self.spring, self.summit = patch, solid.mean_stiffness(), 0.0
        if not patch.domain.wraps:
            below = self.rigid(slice(None))
            self.grid = SlabGrid(patch.comm, patch.torus, patch.period, patch.asked_threads)
            self.below = self._padded(below, 2 * (reduce.min(below) - self.law.farthest))
            modes = solid.modes(patch)  # collective
            self.spring = 1 / reduce.min(modes[0, 0] if patch.columns.start == 0 else math.inf)
        grid, self.share = self.grid, patch.size / self.grid.size
        self.summit = -float(self.bands(lambda s: (float(self.rigid(s).sum()),))[0]) / grid.size  # over the mean height
        scale = 1 / grid.size
        self.stiffness = {real: solid.apply_stiffness(patch, real, scale) for real in (np.float32, np.float64)}
        self.compliance = solid.apply_compliance(patch, np.float32, scale)
        self.local = mean_compliance(patch, solid)  # of one point
        self.softest = float(solid.compliance(np.array(2 * math.pi / max(grid.lengths))))  # to the longest wave
        self.allocate()
        solid_reach = self.softest + (1 / self.spring if self.spring else 0.0)  # of the largest tension, 1
        self.apart = APART * (self.largest(lambda s: np.abs(self.rigid(s))) + self.law.farthest + solid_reach)
        self.coupling = 0.0  # see `adhesive_certificate.least_coupling`

    def allocate(self, wanted: bool = True) -> None:
        """Makes the fields of inner iterations, or frees them."""
        shape = self.grid.local_shape if wanted else (0, 0)
        self.spare, self.free = new_field(shape), np.empty(shape, np.bool_)
        self.image, self.search = self.spare.ravel().view(np.float32).reshape(2, *shape)

    def rigid(self, rows: slice) -> np.ndarray:
        """Heights of some rows above their mean, in units of the law."""
        if self.grid is not self.patch:
            return self.below[rows] + self.summit
        return (self.problem.heights[rows] - self.top) / self.length + self.summit

    def _padded(self, field: np.ndarray, value: float) -> np.ndarray:
        """A field of the patch (nx_local, ny) on the torus, with that value beyond.  Collective."""
        (nx, ny), rows = self.patch.shape, self.grid.rows
        found = np.full(self.grid.local_shape, value)
        first, stop = min(rows.start, nx), min(rows.stop, nx)
        found[: stop - first, :ny] = self.patch.fetch(field, first, stop)
        return found

    def unpadded(self, field: np.ndarray) -> np.ndarray:
        """The part of a field on the torus that lies on the patch (nx_local, ny).  Collective."""
        if self.grid is self.patch:
            return field
        rows = self.grid.fetch(field, self.patch.rows.start, self.patch.rows.stop)
        return np.ascontiguousarray(rows[:, : self.patch.shape[1]])

    def bands(self, work: Callable[[slice], tuple[float, ...]]) -> np.ndarray:
        """The sums of what `work` returns for bands of rows.  Collective."""
        return self.grid.reduction.sums(*np.sum(self.rows(work), axis=0))

    def largest(self, work: Callable[[slice], np.ndarray]) -> float:
        """The largest entry of what `work` returns for bands of rows.  Collective."""
        return self.grid.reduction.max(self.rows(lambda s: work(s).max()))

    def rows(self, work: Callable[[slice], object]) -> list:
        """What `work` returns for each band of rows of this rank."""
        grid = self.grid
        return grid.threads.collect(lambda a, b: work(slice(a, b)), grid.local_shape[0], grid.band)

    def with_mean(self, action: ColumnAction, factor: float) -> ColumnAction:
        """The column action, which multiplies the mean by a factor of its own."""
        first_here = self.grid.columns.start == 0 and self.grid.columns.stop > 0

        def act(block: np.ndarray, first: int, stop: int) -> None:
            mean = block[0, 0] * (factor / self.grid.size) if first == 0 and first_here else 0
            action(block, first, stop)
            if first == 0 and first_here:
                block[0, 0] = mean

        return act

    def actions(self, hold: Hold) -> Actions:
        """Those of compliance and stiffness in single precision, with what holds the mean.  Collective."""
        fixed = hold.fixed
        return Actions(
            self.with_mean(self.compliance, 0.0 if fixed else min(1 / (hold.spring or 1e-300), self.softest)),
            self.with_mean(self.stiffness[np.float32], 0.0 if fixed else hold.spring),
            fixed,
        )

    # --- states ---

    def undeformed(self, mean: float) -> np.ndarray:
        """The gap of the undeformed solid, moved to that mean gap, where it overlaps cut off.  Collective."""
        gap = self.grid.new_field()
        self.rows(lambda s: np.maximum(self.law.least, self.summit - self.rigid(s), out=gap[s]))
        return self.to_mean(gap, mean)

    def to_mean(self, gap: np.ndarray, mean: float) -> np.ndarray:
        """Moves the open points of a gap, in place, to the mean gap, none to less than `least`.  Collective."""
        least = self.law.least
        for _ in range(60):
            total, opened = self.bands(lambda s: (float(gap[s].sum()), float(np.count_nonzero(gap[s] > least))))
            shift = (mean - total / self.grid.size) * self.grid.size / (opened or self.grid.size)
            if abs(shift) <= 1e-15 * abs(mean):
                break
            np.add(gap, shift, out=gap, where=gap > least if opened else True)
            np.maximum(gap, least, out=gap)
        return gap

    def evaluate(self, gap: np.ndarray, stress: np.ndarray) -> np.ndarray:
        """Sets the stress K(g + h) of a gap.  Collective."""

        def fill(first: int, stop: int, rows: np.ndarray) -> None:
            np.add(gap[first:stop], self.rigid(slice(first, stop)), out=rows)

        self.grid.convolve(fill, self.stiffness[np.float64], sink(stress))
        return stress

    def state(self, gap: np.ndarray) -> AdhesiveState:
        """The state of a gap.  Collective."""
        return self.measure(AdhesiveState(gap, self.evaluate(gap, np.empty_like(gap))))

    def measure(self, state: AdhesiveState) -> AdhesiveState:
        """Sets energies, mean gap and points in contact of a state.  Collective."""
        gap, stress, least = state.gap, state.stress, self.law.least

        def sums(s: slice) -> tuple[float, ...]:
            own = gap[s]
            work = float(np.vdot(own, stress[s]) + np.vdot(self.rigid(s), stress[s]))
            return (
                work, float(stress[s].sum()), float(self.law.energy(own).sum()), float(own.sum()),
                float(np.count_nonzero(own <= least)), float(np.count_nonzero(own < 1)),
            )  # fmt: skip

        work, rest, law, total, contact, attracted = self.bands(sums)
        size = self.grid.size
        state.mean, state.law = total / size, law / size
        state.elastic = (work - rest * state.mean) / 2 / size  # the rest is rounding
        state.contact, state.attracted = int(contact), int(attracted)
        return state

    def residual(self, state: AdhesiveState, hold: Hold, shut: float = 0.0) -> np.ndarray:
        """−r on the free points, which it chooses, in single precision and over its rms, `state.residual`; sets μ.
        shut: points that a compliance of that size would close are not free.  Collective.
        """
        gap, stress, least, grid = state.gap, state.stress, self.law.least, self.grid
        force = grid.new_field()

        def forces(s: slice) -> tuple[float, ...]:
            np.add(stress[s], self.law.traction(gap[s]), out=force[s])
            opened = gap[s] > least
            return float(np.sum(force[s], where=opened)), float(np.count_nonzero(opened))

        total, count = self.bands(forces)
        pull = -hold.force(state.mean) if not hold.fixed else total / max(count, 1.0)

        def choose(s: slice) -> tuple[float, ...]:
            self.free[s] = (gap[s] > least + shut * np.maximum(force[s] - pull, 0.0)) | (force[s] < pull)
            inside = self.free[s]
            return float(np.sum(force[s], where=inside)), float(np.count_nonzero(inside))

        for _ in range(3 if hold.fixed else 1):
            total, self.count = self.bands(choose)
            if hold.fixed:
                pull = total / max(self.count, 1.0)
        state.pull = pull

        def squares(s: slice) -> tuple[float]:
            force[s] -= pull
            force[s] *= self.free[s]
            return (float(np.vdot(force[s], force[s])),)

        state.residual = math.sqrt(float(self.bands(squares)[0]) / grid.size)
        out = grid.new_field(np.float32)
        np.multiply(force, -1 / (state.residual or 1.0), out=out, casting="same_kind")
        return out

    def weight(self, gap: np.ndarray) -> np.ndarray:
        """−W'' of gaps in single precision.  Collective."""
        out = self.grid.new_field(np.float32)
        self.rows(lambda s: np.negative(self.law.curvature(gap[s]), out=out[s], casting="same_kind"))
        return out
