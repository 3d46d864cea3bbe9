"""Contact under a law that attracts: Newton's method in the gap.

With u = g + h (g: gap, h: heights) the contact minimises E(g) = ½⟨g + h, K(g + h)⟩ + ΣW(g) over gaps g ≥ least, at a
mean gap, or at a load, or with a spring between the two.  Points are free where g > least or the force
f = K(g + h) + W'(g) opens them; there r = f − μ is to vanish, where μ = −p̄ is the mean of f at an imposed mean gap.

Each step solves (K + W'')δ = −r on the free points by conjugate gradients, preconditioned by the compliance between
them.  Where these meet a direction of negative curvature, the step follows it downhill, to the trust radius.  A step is
taken if the energy decreases along it: it is convex there, or its slope is negative at four points.  This keeps the
contact from crossing barriers of energy.  If no fraction of a step is taken, points about to close are closed, and the
others take the next step.

Gaps count in the range ρ of the law, pressures in σ₀ = w/ρ.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from pgfmd.errors import SolverError, Unreachable
from pgfmd.grid.transforms import sink
from pgfmd.solvers.adhesive_inner import Steps, conjugate_gradients, decrement, least_ritz
from pgfmd.solvers.adhesive_model import AdhesiveModel, AdhesiveState, Hold

RADIUS, LARGEST_RADIUS = 3.0, 20.0  # trust radius: first, largest
MOST_STEPS, HALVINGS = 1000, 12
SAME = 1e-14  # change of the energy, over the sum of its parts, that is rounding in double precision
GONE = 1e-9  # energy of the law per point, over w, below which the surfaces have separated
FORCING = 0.0009, 0.16, 0.49  # share of ⟨r, Gr⟩ that a direction leaves: least, largest, and over tolerance/error
WAYS = 0.25, 0.5, 0.75, 1.0
SINGLE_TO = 1e-5  # energy error above which steps are in single precision: 17 % fewer pairs where contact jumps
Goal = Callable[[AdhesiveState], float]


class AdhesiveContact(AdhesiveModel):
    """The minimisation of the energy of one surface; `see` is called with each state.  Collective to make."""

    see: Callable[[AdhesiveState], None] | None = None

    def around(self, gap: np.ndarray) -> np.ndarray:
        """A gap of the patch (nx_local, ny), and the gap beyond it that balances the forces there.  Collective."""
        if self.grid is self.patch:
            return gap
        inside = np.isfinite(self._padded(gap, math.nan))
        found = np.where(inside, self._padded(gap, 0.0), 2 * self.law.farthest - self.rigid(slice(None)))
        top = self.grid.reduction.max(np.where(inside, -np.inf, found))
        found -= np.where(inside, 0.0, top - 2 * self.law.farthest)
        hold, none = Hold("displacement", self.summit, spring=self.spring), self.grid.new_field(np.float32)
        none[...] = 0
        for _ in range(3):  # as conjugate gradients are in single precision
            state = self.state(found)
            self.residual(state, hold)
            self.free[...] = ~inside
            start = np.where(inside, 0.0, -state.stress - hold.force(state.mean)).astype(np.float32)
            found += conjugate_gradients(self, start, none, self.actions(hold), lambda _, left, __: left <= 1e-8)[0]
        return found

    def direction(self, state: AdhesiveState, hold: Hold, tolerance: float, careful: bool) -> tuple[np.ndarray, bool]:
        """Newton's direction, and whether `search` is one of negative curvature.  careful: points about to close are
        closed at once; else the first of them ends the step.  Collective.
        """
        start = self.residual(state, hold, self.local if careful else 0.0)
        weight = self.weight(state.gap)
        scale = state.residual**2 / (min(state.curvature, 1.0) * state.scale)

        def enough(first: float, left: float, _: Steps) -> bool:
            error, (least, most, last) = first * scale, FORCING
            done = error <= tolerance and not careful
            return done or left <= max(least, min(most, 2 * math.sqrt(error)), last * min(1.0, tolerance / error))

        found, bent_down, square, steps = conjugate_gradients(self, start, weight, self.actions(hold), enough)
        state.square = square * state.residual**2
        state.inner += 2 * len(steps) + 1 + bent_down
        if not careful and steps:
            state.curvature = 1e-3 if bent_down else max(least_ritz(steps)[0], 1e-3)
            state.curvatures = (*state.curvatures[-2:], 1.0 if bent_down else state.curvature)
        state.error = decrement(square, steps, min(state.curvature, 1.0)) * state.residual**2 / state.scale
        found *= np.float32(state.residual)
        if careful:
            np.subtract(self.law.least, state.gap, out=found, where=~self.free, casting="same_kind")
        return found, bent_down and self.largest(lambda s: np.abs(self.search[s])) > 0  # 0 if it underflows

    def minimise(self, gap: np.ndarray, hold: Hold, tolerance: float, goal: Goal | None = None) -> AdhesiveState:
        """The minimum of the energy down from a gap, which becomes that of the minimum.  Collective.

        Ends when ⟨r, Gr⟩/2θ, θ estimated, is at most the tolerance, or a goal for the state, times 2 E_el.  Where no
        step lowers the energy any more, an error of up to 1000 times the tolerance is accepted, and written as
        `certified_error`.  Raises SolverError if `MOST_STEPS` leave a larger error.
        """
        state = self.state(gap)
        ended = self.lowered(state, hold, goal or (lambda _: tolerance))
        if not state.error <= (max(1e3 * tolerance, 1e-9) if ended else tolerance):  # rounding
            raise SolverError(
                f"adhesive contact: the energy error stays at {state.error:.1e}, above the tolerance {tolerance:.1e}; "
                "allow a larger tolerance, or a finer grid where the process zone is short"
            )
        return state

    def lowered(self, state: AdhesiveState, hold: Hold, goal: Goal) -> bool:
        """`minimise` on a state, in place; False if `MOST_STEPS` were taken.  Ends in double precision.  Collective."""
        radius, careful = RADIUS, False
        while state.iterations < MOST_STEPS:
            found, down = self.direction(state, hold, goal(state), careful)
            if hold.spring == 0 and hold.load < 0 and state.law > -GONE:
                raise Unreachable(f"load.{hold.name}: no contact bears that tension, the surfaces separate")
            if self.see is not None:
                self.see(state)
            ended = not careful and ((state.error <= goal(state) and not down) or state.residual == 0)
            if not ended:
                fell, radius = self.step(state, hold, found, down, radius)
                ended, careful = careful and not fell, not fell
            del found
            if ended and state.single:
                self.renew(state)
                careful = False
            elif ended:
                if careful:
                    self.direction(state, hold, goal(state), False)
                return True
        self.renew(state)
        self.direction(state, hold, goal(state), False)
        return False

    def renew(self, state: AdhesiveState) -> None:
        """Stress and energies of a state anew, in double precision.  Collective."""
        self.evaluate(state.gap, state.stress)
        self.measure(state).single = False

    def step(
        self, state: AdhesiveState, hold: Hold, found: np.ndarray, both: bool, radius: float
    ) -> tuple[bool, float]:
        """Moves the state by the first fraction of Newton's direction `found` that `moved` takes; False if it takes
        none.  both: whether `search` is added to it at first.  Also returns the next trust radius.  Collective.
        """
        trials = [(found, HALVINGS)]
        if both:
            down = self.search
            work = self.bands(lambda s: (float(np.sum(down[s] * self.slope(state, s))),))[0]
            down *= np.float32(math.copysign(radius / self.largest(lambda s: np.abs(down[s])), -work))
            trials.insert(0, (found + down, 3))
        for way, halvings in trials:
            most = self.largest(lambda s, w=way: np.abs(w[s]))  # type: ignore[misc]
            part = min(1.0, 1.5 * radius / most) if most > 0 else 1.0
            for halving in range(halvings):
                if self.moved(state, hold, way, part):
                    return True, min(radius * (2.0 if halving == 0 else 1.0), LARGEST_RADIUS)
                state.refused += 1
                part, radius = part / 2, max(radius / 2, 1e-3)
        return False, RADIUS

    def slope(self, state: AdhesiveState, rows: slice) -> np.ndarray:
        """f − μ of some rows."""
        return state.stress[rows] + self.law.traction(state.gap[rows]) - state.pull

    def moved(self, state: AdhesiveState, hold: Hold, way: np.ndarray, part: float) -> bool:
        """Moves the state by a part of a way if the energy falls all along, and says whether it did.  Collective."""
        gap, law = self.grid.new_field(), self.law

        def advance(s: slice) -> None:
            np.multiply(way[s], part, out=gap[s])
            gap[s] += state.gap[s]
            np.maximum(gap[s], law.least, out=gap[s])

        self.rows(advance)
        if hold.fixed:
            self.to_mean(gap, hold.gap)
        single, size = state.error > SINGLE_TO, self.grid.size
        real, stiffened = (np.float32, self.image) if single else (np.float64, self.spare)  # K times the move
        anew = state.single and not single  # then K(g + h), less the old stress

        def fill(first: int, stop: int, rows: np.ndarray) -> None:
            before = -self.rigid(slice(first, stop)) if anew else state.gap[first:stop]
            np.subtract(gap[first:stop], before, out=rows)

        self.grid.convolve(fill, self.stiffness[real], sink(stiffened), real)
        if anew:
            stiffened -= state.stress

        def sums(s: slice) -> tuple[float, ...]:
            move = gap[s] - state.gap[s]
            (old, _, old_bend), (new, _, new_bend) = law.values(state.gap[s]), law.values(gap[s])
            return (
                float(np.vdot(move, state.stress[s])), float(np.vdot(move, stiffened[s])), float(np.sum(new - old)),
                float(np.vdot(move, -np.minimum(old_bend, new_bend) * move)), float(move.sum()),
            )  # fmt: skip

        first, second, potential, bend, total = self.bands(sums) / size
        held = hold.energy(state.mean + total) - hold.energy(state.mean)
        change = first + second / 2 + potential + held
        spring = 0.0 if hold.fixed else hold.spring * total * total
        rounding = SAME * (abs(state.elastic) + abs(state.law) + abs(held))
        if not change <= rounding:
            return False
        if second + spring <= bend:  # not convex along the way

            def slopes(s: slice) -> tuple[float, ...]:
                move = gap[s] - state.gap[s]
                return tuple(float(np.vdot(move, law.traction(state.gap[s] + t * move))) for t in WAYS)

            along = self.bands(slopes) / size
            for t, pulled in zip(WAYS, along, strict=True):
                if first + t * second + pulled + hold.force(state.mean + t * total) * total > rounding:
                    return False
        self.rows(lambda s: np.add(state.stress[s], stiffened[s], out=state.stress[s]))
        np.copyto(state.gap, gap)
        state.iterations, state.single = state.iterations + 1, single
        self.measure(state)
        return True
