"""Contact under a law that attracts: Newton's method in the gap.

With u = g + h (g: gap, h: heights) the contact minimises E(g) = ½⟨g + h, K(g + h)⟩ + ΣW(g) over gaps g ≥ least, at a
mean gap, or at a load, or with a spring between the two.  Points are free where g > least or the force
f = K(g + h) + W'(g) opens them; there r = f − μ is to vanish, where μ = −p̄ is the mean of f at an imposed mean gap.

Each step solves (K + W'')δ = −r on the free points by conjugate gradients, preconditioned by the compliance between
them.  Where these meet a direction of negative curvature, the step follows it downhill, to the trust radius.  A step is
taken only if the energy falls along the whole way, so that the contact stays on its branch: it is convex there, or its
slope is negative at four points.  If no fraction of a step is, the step without W'' replaces it (convex–concave
procedure; Yuille and Rangarajan 2003, doi:10.1162/08997660360581958): W is concave, so that the energy falls all along.

Gaps count in the range ρ of the law, pressures in σ₀ = w/ρ.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from pgfmd.errors import SolverError, Unreachable
from pgfmd.grid.callbacks import ColumnAction, sink
from pgfmd.grid.kernels import jit, u
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.physics.laws.adhesive import AttractiveWall
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.nondimensional import mean_compliance

RADIUS, LARGEST_RADIUS, NEAR = 3.0, 20.0, 4.0  # trust radius: first, largest; for points whose gap is less
MOST_STEPS, MOST_INNER, HALVINGS, CAREFUL = 1000, 200, 12, 40
SAME = 1e-14  # change of the energy, over the sum of its parts, that may be rounding
FLOOR = 1e-3  # part of the law's energy that counts as elastic where there is less of that
NOTHING = 1e-10  # energy per point, over w, that is none
GONE = 1e-9  # energy of the law per point, over w, below which the surfaces have separated
FORCING = 0.03, 0.4, 0.7  # least and largest accuracy of a direction, and that of the last over what is left to do
LANCZOS = 20  # steps of `curvature`: right to 10 % in 10 of 12 states
WAYS = 0.25, 0.5, 0.75, 1.0
Pair = tuple[np.ndarray, np.ndarray]
Goal = Callable[[float], float]


@dataclass(frozen=True)
class Hold:
    """What is held: the mean gap (spring inf), or the force of a spring on it, load + spring · (mean gap − gap)."""

    name: str
    gap: float = 0.0
    load: float = 0.0
    spring: float = math.inf

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


@dataclass
class AdhesiveState:
    """A contact in units of the law.

    gap, stress: g and K(g + h) (nx_local, ny); mean: mean gap; elastic: ⟨u, Ku⟩/2 and law: ΣW, per point; square:
    ⟨r, Gr⟩ per point; curvature: an estimate of the least ν with K + W'' ≥ νK, from inner iterations; negative: whether
    one followed negative curvature; error: energy error over 2 E_el; drop: by how much the steps lowered the energy
    """

    gap: np.ndarray
    stress: np.ndarray
    mean: float = 0.0
    elastic: float = 0.0
    law: float = 0.0
    pull: float = 0.0  # μ
    square: float = math.inf
    curvature: float = 1.0
    error: float = math.inf
    contact: int = 0
    near: int = 0  # points with a gap below ρ
    iterations: int = 0
    inner: int = 0
    refused: int = 0
    negative: bool = False
    drop: float = 0.0
    residual: float = math.inf
    level: float = 0.0
    pressure_error: float = math.nan
    pressure: np.ndarray = field(default_factory=lambda: np.empty(0))

    @property
    def energy(self) -> float:
        """Elastic energy and that of the law, per point, over w."""
        return self.elastic + self.law

    @property
    def scale(self) -> float:
        """4 E_el of which errors are parts, or a little of the energy of the law where hardly anything is deformed."""
        return 4 * max(self.elastic, 0.0) + FLOOR * abs(self.law) + NOTHING


class AdhesiveContact:
    """The energy of one surface and its minimisation.  Collective to make.

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
        below = (problem.heights - self.top) / self.length
        solid = problem.solid.in_units(self.length, self.pressure)
        self.grid, self.spring = patch, solid.mean_stiffness()
        if not patch.domain.wraps:
            self.grid = SlabGrid(patch.comm, patch.torus, patch.period, patch.asked_threads)
            below = self._padded(below, 2 * reduce.min(below) - self.law.farthest)
            modes = solid.modes(patch)  # collective
            self.spring = 1 / reduce.min(modes[0, 0] if patch.columns.start == 0 else math.inf)
        grid, self.share = self.grid, patch.size / self.grid.size
        self.summit = -reduce.sum(below) / grid.size  # highest above the mean height
        self.heights = below + self.summit
        scale = 1 / grid.size
        self.stiffness = {real: solid.apply_stiffness(patch, real, scale) for real in (np.float32, np.float64)}
        self.compliance = solid.apply_compliance(patch, np.float32, scale)
        self.local = mean_compliance(patch, solid)  # of one point
        self.softest = float(solid.compliance(np.array(2 * math.pi / max(grid.lengths))))  # to the longest wave
        self.image, self.search = grid.new_field(np.float32), grid.new_field(np.float32)
        self.free = np.empty(grid.local_shape, np.bool_)

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

    def around(self, gap: np.ndarray) -> np.ndarray:
        """A gap of the patch (nx_local, ny), and the gap beyond it that balances the forces there.  Collective."""
        if self.grid is self.patch:
            return gap
        inside = np.isfinite(self._padded(gap, math.nan))
        found = np.where(inside, self._padded(gap, 0.0), self.law.farthest - self.heights)
        found -= np.where(inside, 0.0, self.grid.reduction.max(np.where(inside, -np.inf, found)) - self.law.farthest)
        hold, none = Hold("displacement", self.summit, spring=self.spring), self.grid.new_field(np.float32)
        none[...] = 0
        for _ in range(3):  # as conjugate gradients are in single precision
            state = self.state(found)
            self.residual(state, hold)
            self.free[...] = ~inside
            start = np.where(inside, 0.0, -state.stress - hold.force(state.mean)).astype(np.float32)
            found += self.conjugate_gradients(start, none, hold, lambda _: 1e-4)[0]
        return found

    def bands(self, work: Callable[[slice], tuple[float, ...]]) -> np.ndarray:
        """The sums of what `work` returns for bands of rows.  Collective."""
        parts = self.grid.threads.collect(lambda a, b: work(slice(a, b)), len(self.heights), self.grid.band)
        return self.grid.reduction.sums(*np.sum(parts, axis=0))

    def with_mean(self, action: ColumnAction, factor: float) -> ColumnAction:
        """The column action, which multiplies the mean by a factor of its own."""
        first_here = self.grid.columns.start == 0 and self.grid.columns.stop > 0

        def act(block: np.ndarray, first: int, stop: int) -> None:
            mean = block[0, 0] * (factor / self.grid.size) if first == 0 and first_here else 0
            action(block, first, stop)
            if first == 0 and first_here:
                block[0, 0] = mean

        return act

    # --- states ---

    def undeformed(self, mean: float) -> np.ndarray:
        """The gap of the undeformed solid, moved to that mean gap, where it overlaps cut off.  Collective."""
        return self.to_mean(np.maximum(self.law.least, self.summit - self.heights), mean, (self.heights,))

    def to_mean(self, gap: np.ndarray, mean: float, rigid: tuple[np.ndarray, ...] = ()) -> np.ndarray:
        """Moves the open points of a gap, in place, to the mean gap; all are then still at least `least`.  Collective.

        rigid: heights of which all points move, to begin with an undeformed solid.
        """
        least = self.law.least
        for _ in range(60):
            total, opened = self.bands(lambda s: (float(gap[s].sum()), float(np.count_nonzero(gap[s] > least))))
            shift = (mean - total / self.grid.size) * self.grid.size / max(opened, 1.0)
            if opened == 0 or abs(shift) <= 1e-15 * abs(mean):
                break
            np.add(gap, shift, out=gap, where=gap > least)
            np.maximum(gap, least, out=gap)
        return gap

    def evaluate(self, gap: np.ndarray, stress: np.ndarray) -> np.ndarray:
        """Sets the stress K(g + h) of a gap.  Collective."""

        def fill(first: int, stop: int, rows: np.ndarray) -> None:
            np.add(gap[first:stop], self.heights[first:stop], out=rows)

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
            work = float(np.vdot(own, stress[s]) + np.vdot(self.heights[s], stress[s]))
            return (
                work, float(self.law.energy(own).sum()), float(own.sum()),
                float(np.count_nonzero(own <= least)), float(np.count_nonzero(own < 1)),
            )  # fmt: skip

        work, law, total, contact, near = self.bands(sums)
        size = self.grid.size
        state.elastic, state.law, state.mean = work / 2 / size, law / size, total / size
        state.contact, state.near = int(contact), int(near)
        return state

    # --- directions ---

    def residual(self, state: AdhesiveState, hold: Hold) -> np.ndarray:
        """−r on the free points, which it chooses, in single precision and over its rms, `state.residual`; sets μ.
        Collective.
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
            self.free[s] = (gap[s] > least) | (force[s] < pull)
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

    def apply(self, action: ColumnAction, source: np.ndarray, drain: Callable[..., tuple[float, float]]) -> np.ndarray:
        """Sums of what `drain` returns of the rows of a convolution in single precision.  Collective."""
        parts: dict[int, tuple[float, float]] = {}

        def fill(first: int, stop: int, rows: np.ndarray) -> None:
            rows[...] = source[first:stop]

        def take(first: int, stop: int, rows: np.ndarray) -> None:
            parts[first] = drain(rows, slice(first, stop))

        self.grid.convolve(fill, action, take, np.float32)
        return self.grid.reduction.sums_of_blocks(parts, 2)

    def conjugate_gradients(
        self, start: np.ndarray, weight: np.ndarray, hold: Hold, wanted: Goal, most: int = MOST_INNER
    ) -> tuple[np.ndarray, bool, float, list[tuple[float, float]]]:
        """(K − weight)x = start on the free points, until ⟨r, Gr⟩ has fallen by wanted(its first value per point)².

        start is overwritten.  Returns x, whether `search` is now a direction of negative curvature, the first ⟨r, Gr⟩
        per point, and (step, ratio) of each iteration, which give the spectrum.  Collective.
        """
        grid, free, z, d, fixed = self.grid, self.free, self.image, self.search, hold.fixed
        soften = self.with_mean(self.compliance, 0.0 if fixed else min(1 / (hold.spring or 1e-300), self.softest))
        stiffen = self.with_mean(self.stiffness[np.float32], 0.0 if fixed else hold.spring)
        threads, rows, inverse = grid.threads, len(free), 1 / self.count if fixed and self.count else 0.0
        residual, x, steps = start, grid.new_field(np.float32), list[tuple[float, float]]()
        x[...] = d[...] = 0

        def precondition() -> tuple[float, float]:
            square, total = self.apply(soften, residual, lambda r, s: masked(r, residual[s], free[s], z[s]))
            return max(square, 0.0), total * inverse

        square, mean = precondition()
        first, before, goal = square, math.inf, wanted(square / grid.size) ** 2 * square
        for _ in range(most):
            if not square > 0 or square <= goal:
                break
            turn = np.float32(square / before), np.float32(mean)
            threads.deal(lambda a, b, t=turn: turned(d[a:b], z[a:b], free[a:b], t), rows)  # type: ignore[misc]
            bend, total = self.apply(stiffen, d, lambda r, s: bent(r, d[s], weight[s], free[s], z[s]))
            if not bend > 0:
                return x, True, first / grid.size, steps
            step, before = square / bend, square
            move = np.float32(step), np.float32(total * inverse)
            threads.deal(
                lambda a, b, m=move: advanced((x[a:b], residual[a:b]), (d[a:b], z[a:b]), free[a:b], m), rows  # type: ignore[misc]
            )
            square, mean = precondition()
            steps.append((step, square / before))
        return x, False, first / grid.size, steps

    def direction(
        self, state: AdhesiveState, hold: Hold, tolerance: float, careful: bool
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Newton's direction and, if one was met, a direction of negative curvature.  careful: without W''.
        Collective.
        """
        start = self.residual(state, hold)
        weight = self.weight(state.gap, 0.0, not careful)
        scale = state.residual**2 / (min(state.curvature, 1.0) * state.scale)

        def wanted(first: float) -> float:
            error, (least, most, last) = first * scale, FORCING
            return max(least, min(most, math.sqrt(error)), last * min(1, math.sqrt(tolerance / error)) if error else 0)

        found, bent_down, square, steps = self.conjugate_gradients(start, weight, hold, wanted)
        state.square = square * state.residual**2
        state.inner += 2 * len(steps) + 1 + bent_down
        if not careful and steps:
            state.curvature = 1e-3 if bent_down else max(least_ritz(steps), 1e-3)
        state.negative |= bent_down
        found *= np.float32(state.residual)
        return found, self.search.copy() if bent_down else None

    def weight(self, gap: np.ndarray, closer: float, all_of_it: bool = True) -> np.ndarray:
        """D = −W'' of gaps that are smaller by `closer`, in single precision; or its negative part.  Collective."""
        out = self.grid.new_field(np.float32)

        def fill(s: slice) -> tuple[float]:
            own = self.law.curvature(np.maximum(gap[s] - closer, self.law.least) if closer else gap[s])
            np.negative(own if all_of_it else np.maximum(own, 0.0), out=out[s], casting="same_kind")
            return (0.0,)

        self.bands(fill)
        return out

    # --- steps ---

    def minimise(
        self,
        gap: np.ndarray,
        hold: Hold,
        tolerance: float,
        see: Callable[[AdhesiveState], None] | None = None,
    ) -> AdhesiveState:
        """The minimum of the energy down from a gap, which it takes over.  Collective.

        Ends when ⟨r, Gr⟩/2ν, ν estimated, is at most the tolerance times 2 E_el, or only rounding is left of it.
        Raises SolverError after `MOST_STEPS`.
        """
        state, radius, careful = self.state(gap), RADIUS, 0
        while state.iterations < MOST_STEPS:
            found, down = self.direction(state, hold, tolerance, careful > 0)
            state.error = state.square / (min(state.curvature, 1.0) * state.scale)
            if hold.spring == 0 and hold.load < 0 and state.law > -GONE:
                raise Unreachable(f"load.{hold.name}: no contact bears that tension, the surfaces separate")
            if see is not None:
                see(state)
            if (state.error <= tolerance and down is None) or state.residual == 0:
                return state
            lowered, radius = self.step(state, hold, (found, down), radius)
            if lowered is None:
                if careful:
                    if state.error <= max(1e3 * tolerance, 1e-9):
                        return state  # rounding
                    break
                careful = 2
                continue
            careful = max(careful - 1, 0)
            state = lowered
        raise SolverError(
            f"adhesive contact: the energy error stays at {state.error:.1e}, above the tolerance {tolerance:.1e}; "
            "allow a larger tolerance, or a finer grid where the process zone is short"
        )

    def step(
        self, state: AdhesiveState, hold: Hold, ways: tuple[np.ndarray, np.ndarray | None], radius: float
    ) -> tuple[AdhesiveState | None, float]:
        """The first state, along fractions of a direction, that passes `fallen`; None if none does.  Collective."""
        found, down = ways
        trials = [found]
        if down is not None:
            work = self.bands(lambda s: (float(np.sum(down[s] * self.slope(state, s))), float(np.abs(down[s]).max())))
            largest = self.grid.reduction.max(np.abs(down))
            down *= np.float32(math.copysign(radius / largest, -work[0]))
            trials.insert(0, found + down)
        for trial in trials:
            near = self.grid.reduction.max(np.abs(np.where(state.gap < self.law.least + NEAR, trial, 0)))
            part = min(1.0, 1.5 * radius / near) if near > 0 else 1.0
            for halving in range(HALVINGS if trial is trials[-1] else 3):
                new = self.moved(state, hold, trial, part)
                if new is not None:
                    return new, min(radius * (2.0 if halving == 0 else 1.0), LARGEST_RADIUS)
                state.refused += 1
                part, radius = part / 2, max(radius / 2, 1e-3)
        return None, RADIUS

    def slope(self, state: AdhesiveState, rows: slice) -> np.ndarray:
        """f − μ of some rows."""
        return state.stress[rows] + self.law.traction(state.gap[rows]) - state.pull

    def moved(self, state: AdhesiveState, hold: Hold, way: np.ndarray, part: float) -> AdhesiveState | None:
        """The state after a part of a way, or None if the energy does not fall all along.  Collective."""
        gap, law = np.maximum(state.gap + part * way.astype(np.float64), self.law.least), self.law
        if hold.fixed:
            self.to_mean(gap, hold.gap)
        stress = self.evaluate(gap, np.empty_like(gap))
        new, size = AdhesiveState(gap, stress), self.grid.size

        def sums(s: slice) -> tuple[float, ...]:
            move, change = gap[s] - state.gap[s], stress[s] - state.stress[s]
            old_bend, new_bend = law.curvature(state.gap[s]), law.curvature(gap[s])
            return (
                float(np.vdot(move, state.stress[s])), float(np.vdot(move, change)),
                float(np.sum(law.energy(gap[s]) - law.energy(state.gap[s]))),
                float(np.vdot(move, np.maximum(-old_bend, -new_bend) * move)), float(move.sum()),
            )  # fmt: skip

        first, second, potential, bend, total = self.bands(sums) / size
        held = hold.energy(state.mean + total) - hold.energy(state.mean)
        change = first + second / 2 + potential + held
        spring = 0.0 if hold.fixed else hold.spring * total * total
        rounding = SAME * (abs(state.elastic) + abs(state.law) + abs(held))
        if not change <= rounding:
            return None
        if second + spring <= bend:  # not convex along the way

            def slopes(s: slice) -> tuple[float, ...]:
                move = gap[s] - state.gap[s]
                return tuple(float(np.vdot(move, law.traction(state.gap[s] + t * move))) for t in WAYS)

            along = self.bands(slopes) / size
            for t, pulled in zip(WAYS, along, strict=True):
                if first + t * second + pulled + hold.force(state.mean + t * total) * total > rounding:
                    return None
        for name in ("inner", "refused", "negative", "curvature"):
            setattr(new, name, getattr(state, name))
        new.iterations, new.error, new.drop = state.iterations + 1, state.error, state.drop - change
        return self.measure(new)

    # --- what can be said ---

    def certified(self, state: AdhesiveState, hold: Hold) -> tuple[float, float, float]:
        """(ν, bound on E − E* of the local minimum per point, distance t of its gaps), ν by Lanczos iterations.

        E(g) − E* ≤ ⟨r, Gr⟩/2ν and |g − g*| ≤ t if K − D̄ ≥ νK with D̄ = D(g − t) and t ≥ 2√(G(0)⟨r, Gr⟩)/ν: the
        energy is convex where gaps change by at most t, and at its rim exceeds that of g.  Collective.
        """
        self.residual(state, hold)  # chooses the free points
        square = state.square * self.grid.size
        far, floor = 4 * math.sqrt(self.local * square) / max(state.curvature, 1e-3), 0.0
        for _ in range(3):
            noise = self.grid.new_field(np.float32)
            seed = np.random.default_rng(7)
            skipped = self.grid.rows.start * self.grid.shape[1]
            seed.bit_generator.advance(skipped)  # type: ignore[attr-defined]
            noise[...] = (seed.random(noise.shape) - 0.5) * self.free
            total = self.grid.reduction.sum(noise)
            if hold.fixed and self.count:
                noise -= np.float32(total / self.count) * self.free
            weight = self.weight(state.gap, far)
            _, negative, _, steps = self.conjugate_gradients(noise, weight, hold, lambda _: 1e-4, LANCZOS)
            floor = min(floor, 0.0) if negative else least_ritz(steps)
            if negative or far >= 2 * math.sqrt(self.local * square) / floor:
                break
            far *= 2
        return floor, square / (2 * floor) / self.grid.size if floor > 0 else math.inf, far


