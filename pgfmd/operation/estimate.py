"""What a run will take: memory, files, time.  Used by `pgfmd check`; no MPI here."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pgfmd.grid.cell import WORKSPACE
from pgfmd.grid.cost import Cost
from pgfmd.grid.holders import largest_shares
from pgfmd.job.job import Job
from pgfmd.operation.memory import readable
from pgfmd.options.text import counted
from pgfmd.solvers.cost import GAPS_FROM
from pgfmd.solvers.cost import cost as solver_cost

FIELD_BYTES = 24.0  # per grid point: heights, pressure, gap
WAITING_BYTES = 24.0  # per point of a grid while a coarser one is solved: heights, as given and scaled, and strips
BASE_BYTES = 2.17e8  # of a rank before it has a grid: interpreter, MPI, libraries, compiled code (Debian 12, x86-64)
AGGREGATION_BYTES = 2**25  # buffer in which one rank gathers a field while all write it (OMPIO's default)
AREA_EXCESS = 0.22  # of self-affine surfaces at small loads: κ = 1.95 (H = 0.8), in Persson's theory √(8/π) = 1.60; − 1
SECONDS_PER_POINT = 1.4e-8  # of one transform, on one core of a 2020s machine (FFTW, 4096 × 4096)
SLAB_GAIN = 0.8  # speed of ranks that share a surface over that of as many with one each (README: two took 1/1.59)
LEAST_SLAB = 2**16  # points of a slab below which further ranks gain nothing
SEARCH_WORK = 4  # work until an area, gap or displacement is met, over that of a given pressure (2.5 … 8 on 128²)


@dataclass(frozen=True)
class Estimate:
    """Bytes per rank at the peak, bytes of all files, seconds of the whole run."""

    memory: float
    files: float
    seconds: float


def estimate(job: Job, ranks: int, room: float = math.inf) -> Estimate:
    """Memory per rank, size of the files and time of the job on `ranks` ranks with one core each, roughly.

    room: bytes that each rank can have, by which an ensemble is divided into groups (`rank_groups`).
    """
    points = job.grid.n[0] * job.grid.n[1]
    surfaces, groups = max(1, len(job.surface.seeds)), rank_groups(job, ranks, room)
    ranks //= groups  # of one surface, in the smallest group
    loads = len(job.load.targets)
    itemsize = 4 if job.output.precision == "float32" else 8
    field_count = sum(1 if name == "height" else loads for name in job.output.fields)
    contacts = loads * (1 if job.load.control == "pressure" else SEARCH_WORK)
    solving, measuring = max(solving_costs(job), key=lambda cost: cost.memory), measuring_costs(job)
    work = solving.transforms * contacts + sum(cost.transforms for cost in measuring) * loads
    gathered = min(points * itemsize, AGGREGATION_BYTES) if field_count and ranks > 1 else 0
    return Estimate(
        memory=BASE_BYTES + gathered + peak(largest_shares(job.grid.n, ranks), bytes_per_point(job)),
        files=surfaces * field_count * points * itemsize,
        seconds=-(-surfaces // groups) * work * points * SECONDS_PER_POINT / ranks,
    )


def peak(shares: list[int], per_point: float) -> float:
    """Bytes of rank 0 at the worst of its grids, of which it holds `shares` points, finest first.

    per_point: bytes per point of the grid that is solved or measured.  Finer grids keep `WAITING_BYTES` per point.  A
    coarser grid can be the worst: fewer ranks hold it, with larger shares.
    """
    return max(per_point * share + WAITING_BYTES * sum(shares[:level]) for level, share in enumerate(shares))


def rank_groups(job: Job, ranks: int, room: float = math.inf) -> int:
    """Into how many groups ranks are divided, each of which takes one surface at a time: 1 if there is only one; for an
    ensemble the number that takes least time, of those that need at most `room` bytes on each rank.

    A group of g ranks takes 1/(`SLAB_GAIN` g) of the time of one rank, as far as its slabs have `LEAST_SLAB` points.
    """
    (nx, ny), surfaces = job.grid.n, len(job.surface.seeds)
    if surfaces == 0:
        return 1

    def seconds(groups: int) -> float:
        width = min(ranks // groups, max(1, nx * ny // LEAST_SLAB))
        return -(-surfaces // groups) / (1.0 if width == 1 else SLAB_GAIN * width)

    def fits(groups: int) -> bool:
        narrow, wide = ranks // groups, -(-ranks // groups)  # ranks of a group
        return wide <= nx and BASE_BYTES + peak(largest_shares((nx, ny), narrow), bytes_per_point(job)) <= room

    most = min(ranks, surfaces)
    # If nothing fits, one group takes least memory on each rank; it needs a row for each.
    return min(filter(fits, range(most, 0, -1)), key=seconds, default=1 if ranks <= nx else most)


def bytes_per_point(job: Job) -> float:
    """Bytes per grid point at the peak: while a load is solved, or while an observable is measured."""
    costs = solving_costs(job) + measuring_costs(job)
    return FIELD_BYTES + WORKSPACE[job.solver.transform] + max(cost.memory for cost in costs)


def solving_costs(job: Job) -> list[Cost]:
    """What each load costs to solve."""
    method = job.wall.methods[0] if job.solver.method == "auto" else job.solver.method
    return [solver_cost(method, area) for area in contact_areas(job)]


def measuring_costs(job: Job) -> list[Cost]:
    """What the observables that are asked for cost, for one load."""
    return [observable.cost(job.grid, job.surface.cutoff(job.grid)) for observable in job.output.asked]


def contact_areas(job: Job) -> list[float]:
    """The relative contact area of each load: the prescribed one; else that of Persson's theory times 1 + `AREA_EXCESS`
    (1 − area); where neither is known, the area that costs most.
    """
    targets = job.load.targets
    if job.load.control == "contact_area":
        return list(targets)
    slope = job.surface.known_slope()
    if job.load.control != "pressure" or not slope:
        return [GAPS_FROM]
    full = job.solid.contact_modulus * slope / math.sqrt(2)
    areas = [math.erf(target / full) for target in targets]
    return [area * (1 + AREA_EXCESS * (1 - area)) for area in areas]


def report(job: Job, ranks: int) -> str:
    """The estimate as text, one line per quantity; raises InputError if the files of the surface cannot be used for the
    job.
    """
    understood = job.surface.check_inputs(job.grid, job.output.length_unit)
    found = estimate(job, ranks)
    nx, ny = job.grid.shape
    loads = len(job.load.targets)
    lines = {
        "grid": f"{nx} × {ny} points, cell {job.grid.lengths[0]:g} × {job.grid.lengths[1]:g}",
        "surface": ": ".join(filter(None, [job.surface.kind, understood])),
        "seeds": f"{len(job.surface.seeds)}, {rank_groups(job, ranks)} at a time" if job.surface.seeds else "",
        "loads": f"{loads} by {job.load.control}",
        "memory": f"about {readable(found.memory)} per rank on {counted(ranks, 'rank')} "
        f"({readable(BASE_BYTES)} and {bytes_per_point(job):.0f} bytes per grid point)",
        "files": readable(found.files),
        "time": f"about {duration(found.seconds)} on {counted(ranks, 'core')}",
    }
    width = max(map(len, lines))
    return "\n".join(f"{name:<{width}}  {value}" for name, value in lines.items() if value)


def duration(seconds: float) -> str:
    """A time in the unit that reads best, to two digits; days to three."""
    for limit, divisor, unit in ((120, 1, "s"), (7200, 60, "min"), (172800, 3600, "h")):
        if seconds < limit:
            return f"{float(f'{seconds / divisor:.2g}'):g} {unit}"
    return f"{float(f'{seconds / 86400:.3g}'):g} days"
