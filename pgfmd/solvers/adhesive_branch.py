"""Adhesive contacts at a sequence of targets: each continues from the last, so that loading and unloading differ.

A step along a branch begins with the gap extrapolated from the last two.  Where the area leapt, or energy was lost, the
branch may end between two targets: the interval is bisected, from the stable side.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import math
import time
from collections.abc import Iterable
from functools import partial

import numpy as np

from pgfmd.errors import InputError, SolverError
from pgfmd.options.text import show
from pgfmd.physics.laws.adhesive_laws import AttractiveWall, Dugdale, RangedWall
from pgfmd.physics.laws.hard import HardWall
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.active_set.contact_from_coarse import solve_hard_wall
from pgfmd.solvers.adhesive import AdhesiveContact
from pgfmd.solvers.adhesive_certificate import LITTLE, MARGIN, distance, estimated, proved
from pgfmd.solvers.adhesive_model import AdhesiveState, Hold
from pgfmd.solvers.adhesive_resolution import resolved
from pgfmd.solvers.options import Load
from pgfmd.solvers.solution import Certificate, ContactSolution, Monitor

LEAP, LEAST_LEAP = 0.2, 16  # change of the points within the range: over the larger number, and in points
LOOSE = 1e-4  # tolerance of the first state halfway, which only tells whether the area jumps
KNOWN = 0.02  # relative error of a jump's energy loss at which bisection ends
SUDDEN = 0.75  # part of a change of points within the range that one half of an interval has if it jumps there
PROBE = 4.0, 2.0  # ranges of a probe over that of the law, which comes last
JUMP = "jump_from", "jump_to", "pressure_before_jump", "pressure_after_jump"
NO_JUMP: tuple[float, ...] = (math.nan,) * 4
START_ERROR = 1e-5  # certified error of the contact under a hard wall with which a search at a load begins
FAR = 0.2  # largest distance t from the minimum, in ranges and over θ: more makes θ smaller
LESS = 0.7  # a guess of θ, over that of the last contact
WORSE = 2.0  # bound of the energy error over the estimate
LESSER, TRIES = 4.0, 3  # divides a guess of θ that was too large; how often
MOST = 1e60, 1e10  # load over the largest attraction; displacement over `apart`: more leaves them no digits
COLD, FOLLOWED, PROBED = range(3)
NONE = np.empty(0)
Point = tuple[float, AdhesiveState]  # a target and its contact
log = logging.getLogger("pgfmd")


def _bare(point: Point) -> Point:
    return point[0], dataclasses.replace(point[1], gap=NONE, stress=NONE)


class Branch:
    """Finds adhesive contacts of one surface at targets, in order; `monitor` is called after each step.  Raises
    InputError where the grid does not resolve the attraction.  Collective to make.
    """

    monitor: Monitor | None = None

    def __init__(self, load: Load, problem: ContactProblem, tolerance: float = 1e-8) -> None:
        load.check_law(problem.law)
        assert isinstance(problem.law, AttractiveWall)
        if load.branch == "probe" and not isinstance(problem.law, RangedWall):
            raise InputError(f'load.branch = "probe": wall.kind = {show(problem.law.kind)} has no range to lengthen')
        self.load, self.name, self.tolerance = load, load.control, tolerance
        self.problem, self.grid = problem, problem.grid
        self.stickiness = resolved(problem, problem.law)
        self.contact = AdhesiveContact(problem)
        self.last: Point | None = None
        self.floor, self.proven = 0.0, False  # θ of the last contact, and whether `PART` of it was proved
        self.change: tuple[float, np.ndarray] | None = None  # of targets and gaps to the last ones

    def hold(self, target: float) -> Hold:
        """What a target holds, in units of the law."""
        contact = self.contact
        if self.name == "pressure":
            return Hold(self.name, load=target / contact.pressure * contact.share, spring=0.0)
        gap, spring = target / contact.length, math.inf
        if self.name == "displacement":
            gap, spring = contact.summit - gap, contact.spring or math.inf
        beyond = max(0.0, gap - contact.apart)
        return Hold(self.name, contact.apart if beyond else gap, spring=spring, beyond=beyond)

    def check_targets(self, targets: Iterable[float]) -> None:
        """Raises InputError for a target at which the whole surface touches, and for mean gaps of a patch."""
        if self.name == "mean_gap" and not self.grid.domain.wraps:
            raise InputError('load.mean_gap: not imposed with grid.boundary = "open" under walls that attract')
        for target in targets:
            hold = self.hold(target)
            if hold.fixed and not hold.gap > self.contact.law.least:
                raise InputError(f"load.{self.name} = {target:g}: all points touch there, at any load")
            if not abs(hold.force(0.0)) < MOST[0]:
                raise InputError(f"load.{self.name} = {target:g}: over {MOST[0]:g} of the wall's largest attraction")
            if hold.gap < -MOST[1] * self.contact.apart:
                raise InputError(f"load.{self.name} = {target:g}: over {MOST[1]:g} of what heights and wall span")

    def displacement(self, found: ContactSolution) -> float:
        """Approach of the far side from where the undeformed solid touches the highest point."""
        spring = self.problem.solid.mean_stiffness() if self.grid.domain.wraps else 0.0
        return found.approach + (found.mean_pressure / spring if spring > 0 else 0.0)

    def resume(self, gap: np.ndarray | None, target: float = math.nan) -> None:
        """The next target continues from this gap (nx_local, ny), that of an earlier target.  Collective."""
        if gap is not None:
            gap = gap / self.contact.length - self.hold(target).beyond
            self.last = target, self.contact.state(self.contact.around(gap))
            self.last[1].stress = NONE

    def solution(self, target: float) -> ContactSolution:
        """The contact at that target, on the branch of the last one.  Collective.  Raises SolverError."""
        begun = time.perf_counter(), self.contact.grid.transforms
        self.contact.allocate()
        self.contact.see = self.monitor and partial(self.monitor, self.grid)
        hold, way, jump, drop = self.hold(target), FOLLOWED, NO_JUMP, 0.0
        if self.last is None or self.load.branch != "follow":
            state, way = self._cold(hold), PROBED if self.load.branch == "probe" else COLD
        else:
            state, jump, drop = self._followed(target)
        if self.last and jump is NO_JUMP and self.last[0] != target:
            change = self.contact.grid.new_field(np.float32)
            np.subtract(state.gap, self.last[1].gap, out=change, casting="same_kind")
            self.change = target - self.last[0], change
        self.last = target, state
        return self._solution(state, hold, {
            **dict(zip(JUMP, jump, strict=True)),
            "energy_drop": drop * self.contact.length * self.contact.pressure / self.contact.share,
            "branch": way, "newton_steps": state.iterations, "trials_refused": state.refused,
            "inner_applications": state.inner,
        }, begun)  # fmt: skip

    def _followed(self, target: float) -> tuple[AdhesiveState, tuple[float, ...], float]:
        """The contact at a target along the branch, the last jump before it, and the energy lost in all jumps.  `last`
        becomes the state from which it was reached.  Collective.
        """
        assert self.last is not None
        jump, drop = NO_JUMP, 0.0
        before, state = _bare(self.last), self._from(self.last, target, extrapolated=True)
        while self.load.jump_accuracy and self._leapt(before, (target, state)):
            ends = [self.last, (target, state)]
            del state  # as the fields of what is not needed any more take memory
            jumps = self._bisect(ends)
            if jumps and ends[1][0] == target:  # did the extrapolated start jump too early?
                again = target, self._from(ends[0], target)
                if not self._dropped(ends[0], again):
                    jumps, ends[1] = False, again
                del again
            self.last = ends[1] if jumps else ends[0]
            if jumps:
                jump = ends[0][0], ends[1][0], self._pressure(ends[0][1]), self._pressure(ends[1][1])
                drop += max(self._lost(*ends)[1], 0.0)
                self._tell(*ends)
                before = _bare(ends[1])
            if ends[1][0] == target:
                return ends[1][1], jump, drop
            del ends
            state = self._from(self.last, target)
            if not jumps:
                break
        return state, jump, drop

    def _cold(self, hold: Hold) -> AdhesiveState:
        """From the undeformed gap, or from the contact under the same work at longer ranges.  Collective."""
        contact = self.contact
        gap = hold.gap if self.name != "pressure" else contact.summit
        start = contact.undeformed(max(gap, contact.law.least + 1e-3))
        if self.name == "pressure" and hold.load > 0:  # else the approach would take many steps of some ranges
            wall = self.problem.with_law(HardWall()).at(hold.load * contact.pressure / contact.share)
            with contextlib.suppress(SolverError):  # roughness that is lost beside the load
                start = contact.around(solve_hard_wall(wall, START_ERROR).gap / contact.length + contact.law.least)
        law = self.problem.law
        for factor in PROBE if self.load.branch == "probe" else ():
            assert isinstance(law, RangedWall)
            softer = AdhesiveContact(self.problem.with_law(dataclasses.replace(law, range=law.range * factor)))
            softer.see = contact.see
            longer = dataclasses.replace(
                hold, gap=hold.gap / factor, load=hold.load * factor, spring=hold.spring * factor**2
            )
            start = softer.minimise(start / factor, longer, 1e-4).gap * factor
        if hold.fixed:
            contact.to_mean(start, hold.gap)
        return contact.minimise(start, hold, self.tolerance, lambda state: self._goal(state, hold))

    def _from(self, last: Point, target: float, tolerance: float = 0.0, extrapolated: bool = False) -> AdhesiveState:
        """The contact at a target, from another.  extrapolated: by the last change, which is lost.  Collective."""
        hold, least, gap = self.hold(target), self.contact.law.least, last[1].gap.copy()
        (step, way), self.change = self.change if extrapolated and self.change else (0.0, gap), None
        if step:
            ratio = (target - last[0]) / step
            if abs(ratio) <= 2:
                way *= np.float32(ratio)
                np.add(gap, way, out=gap, where=gap > least)
                np.maximum(gap, least, out=gap)
        del way
        if hold.fixed:
            self.contact.to_mean(gap, hold.gap)
        goal = None if tolerance else lambda state: self._goal(state, hold)
        return self.contact.minimise(gap, hold, max(self.tolerance, tolerance), goal)

    def _guess(self, state: AdhesiveState) -> float:
        """θ of a state, guessed from its last directions and the last contact."""
        return min(max(min(state.curvatures, default=1.0), 1e-3), 0.8, LESS * self.floor or 1.0)

    def _goal(self, state: AdhesiveState, hold: Hold, floor: float = 0.0) -> float:
        """The error, over 2 E_el, at most the tolerance, with which the distance t is at most `FAR` θ."""
        floor = floor or self._guess(state)
        share = distance(self.contact, hold, floor, WORSE * state.scale / 2) / (FAR * floor)
        return min(self.tolerance, 1 / max(share, 1e-100) ** 2)

    def _leapt(self, low: Point, high: Point) -> bool:
        """Whether the area leapt, or energy was lost by whatever force was between."""
        (_, old), (_, new) = low, high
        leap = abs(new.attracted - old.attracted) > max(LEAST_LEAP, LEAP * max(new.attracted, old.attracted))
        return leap or self._dropped(low, high)

    def _dropped(self, low: Point, high: Point) -> bool:
        """Whether energy was lost by whatever force was between."""
        return self._lost(low, high)[0] > self.tolerance * (low[1].scale + high[1].scale)

    def _bisect(self, ends: list[Point]) -> bool:
        """Makes the ends the last state before a jump and the first after it; False if it is gradual.  Collective.

        A jump that makes up half of the change or more leaves at least `SUDDEN` of it in one half of the interval.
        Where there is no jump, halving divides the error of the trapezoid rule by 4; what does not fall is lost.  Ends
        when the loss is known, or after six halvings beyond `jump_accuracy`.
        """
        width, loose = self.load.jump_accuracy * abs(ends[1][0] - ends[0][0]), LOOSE
        while not self._known(ends) and abs(ends[1][0] - ends[0][0]) > width / 64:
            ends[0][1].stress = ends[1][1].stress = NONE
            self.last, target = ends[0], (ends[0][0] + ends[1][0]) / 2
            middle = target, self._from(ends[0], target, tolerance=loose or self.tolerance)
            halves = (ends[0], middle), (middle, ends[1])
            areas = [abs(new[1].attracted - old[1].attracted) for old, new in halves]
            losses = [self._lost(*half)[1] for half in halves]
            sudden = max(areas) > SUDDEN * abs(ends[1][1].attracted - ends[0][1].attracted)
            left = (4 * sum(losses) - self._lost(*ends)[1]) / 3
            if not sudden and (max(losses) <= 0 or left <= max(losses) / 2):
                return False
            if not loose:  # the first only tells whether there may be a jump
                late = areas[0] < areas[1] if sudden else losses[0] < losses[1]
                ends[not late] = middle
            del middle, halves
            loose = 0.0
        return self._dropped(ends[0], ends[1])

    def _known(self, ends: list[Point]) -> bool:
        """Whether the energy lost is known to `KNOWN` and `jump_accuracy`, whatever force was between."""
        least, mean = self._lost(*ends)
        return mean - least <= min(KNOWN, self.load.jump_accuracy) * mean

    def _lost(self, low: Point, high: Point) -> tuple[float, float]:
        """Energy per point lost from one state to the next, over w: the work done less the energy gained; with the
        force (at a load: gap) of one end on the whole way, the least, and with the mean of both.
        """
        (_, old), (_, new), at, to = low, high, self.hold(low[0]), self.hold(high[0])
        load = 0.0 if at.fixed else to.load - at.load
        works = [(to.gap - at.gap) * state.pull + load * state.mean for state in (old, new)]
        gained = new.energy + to.energy(new.mean) - old.energy - at.energy(old.mean)
        return min(works) - gained, sum(works) / 2 - gained

    def _pressure(self, state: AdhesiveState) -> float:
        return -state.pull * self.contact.pressure / self.contact.share

    def _tell(self, low: Point, high: Point) -> None:
        if self.grid.comm.rank == 0:
            size = self.grid.size
            log.info(
                "load.%s: the branch ends between %.6g and %.6g: area %.4g → %.4g, mean pressure %.4g → %.4g",
                self.name, low[0], high[0], low[1].contact / size, high[1].contact / size,
                self._pressure(low[1]), self._pressure(high[1]),
            )  # fmt: skip

    def _certified(self, state: AdhesiveState, hold: Hold) -> tuple[float, float, float, bool]:
        """θ, the bound of the energy error per point, the distance t, and whether they are proved.  Lowers the state
        to where its distance from the minimum hardly changes θ.  Collective.
        """
        contact, wanted = self.contact, self.tolerance * state.scale / 2
        guess, goal, known = self._guess(state), state.error, min((self.floor, *state.curvatures))
        for _ in range(TRIES):
            goal = min(goal, self._goal(state, hold, guess))
            if goal < state.error:
                contact.lowered(state, hold, lambda _, goal=goal: goal)  # type: ignore[misc]
            expected = WORSE * state.error * state.scale / 2
            if self.proven and (proof := proved(contact, state, hold, known, expected)):
                return *proof, True
            self.proven = False
            far = max(MARGIN * distance(contact, hold, guess, expected), LITTLE * guess)
            floor, bound, least = estimated(contact, state, hold, far)
            if far >= least and bound <= wanted:
                self.floor, proof = floor, proved(contact, state, hold, floor, bound)
                self.proven = proof is not None
                return *(proof or (floor, bound, far)), self.proven
            guess, goal = min(floor or guess / LESSER, guess), state.error
            if floor > 0 and 0 < bound < math.inf:
                goal *= min(1.0, wanted / bound / 2)
        self.floor, self.proven = 0.0, False
        return 0.0, math.inf, far, False

    def _solution(
        self, state: AdhesiveState, hold: Hold, details: dict[str, float], begun: tuple[float, float]
    ) -> ContactSolution:
        """The contact in units of the job.  Collective."""
        contact, law = self.contact, self.contact.law
        if not state.stress.size:
            state.stress = contact.evaluate(state.gap, contact.grid.new_field())
        floor, bound, far, proof = self._certified(state, hold)
        scale, size = contact.length * contact.pressure / contact.share, self.grid.size
        pressure = contact.grid.new_field()

        def fill(s: slice) -> None:  # the law's also where a point still touches that the solid pulls more
            pressure[s] = -law.traction(state.gap[s])
            np.maximum(pressure[s], state.stress[s] - state.pull, out=pressure[s], where=state.gap[s] <= law.least)
            pressure[s] *= contact.pressure

        contact.rows(fill)
        state.stress = NONE
        contact.allocate(False)  # observables need memory too
        if contact.spring and not self.grid.domain.wraps:  # the mean of the displacement is elastic
            state = dataclasses.replace(state, elastic=state.elastic + state.pull**2 / (2 * contact.spring))
        pressure, gap = contact.unpadded(pressure), contact.unpadded(state.gap)
        kind = "global" if hold.fixed and self._convex() else "local"
        certificate: Certificate | str = "the least curvature of the energy is not known to be positive"
        if floor > 0:
            error = bound / (2 * state.elastic) if state.elastic else 0.0
            certificate = Certificate(error, kind, "proved" if proof or kind == "global" else "estimated", self.name)
        mean, total, tension, pulled = self.grid.reduction.sums(  # the mean misses a load by that of the residual
            float(pressure.sum()), float(gap.sum()), float(np.sum(pressure, where=pressure < 0)),
            float(np.count_nonzero((pressure < 0) & (gap <= law.least))),
        ) / size  # fmt: skip
        known = details | {
            "energy": state.energy * scale, "residual": state.residual * contact.pressure, "least_curvature": floor,
            "gap_bound": far * contact.length if floor > 0 else math.inf, "tensile_pressure": tension,
            "tensile_area": pulled, "stickiness": self.stickiness,
            "bound": float(0 if floor <= 0 else 2 if kind == "global" else 3 if proof else 1),
        }  # fmt: skip
        moved = 0.0 if self.grid.domain.wraps else -state.pull / contact.spring  # of the mean of the torus
        return ContactSolution(
            pressure=pressure,
            # `gap` is that of the state, from which the next target starts
            gap=(gap + hold.beyond if hold.beyond else gap) * contact.length,
            mean_pressure=float(mean),
            mean_gap=(float(total) + hold.beyond) * contact.length,
            elastic_energy=max(state.elastic, 0.0) * scale,  # of a flat solid it is rounding
            certificate=certificate,
            iterations=state.iterations,
            transforms=contact.grid.transforms - begun[1],
            seconds=time.perf_counter() - begun[0],
            threshold=-math.inf if law.least == 0 else 0.0,
            approach=(contact.summit - state.mean - hold.beyond + moved) * contact.length,
            details=known,
        )

    def _convex(self) -> bool:
        """Whether the energy is convex at a mean gap: the solid's curves more, even that of the longest wave."""
        contact = self.contact
        steepest = float(np.max(-contact.law.curvature(np.linspace(contact.law.least, contact.law.least + 40, 20001))))
        return steepest < 1 / contact.softest and not (isinstance(contact.law, Dugdale) and contact.law.edge == 0)


def solve_adhesive(
    problem: ContactProblem, tolerance: float = 1e-8, start: np.ndarray | None = None, monitor: Monitor | None = None
) -> ContactSolution:
    """The adhesive contact at the mean pressure of a problem, from the undeformed gap.  Collective."""
    branch = Branch(Load(pressure=(problem.mean_pressure,)), problem, tolerance)
    branch.monitor = monitor
    return branch.solution(problem.mean_pressure)
