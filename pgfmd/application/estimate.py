"""What a run will take: memory, files, time.  Used by `pgfmd check`; no MPI here."""

import logging
import math
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pgfmd.application.job import Job
from pgfmd.application.results import size_in_words
from pgfmd.errors import InputError, SolverError
from pgfmd.grid.cell import WORKSPACE
from pgfmd.grid.grid_cost import ROOM, Cost, largest_shares
from pgfmd.options.section import in_words
from pgfmd.options.text import counted, duration, listed, readable
from pgfmd.physics.laws.adhesive_laws import AttractiveWall
from pgfmd.physics.solids.solid import SOFT
from pgfmd.solvers.options import GAPS_FROM, MODERATE, SINGLE_TO, Arrays, gaps_from
from pgfmd.solvers.options import cost as solver_cost

FIELDS = 3.0  # heights, pressure and gap
PLASTIC_BYTES = 8.0  # per grid point under limited hardness: plastic depth
BASE_BYTES = 2.1e8  # of a rank before it has a grid: interpreter, MPI, libraries, compiled code (Debian 12, x86-64)
OPEN_BASE_BYTES = 3.5e7  # beside that, with open boundaries: fitted to 1024² to 8192²
LIBRARY_BYTES = 1.2e8  # of these, what all ranks of a node share
AGGREGATION_BYTES = 2**25  # buffer in which one rank gathers a field while all write it (OMPIO's default)
AREA_EXCESS = 0.22  # of self-affine surfaces at small loads: κ = 1.95 (H = 0.8), in Persson's theory √(8/π) = 1.60; − 1
# Under a hard wall the area is about erf(exp(−FALL · gap/rms height)): 60 contacts of .01 … .8 (256², H = .3, .8,
# λ_s = 4a, 16a, 64a) had .47 … 2.3 times this area, in the median .98 (2.0: .38 … 1.2; 2.6: .52 … 4.6).  SUMMIT:
# the highest point over the rms height, 2.2 … 4.2, low so that contacts count as too large rather than too small.
FALL, SUMMIT = 2.3, 2.4
SECONDS_PER_POINT = 1.4e-8  # of one transform, on one core of a 2020s machine (FFTW, 4096 × 4096)
START = 1.0  # seconds until a run has read its job, on 1 and 2 ranks of the same machine, loops compiled before
PER_LOAD = 0.03  # seconds of a load on the smallest grid: solving .003, measuring .024, writing .003
BESIDES = 2.0, 1.0  # time in transforms: to measure a contact's area and line; to make heights
SLAB_GAIN = 0.8  # speed of ranks that share a surface over that of as many with a surface each (README: two, 1.59/2)
# Time of a solve at other tolerances: at 1e-4, 1e-6, 1e-10, 1e-12 .5, .7, 1.3 and 1.7 times that at 1e-8 (1536², hard
# wall, periodic and open; counts of Newton's method and of the dynamics alike).
USUAL_TOLERANCE, DIGITS = 1e-8, 1.2
THIN_WORK = 10.0  # work on a thin solid over that on a half-space: 256², free slabs of .03 to .1 of the cell
LEAST_SLAB = 2**16  # points of a slab below which further ranks gain nothing
# Work until a target is met, over that of a given pressure: under a hard wall as measured at 512² … 4096², 1 for walls
# that attract, else by several solutions (2.2 … 2.8; the mean gap of an open patch 3.3).  Closure to 1e-3 took 6 … 9 at
# 256² and 512², to 1e-4 9 … 14.
SEARCH_WORK = {"pressure": 1.0, "contact_area": 1.6, "mean_gap": 1.4, "displacement": 1.4, "percolation": 8.0}
SOLUTIONS_WORK, OPEN_GAP_WORK = 2.4, 3.3
# Under walls that attract, a load takes `STICKS`[0] + [1] (side/128)^¾ / ℓ transform pairs (ℓ: process zone in pixels;
# side in points), each in the time of `PAIR` pairs; with bisected jumps 1 + `JUMPS`/ℓ times as many.  Of 60 lists of
# loads at 128² … 512², ℓ = 1.2 … 80, nine in ten were within a factor of 1.6 without bisection (worst 2.7), with it of
# 2.8 (worst 5.7).  SHORTEST: ℓ that is counted at least.
STICKS, PAIR, JUMPS, SHORTEST = (30.0, 65.0), 3.0, 4.0, 0.8
OPEN_WORK = 2.0  # processor time with open boundaries over that of a periodic cell: median of 32 rough surfaces at 512²
OPEN_MEASURING = 3.0  # the same of what is measured
OPEN_AREA = 0.45  # assumed with open boundaries where it is not known: between areas that need least memory and most
TABLE_BYTES = 8.0  # per mode in a quarter of the torus: the compliance
# Of `explored`: most points along a side, most contacts, most points of a file that it reads.
COARSE, MOST_LOADS, MOST_POINTS = 128, 16, 2**24
# A contact that is solved on a rectangle: bytes per point of the patch, beside the torus, of the rectangle; transforms
# for the rest.
WHOLE_BYTES, RECTANGLE_BYTES, OUTSIDE = 27.0, (55.0, 16.0), 2.0
RETURNED = 2**25  # bytes of an array from which glibc returns its memory to the system, not to the next array
MEASURING_BYTES = 38.0  # per point, before a contact is solved: heights, their slopes, strips
WORTH = 0.5  # largest part of the patch to which a solve is restricted (`solvers.active_set.cropping`)
# Memory of strips of patch and mesh over padded strips in double precision, as measured on whole runs; of hard walls
# where the system takes back arrays in single precision (4096² and 8192², contact areas from .006 to .83).
PADDED = 1.1, 0.45
# Per point, where the load is not given: by one solution (8192²: areas 1.2, gaps and displacements less); by several, a
# mask, and the pressure that starts the next one.
AIMED_BYTES, SEARCH_BYTES = 1.2, 5.0


