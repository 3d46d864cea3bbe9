"""What a run will take: memory, files, time.  Used by `pgfmd check`; no MPI here."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pgfmd.job.job import Job
from pgfmd.observables.observable import Cost
from pgfmd.run.memory import readable

# The arrays that live at the peak of a run, in bytes per grid point, summed over ranks.
ARRAYS = {
    "heights": 8,
    "heights about their mean, over their rms value": 8,
    "pressure": 8,
    "gap": 8,
    "strips of the transforms": 8,
}
# Per unknown of the hard wall, which is the pressure of a point in contact or, where these are the majority, the gap of
# one that is not: its column, now and before (8), direction, image, residual, preconditioned one, change (20), and for
# pressures the residual without means of blocks, tensions cut off and the response to that, with their halo (15).
PER_PRESSURE, PER_GAP = 43, 28
MOSTLY = 0.45  # contact area above which gaps are the unknowns
MORE = 0.22  # contact area of self-affine surfaces at small loads, over that of Persson's theory, less one
HARD = {"mesh of half the side: strips, field, influence": 4, "means over blocks, their response": 1}
# Newton's vectors for the exponential wall, single precision where that serves.
EXPONENTIAL = {
    "pressure's root, residual, direction, image, change, response": 24,
    "targets and their sums": 34,
    "rows of the coarse grid": 6,
}
MEASURING = 32.0  # heights, pressure, gap and strips, while an observable is measured
PER_RANK = 6e6  # bytes: blocks of the transforms

# What a solve to the default tolerance takes, in forward + backward transforms of double precision (the hard wall does
# about 10 and other work worth 30; up to three times that on surfaces rough down to the grid); and seconds per grid
# point of one of them on one core of a 2020s machine (FFTW, 4096 × 4096).
TRANSFORMS = {"hard": 40, "exponential": 15}
SECONDS_PER_POINT = 1.4e-8
SOLVES_PER_AREA = 4  # loads tried until one contact area is met


@dataclass(frozen=True)
class Estimate:
    """Bytes per rank at the peak, bytes of all files, seconds of the whole run."""

    memory: float
    files: float
    seconds: float


def estimate(job: Job, ranks: int) -> Estimate:
    """Memory per rank, size of the files and time of the job on `ranks` ranks with one core each, roughly."""
    points = job.grid.n[0] * job.grid.n[1]
    rows = -(-job.grid.n[0] // ranks)
    loads = len(job.load.targets)
    width = 4 if job.output.precision == "float32" else 8
    fields = sum(1 if name == "height" else loads for name in job.output.fields)
    solves = loads * (1 if job.load.control == "pressure" else SOLVES_PER_AREA)
    work = TRANSFORMS[job.wall.kind] * solves + sum(cost.transforms for cost in costs(job)) * loads
    return Estimate(
        memory=bytes_per_point(job) * rows * job.grid.n[1] + PER_RANK,
        files=fields * points * width,
        seconds=work * points * SECONDS_PER_POINT / ranks,
    )


def bytes_per_point(job: Job) -> float:
    """Bytes per grid point at the peak, over all ranks: while a load is solved, or an observable measured."""
    if job.wall.kind == "exponential":
        solving = sum(ARRAYS.values()) + sum(EXPONENTIAL.values())
    else:
        sets = (PER_PRESSURE * area if area <= MOSTLY else PER_GAP * (1 - area) for area in contact_areas(job))
        solving = sum(ARRAYS.values()) + sum(HARD.values()) + max(sets)
    return max(solving, MEASURING + max((cost.memory for cost in costs(job)), default=0.0))


def costs(job: Job) -> list[Cost]:
    """What the observables that are asked for cost, for one load."""
    return [observable.cost(job.grid, job.surface.cutoff(job.grid)) for observable in job.output.asked]


def contact_areas(job: Job) -> list[float]:
    """The relative contact area of each load: that asked for, or by Persson's theory and by how much more there is, or
    the dearest if neither helps.
    """
    targets = job.load.targets
    if job.load.control == "contact_area":
        return list(targets)
    slope = job.surface.known_slope()
    if job.load.control != "pressure" or not slope:
        return [MOSTLY]
    full = job.solid.contact_modulus * slope / math.sqrt(2)
    areas = [math.erf(target / full) for target in targets]
    return [area * (1 + MORE * (1 - area)) for area in areas]


def report(job: Job, ranks: int) -> str:
    """The estimate as text, one line per quantity; raises InputError if the surface's files do not serve the job."""
    understood = job.surface.check_inputs(job.grid, job.output.length_unit)
    found = estimate(job, ranks)
    nx, ny = job.grid.shape
    loads = len(job.load.targets)
    lines = {
        "grid": f"{nx} × {ny} points, cell {job.grid.lengths[0]:g} × {job.grid.lengths[1]:g}",
        "surface": ": ".join(filter(None, [job.surface.kind, understood])),
        "loads": f"{loads} by {job.load.control}",
        "memory": f"about {readable(found.memory)} per rank on {ranks} rank{'s' * (ranks > 1)} "
        f"({bytes_per_point(job):.0f} bytes per grid point)",
        "files": readable(found.files),
        "time": f"about {duration(found.seconds)} on {ranks} core{'s' * (ranks > 1)}",
    }
    width = max(map(len, lines))
    return "\n".join(f"{name:<{width}}  {value}" for name, value in lines.items())


def duration(seconds: float) -> str:
    """A time in the unit that reads best."""
    for limit, divisor, unit in ((120, 1, "s"), (7200, 60, "min"), (172800, 3600, "h")):
        if seconds < limit:
            return f"{seconds / divisor:.2g} {unit}"
    return f"{seconds / 86400:.3g} days"