def least_ritz(steps: list[tuple[float, float]]) -> float:
    """The smallest eigenvalue of the tridiagonal matrix of conjugate gradients: an estimate, from above, of that of the
    preconditioned operator.
    """
    if not steps:  # nothing is free
        return 1.0
    from scipy.linalg import eigvalsh_tridiagonal

    lengths, ratios = np.array(steps).T
    diagonal = 1 / lengths
    diagonal[1:] += ratios[:-1] / lengths[:-1]
    return float(eigvalsh_tridiagonal(diagonal, np.sqrt(ratios[:-1]) / lengths[:-1])[0])


@jit
def masked(rows: np.ndarray, residual: np.ndarray, free: np.ndarray, out: np.ndarray) -> tuple[float, float]:
    """out = rows on free points, else 0; returns Σ residual · out and Σ out."""
    square, total = np.float64(0), np.float64(0)
    for i in range(rows.shape[0]):
        for j in range(rows.shape[1]):
            value = rows[i, u(j)] if free[i, u(j)] else np.float32(0)
            out[i, u(j)] = value
            square += np.float64(value) * residual[i, u(j)]
            total += value
    return square, total


@jit
def bent(
    rows: np.ndarray, direction: np.ndarray, weight: np.ndarray, free: np.ndarray, out: np.ndarray
) -> tuple[float, float]:
    """out = rows − weight · direction on free points, else 0; returns Σ direction · out and Σ out."""
    square, total = np.float64(0), np.float64(0)
    for i in range(rows.shape[0]):
        for j in range(rows.shape[1]):
            d = direction[i, u(j)]
            value = rows[i, u(j)] - weight[i, u(j)] * d if free[i, u(j)] else np.float32(0)
            out[i, u(j)] = value
            square += np.float64(value) * d
            total += value
    return square, total


@jit
def turned(direction: np.ndarray, z: np.ndarray, free: np.ndarray, turn: tuple[float, float]) -> None:
    """direction = z − mean + ratio · direction on free points; turn: (ratio, mean)."""
    for i in range(z.shape[0]):
        for j in range(z.shape[1]):
            value = z[i, u(j)] - turn[1] + turn[0] * direction[i, u(j)]
            direction[i, u(j)] = value if free[i, u(j)] else np.float32(0)


@jit
def advanced(pair: Pair, moved: Pair, free: np.ndarray, move: tuple[float, float]) -> None:
    """x += step · d and r −= step · (image − mean) on free points; pair: (x, r), moved: (d, image), move: (step,
    mean).
    """
    x, r = pair
    d, image = moved
    for i in range(x.shape[0]):
        for j in range(x.shape[1]):
            x[i, u(j)] += move[0] * d[i, u(j)]
            change = move[0] * (image[i, u(j)] - move[1])
            r[i, u(j)] -= change if free[i, u(j)] else np.float32(0)