@dataclass(frozen=True)
class Estimate:
    """memory: peak RSS of the largest rank, in which shared pages count for each rank; node: bytes on the fullest node,
    in which they count once; files: bytes of all files; seconds: of the whole run.
    """

    memory: float
    node: float
    files: float
    seconds: float


class Extent(NamedTuple):
    """Relative area of a contact, part of the patch where it is solved, bytes per point of the torus for the rest."""

    area: float
    part: float
    torus: float


@dataclass(frozen=True)
class Plan:
    """A job, and the extents of its contacts, if `explored` has found it."""

    job: Job
    extents: tuple[Extent, ...] = ()

    def estimate(self, ranks: int, room: float = math.inf, per_node: int | None = None) -> Estimate:
        """Memory, size of the files and time of the job on `ranks` ranks with one core each, roughly.

        room: bytes that each rank can have, by which an ensemble is divided into groups (`rank_groups`).
        per_node: ranks of the fullest node; None: all.
        """
        job, points, loads = self.job, math.prod(self.job.cell.n), len(self.job.load.targets)
        surfaces, groups = max(1, len(job.surface.seeds)), self.rank_groups(ranks, room)
        here = min(per_node or ranks, ranks)
        ranks //= groups  # of one surface, in the smallest group
        rank, node = self._memory(ranks, min(here, ranks))
        fields = sum(1 if name == "height" else loads for name in job.output.fields)
        seconds = self._work() * points * SECONDS_PER_POINT / gain(ranks) + PER_LOAD * loads
        return Estimate(
            memory=self.base + rank,
            node=LIBRARY_BYTES + here * (self.base - LIBRARY_BYTES) + -(-here // ranks) * node,
            files=surfaces * fields * points * np.dtype(job.output.precision).itemsize,
            seconds=START + -(-surfaces // groups) * seconds,
        )

    def _work(self) -> float:
        """Pairs of transforms that one surface takes, or that take as long as what else is done."""
        job, control, wraps = self.job, self.job.imposed.control, self.job.cell.domain.wraps
        if self.sticks:
            search = 1.0
        elif control == "mean_gap" and not wraps:
            search = OPEN_GAP_WORK
        else:
            known = self.one_solution or control in ("pressure", "percolation")
            search = SEARCH_WORK[control] if known else SOLUTIONS_WORK
        digits = 1.0 if self.sticks else math.log(job.solver.tolerance) / math.log(USUAL_TOLERANCE)
        solving = np.mean([cost.transforms for cost in self.solving_costs()]) * job.solid.effort * search
        solving *= digits**DIGITS
        if job.wall.kind == "hard" and job.solid.softest(job.cell.lengths, job.cell.spacings) < SOFT:
            solving *= THIN_WORK
        measuring = BESIDES[0] + sum(cost.transforms for cost in self.measuring_costs())
        each = solving + measuring if wraps else OPEN_WORK * solving + OPEN_MEASURING * measuring
        return float(each) * len(job.load.targets) + BESIDES[1]

    def _memory(self, ranks: int, here: int) -> tuple[float, float]:
        """Bytes for one surface, of the rank and of the node that need most, while it is solved and measured, or
        written.  here: ranks of a node.

        Of the shared strips of blocked transforms, a rank touches its own and its rows of the others on its node; with
        several nodes, also a strip for each of these, and its own rows, packed.
        """
        job = self.job
        nodes = -(-ranks // here)
        shares, of_node = (largest_shares(job.cell.n, ranks, of) for of in (1, here))
        blocked = WORKSPACE["blocked"] * (job.solver.transform == "blocked")
        packed = blocked * (1 - 1 / nodes)
        seen = blocked * (here - 1) / (here if nodes == 1 else 1) + packed
        gathered = min(math.prod(job.cell.n) * 8, AGGREGATION_BYTES) if job.output.fields and ranks > 1 else 0
        written = FIELDS * np.dtype(job.solver.storage).itemsize  # blocked strips are made when a transform needs them
        if not blocked or any(cost.transforms for cost in self.measuring_costs()):
            written += WORKSPACE[job.solver.transform]
        rank = max(self._peak(shares, self.bytes_per_point(ranks), 1), written * shares[0] + gathered)
        node = max(self._peak(of_node, self.bytes_per_point(nodes), here), written * of_node[0] + gathered)
        return rank + seen * shares[0], node + packed * of_node[0]

    def rank_groups(self, ranks: int, room: float = math.inf) -> int:
        """Number of groups of ranks, each of which takes one surface at a time: 1 if there is one surface; for an
        ensemble the number that takes least time, of those that need at most `room` bytes on each rank.

        A group of g ranks takes 1/(`SLAB_GAIN` g) of the time of one rank, as far as slabs have `LEAST_SLAB` points.
        """
        job = self.job
        (nx, ny), surfaces = job.cell.n, len(job.surface.seeds)
        if surfaces == 0:
            return 1

        def seconds(groups: int) -> float:
            width = min(ranks // groups, max(1, nx * ny // LEAST_SLAB))
            return -(-surfaces // groups) / gain(width)

        def fits(groups: int) -> bool:
            narrow, wide = ranks // groups, -(-ranks // groups)  # ranks of a group
            most = self._peak(largest_shares((nx, ny), narrow), self.bytes_per_point(), 1)
            return wide <= nx and self.base + most <= room

        most = min(ranks, surfaces)
        # If nothing fits, one group takes least memory on each rank; it needs a row for each.
        return min(filter(fits, range(most, 0, -1)), key=seconds, default=1 if ranks <= nx else most)

    def _peak(self, shares: list[int], per_point: float, ranks: int) -> float:
        """Bytes of these ranks, one or those of a node, at the worst of the grids of which they hold `shares` points,
        finest first.

        per_point: bytes per point of the grid that is solved or measured; finer grids keep their heights meanwhile,
        and the finest also its transforms, if they are not freed.  A coarser grid can be the worst: fewer ranks hold
        it, with larger shares.
        """
        freed = self.job.solver.transform == "blocked" and self.job.cell.domain.wraps and shares[0] > ROOM * ranks
        transforms = 0.0 if freed else shares[0] * WORKSPACE[self.job.solver.transform]
        heights = (1 + self.scaled) * np.dtype(self.job.solver.storage).itemsize
        return max(
            per_point * share + heights * sum(shares[:level]) + transforms * (level > 0)
            for level, share in enumerate(shares)
        )

    @property
    def one_solution(self) -> bool:
        """Whether what is imposed is met by one solution, not by a search over loads."""
        return self.hard and self.job.imposed.control != "percolation"

    @property
    def sticks(self) -> bool:
        """Whether the wall attracts: what is imposed is held while the contact is solved."""
        return self.job.wall.methods[0] == "adhesive"

    @property
    def scaled(self) -> bool:
        """Whether heights are solved in a scaled copy."""
        slope, cell, surface = self.job.surface.whole.known_slope() or 0.0, self.job.cell, self.job.surface.whole
        # slope × spacing and slope × length bound the rms height of a surface with mean 0
        moderate = 5 / MODERATE < slope * min(cell.spacings) and slope * max(cell.lengths) < MODERATE
        return self.job.wall.reach > 0 or not (surface.centred and moderate)

    @property
    def hard(self) -> bool:
        """Whether the active set solves it, under a wall of unlimited hardness."""
        return self.job.wall.kind == "hard" and self.job.solver.method in ("auto", "active-set")

    @property
    def gaps_from(self) -> float:
        """Contact area above which gaps are the unknowns, and which needs most memory.  What is needed where a pressure
        is not given was measured with the larger one.
        """
        return gaps_from(math.prod(self.job.cell.n)) if self.job.imposed.control == "pressure" else GAPS_FROM[1]

    @property
    def base(self) -> float:
        """Bytes of a rank before it has a grid."""
        return BASE_BYTES + OPEN_BASE_BYTES * (not self.job.cell.domain.wraps)

    def bytes_per_point(self, slabs: int = 1) -> float:
        """Bytes per grid point at the peak of solving and measuring, on the fullest of so many slabs."""
        job = self.job
        costs = self.solving_costs(slabs) + self.measuring_costs()
        kept = FIELDS * np.dtype(job.solver.storage).itemsize + PLASTIC_BYTES * (job.wall.highest < math.inf)
        if job.imposed.control != "pressure":
            kept += AIMED_BYTES if self.one_solution else SEARCH_BYTES
        torus = job.cell.domain.torus(job.cell.n, job.cell.spacings)
        if small := [each for each in self.extents if each.part <= WORTH]:
            most = max(small, key=lambda each: each.part)
            kept = RECTANGLE_BYTES[int(8 * most.part * math.prod(job.cell.n) >= RETURNED)]
            measuring = MEASURING_BYTES + max((cost.memory for cost in self.measuring_costs()), default=0.0)
            return max(measuring, WHOLE_BYTES + most.torus + kept * most.part)
        workspace = WORKSPACE[job.solver.transform] * torus[1] / job.cell.n[1]
        least = 0.0
        if not job.cell.domain.wraps:
            table = TABLE_BYTES * torus[0] * torus[1] / (4 * math.prod(job.cell.n))
            least = (WHOLE_BYTES + workspace / 2 + table) * self.hard  # the gap of the whole patch
            returned = self.hard and 4 * math.prod(job.cell.n) >= RETURNED
            workspace = PADDED[int(returned)] * workspace + table
        return max(least, kept + workspace + max(cost.memory for cost in costs))

    def solving_costs(self, slabs: int = 1) -> list[Cost]:
        """What each load costs to solve; memory of the fullest of so many slabs."""
        job = self.job
        method = job.wall.methods[0] if job.solver.method == "auto" else job.solver.method
        cell = job.cell
        single = job.wall.highest == math.inf and job.solver.tolerance >= SINGLE_TO * math.sqrt(cell.n[0] * cell.n[1])
        effort = job.wall.newton_effort if method == "newton" else job.wall.effort
        if self.sticks:
            assert isinstance(job.wall, AttractiveWall)
            zone = max(job.wall.process_zone(job.solid.contact_modulus) / max(cell.spacings), SHORTEST)
            bisected = job.load.jump_accuracy > 0 and job.load.branch == "follow"
            jumps = JUMPS / zone * bisected * (1 - 1 / len(job.load.targets))  # none to the first target
            effort = PAIR * (STICKS[0] + STICKS[1] * (math.prod(cell.n) ** 0.5 / 128) ** 0.75 / zone) * (1 + jumps)
        most = self.gaps_from if cell.domain.wraps else 1.0  # open: pressures are the unknowns at any area
        strips = WORKSPACE["blocked"] * (cell.domain.wraps and job.solver.transform == "blocked")
        arrays = Arrays(self.scaled, single, strips, job.solver.storage == "float64", most)
        costs = [solver_cost(method, area, slabs, effort, arrays) for area in self.contact_areas()]
        for number, each in enumerate(self.extents):
            if each.part <= WORTH:
                work = solver_cost(method, min(each.area / each.part, most), slabs, arrays=arrays).transforms
                costs[number] = Cost(each.part * work + OUTSIDE, costs[number].memory)
        return costs

    def measuring_costs(self) -> list[Cost]:
        """Cost of each observable of the job, for one load."""
        job = self.job
        return [observable.cost(job.cell, job.surface.whole.cutoff(job.grid)) for observable in job.output.asked]

    def contact_areas(self) -> list[float]:
        """The relative contact area of each load: the prescribed one; else that of Persson's theory times
        1 + `AREA_EXCESS` (1 − area), or one that falls with the gap over the rms height (`FALL`); where none is known,
        the area that costs most.
        """
        job = self.job
        targets = job.imposed.targets
        if self.extents:
            return [each.area for each in self.extents]
        if job.imposed.control == "contact_area":
            return list(targets)
        full = job.solid.contact_modulus * (job.surface.whole.known_slope() or 0.0) / math.sqrt(2)
        by_approach = job.imposed.control == "displacement" and job.solid.only_inwards
        rms = job.surface.whole.known_height(job.cell) if job.cell.domain.wraps and job.wall.kind == "hard" else None
        if rms and (job.imposed.control == "mean_gap" or by_approach):
            gaps = [SUMMIT * rms - target if by_approach else target for target in targets]
            return [math.erf(math.exp(-FALL * max(gap, 0.0) / rms)) for gap in gaps]
        if job.imposed.control != "pressure" or not full:  # it may underflow
            return [self.gaps_from if job.cell.domain.wraps else OPEN_AREA]
        areas = [math.erf(target / full) for target in targets]
        return [area * (1 + AREA_EXCESS * (1 - area)) for area in areas]

    def report(self, ranks: int, per_node: int | None = None) -> str:
        """The estimate as text, one line per quantity; raises InputError if a file cannot be used for the job."""
        job = self.job
        unit = job.output.length_unit
        understood = {each.where: each.check_inputs(job.grid, unit) for each in (job.surface.whole, job.solid)}
        total, here = self.estimate(ranks, per_node=per_node), min(per_node or ranks, ranks)
        loads = len(job.load.targets)
        unknown = not job.cell.domain.wraps and self.contact_areas() == [OPEN_AREA]
        lines = {
            "grid": size_in_words(job.cell.shape, job.cell.lengths, unit, vars(job.grid)),
            "surface": ": ".join(filter(None, [job.surface.whole.kind, understood["surface"]])),
            "solid": ": ".join(filter(None, [job.solid.kind, understood["solid"]])) + "; " + in_words(job.solid),
            "seeds": f"{len(job.surface.seeds)}, {self.rank_groups(ranks)} at a time" if job.surface.seeds else "",
            "loads": f"{loads} by {job.load.control}" + f"; contact area unknown, {OPEN_AREA} assumed" * unknown,
            "memory": f"about {readable(total.node)} on a node of {counted(here, 'rank')} "
            f"({readable(self.base)} for each rank, of which {readable(LIBRARY_BYTES)} are shared, and "
            f"{self.bytes_per_point():.0f} bytes per grid point)",
            "of a rank": f"up to {readable(total.memory)}, memory shared within a node included" * (ranks > 1),
            "files": readable(total.files),
            "time": f"about {duration(total.seconds)} on {counted(ranks, 'core')}",
        }
        return listed(lines)


def explored(job: Job) -> Plan:
    """The plan of a job.  For hard contacts on an open patch whose slope is not known, some loads are solved on few
    points to find their reach; where that is not possible, estimates assume `OPEN_AREA`.
    """
    hard = job.wall.kind == "hard" and job.solid.only_inwards and job.imposed.control == "pressure"
    if job.cell.domain.wraps or job.surface.whole.known_slope() is not None or not hard:
        return Plan(job)
    before = logging.root.manager.disable
    logging.disable()  # warnings about the heights are for the run
    try:
        with suppress(InputError, SolverError):
            return Plan(job, _extents(job))
    finally:
        logging.disable(before)
    return Plan(job)


def _extents(job: Job) -> tuple[Extent, ...]:
    """The reach of some loads of a job.  Raises InputError or SolverError if it cannot be found."""
    from pgfmd.grid.slab_grid import SlabGrid  # compiles loops
    from pgfmd.parallel.mpi import MPI
    from pgfmd.physics.problem import ContactProblem
    from pgfmd.solvers.active_set.cropping import LOOSE, MARGIN, solve_hard_wall

    cell, whole, unit = job.cell, job.surface.whole, job.output.length_unit
    every = -(-max(cell.n) // COARSE)
    shape = -(-cell.n[0] // every), -(-cell.n[1] // every)
    grid = SlabGrid(MPI.COMM_SELF, shape, (*np.multiply(shape, cell.spacings) * every,), 1, domain=cell.domain)
    try:
        heights = whole.heights(grid, unit)
    except InputError:  # a file
        if math.prod(job.grid.n) > MOST_POINTS or job.grid.refine > 1:
            raise
        fine = SlabGrid(MPI.COMM_SELF, cell.n, cell.lengths, 1, domain=cell.domain)
        heights = whole.heights(fine, unit)[::every, ::every].copy()
    found = []
    for target in job.imposed.targets[:: -(-len(job.imposed.targets) // MOST_LOADS)]:
        if target <= 0:
            raise InputError("no contact")
        contact = solve_hard_wall(ContactProblem(grid, heights, job.solid, job.wall, target), LOOSE)
        inside = np.argwhere(heights >= heights.max() - MARGIN * contact.approach)
        first, stop = inside.min(0), inside.max(0) + 1
        part = math.prod((stop - first) / shape)
        wide = np.maximum(stop, shape - first) / shape
        area = float(np.mean(contact.pressure > 0))
        found.append(Extent(area, part, TABLE_BYTES * math.prod(wide) + WORKSPACE["blocked"] * wide[1]))
    return tuple(found)


def gain(ranks: int) -> float:
    """Speed of ranks that share a surface over that of one."""
    return 1.0 if ranks == 1 else SLAB_GAIN * ranks
