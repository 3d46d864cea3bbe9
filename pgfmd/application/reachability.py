"""Whether what a job imposes can be reached on its surface, as far as that is known without a solution."""

from __future__ import annotations

import dataclasses
import math

from pgfmd.application.job import Job
from pgfmd.errors import InputError, Unreachable
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.parallel.mpi import ALONE
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.load_control import LoadControl
from pgfmd.surfaces.rigid_surface import refined_heights

LARGEST = 2**22  # points of the surfaces that are made for this: a few seconds


def doubts(job: Job) -> list[str]:
    """A line for each target of a job that no load gives, or that a seed of an ensemble refuses; or one that says that
    the surface has too many points for this test.  The surface is made in this process alone.

    Raises InputError for a target, and for a surface, that a run would refuse before its first solution.
    """
    if job.imposed.control == "pressure" or not job.wall.convex:
        return []  # any surface takes it
    seeds = job.surface.seeds
    surfaces = [dataclasses.replace(job.surface, seed=seed) for seed in seeds] if seeds else [job.surface]  # type: ignore[call-arg]
    if math.prod(job.cell.shape) * len(surfaces) > LARGEST:
        return [f"whether each {job.load.control} can be reached is tested up to {LARGEST} points only"]
    lines: dict[str, None] = {}
    for seed, surface in zip(seeds or (0,), surfaces, strict=True):
        grid = SlabGrid(ALONE, job.cell.shape, job.cell.lengths, domain=job.cell.domain)
        heights = refined_heights(surface, job.grid, grid, job.output.length_unit)
        problem = ContactProblem(grid, heights, job.solid, job.wall)
        control = LoadControl(job.load, problem).control
        for target in job.load.targets:
            try:
                control.check_target(target)
                control.check_reachable(target)
            except Unreachable as failure:
                lines[str(failure)] = None
            except InputError as failure:
                if not seeds:
                    raise
                lines[f"seed {seed}: {failure}"] = None  # its other loads are solved
        grid.free()
    return list(lines)
