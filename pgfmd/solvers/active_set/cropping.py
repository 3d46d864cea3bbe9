"""Contacts that fill a part of an open patch of a half-space, solved on the rectangle that can bear pressure.

Pressure displaces the whole surface inwards, u ≥ 0.  So contact lies where h + λ ≥ 0, no farther below the highest
point than the approach, which is estimated on a grid of an eighth of the points each way.  With the kernel of the
patch, the solution of a rectangle is that of the patch if h + λ < 0 outside, also for the largest λ that the
certificate leaves possible: continued by p = 0 it obeys all conditions.  Its certificate is then one of the patch.
This is checked, and that the gap of the whole patch, computed once, is nowhere negative; else the rectangle grows.
"""

from __future__ import annotations

import dataclasses
import math
import time

import numpy as np

from pgfmd.errors import InputError, SolverError
from pgfmd.grid.domain import Cropped, Rectangle, few
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.transfer import SubGrid, restrict_locally
from pgfmd.parallel.collectives import shared
from pgfmd.physics.problem import ContactProblem
from pgfmd.physics.solids.open_kernel import cropped_table, positive
from pgfmd.solvers.active_set.contact_from_coarse import ActiveSetIteration
from pgfmd.solvers.nested_iteration import COARSEST
from pgfmd.solvers.solution import ContactSolution, Monitor

HALVINGS, LOOSE = 3, 1e-3  # of the points each way for the estimate, and its certified error
MARGIN, LATER, TRIALS = 1.05, 1.05, 3  # factors on the approach, first and later; rectangles before all is solved
SMALLEST, WORTH = 16, 0.5  # points of a side, and largest part of the patch
MODERATE = 1e30  # of ranges of heights, which the estimate keeps in single precision
SINGLE = 1e-9  # tolerance from which single precision serves for the gap outside


def solve_hard_wall(
    problem: ContactProblem,
    tolerance: float = 1e-8,
    start: np.ndarray | None = None,
    monitor: Monitor | None = None,
) -> ContactSolution:
    """The contact as `NestedIteration.contact` finds it, where possible on a rectangle.  Collective."""
    grid, found, begun, iterations, spent = problem.grid, None, time.perf_counter(), 0, 0.0
    if not grid.domain.wraps and problem.law.kind == "hard" and problem.solid.only_inwards:
        try:
            depth, spent = _estimate(problem)
            for _ in range(TRIALS):
                box = _higher(problem, depth, (max(SMALLEST, grid.comm.size), SMALLEST))
                if not _worth(grid, box):
                    break
                found, proved = _on_rectangle(problem, box, tolerance, start, monitor)
                iterations, spent = iterations + found.iterations, spent + found.transforms
                if proved:
                    break
                # A smaller rectangle sinks in deeper.
                depth, found = LATER * max(depth, found.approach), None
        except (SolverError, InputError) as failure:
            if not shared(grid.comm, failure):
                raise
    if found is None:
        found = ActiveSetIteration.contact(problem, tolerance, start, monitor)
        iterations, spent = iterations + found.iterations, spent + found.transforms
    return dataclasses.replace(found, iterations=iterations, transforms=spent, seconds=time.perf_counter() - begun)


def _worth(grid: SlabGrid, box: Rectangle) -> bool:
    return math.prod(stop - first for first, stop in box) <= WORTH * grid.size


def _higher(problem: ContactProblem, depth: float, least: tuple[int, int] = (1, 1)) -> Rectangle:
    """The rectangle of points within `depth` of the top; with a `least`, sides are rounded up by `few`.  Collective."""
    grid, heights = problem.grid, problem.heights
    level, rows = grid.reduction.max(heights) - depth, np.zeros(grid.shape[0], bool)

    def find(first: int, stop: int) -> tuple[np.ndarray, np.ndarray]:
        above = heights[first:stop] >= level
        return np.any(above, axis=1), np.any(above, axis=0)

    own, columns = zip(*grid.threads.collect(find, len(heights), grid.band), strict=True)
    rows[grid.rows] = np.concatenate(own)

    def ends(some: np.ndarray, least: int) -> tuple[int, int]:
        places = np.flatnonzero(some)
        first, last = (int(pick(places.astype(float))) for pick in (grid.reduction.min, grid.reduction.max))
        count = last + 1 - first if least == 1 else min(few(max(last + 1 - first, least)), len(some))
        first = max(0, min(first - (count - (last + 1 - first)) // 2, len(some) - count))
        return first, first + count

    return ends(rows, least[0]), ends(np.any(columns, axis=0), least[1])


def _estimate(problem: ContactProblem) -> tuple[float, float]:
    """How deep below the highest point contact may reach, with a margin, inf if not worth knowing; and transforms
    spent.  Collective.
    """
    grid, imposed = problem.grid, problem.imposed
    top = grid.reduction.max(problem.heights)
    height = top - grid.reduction.min(problem.heights)
    if min(grid.shape) < COARSEST << HALVINGS or problem.mean_pressure <= 0 or not 1 / MODERATE < height < MODERATE:
        return math.inf, 0.0
    if imposed is not None and not imposed.area:
        return MARGIN * imposed.approach, 0.0
    # A rigid disc around the patch sinks in by less than the contact.
    force = problem.mean_pressure * math.prod(grid.lengths) if imposed is None else 0.0
    if not _worth(grid, _higher(problem, force / (problem.solid.contact_modulus * math.hypot(*grid.lengths)))):
        return math.inf, 0.0
    heights = np.subtract(problem.heights, top, out=grid.new_field(np.float32), casting="same_kind")
    level, work = _level(problem.on(grid, heights), HALVINGS)
    return MARGIN * level, work / grid.size


def _level(problem: ContactProblem, halvings: int) -> tuple[float, float]:
    """Depth of λ below height 0, the highest of the finest grid, on a grid of half as many points each way, so many
    times; and transforms times points.  Collective.
    """
    grid = problem.grid
    if not halvings:
        with grid.freed():
            found = ActiveSetIteration.contact(problem, LOOSE)
        highest = min(grid.reduction.max(problem.heights), 0.0)  # above 0 beside cliffs, where coarse heights overshoot
        return found.approach - highest, found.transforms * grid.size
    place = SubGrid.coarse(grid)
    heights = restrict_locally(grid, place, problem.heights)
    return place.on_all(lambda coarse: _level(problem.on(coarse, heights), halvings - 1))


def _on_rectangle(
    problem: ContactProblem, box: Rectangle, tolerance: float, start: np.ndarray | None, monitor: Monitor | None
) -> tuple[ContactSolution, bool]:
    """The solution of a rectangle, continued to the patch, and whether it is proved to be the patch's.  Collective."""
    grid, solid, ((top, bottom), (left, right)) = problem.grid, problem.solid, box
    shape, (ax, ay) = (bottom - top, right - left), grid.spacing
    wide = grid.like(grid.comm, grid.shape, grid.lengths, Cropped(box=box))
    part = grid.like(grid.comm, shape, (shape[0] * ax, shape[1] * ay))
    solid.open_table(wide)
    part.tables.update({name: positive(part, cropped_table(wide, part, wide.tables[name])) for name in wide.tables})
    share, imposed = part.size / grid.size, problem.imposed

    def cut(field: np.ndarray) -> np.ndarray:
        rows = np.ascontiguousarray(field[:, left:right])
        return grid.layout.fetch(rows, top + part.rows.start, top + part.rows.stop)

    def put(field: np.ndarray, into: np.ndarray) -> np.ndarray:
        low, high = (min(max(row, top), bottom) for row in (grid.rows.start, grid.rows.stop))
        rows = slice(low - grid.rows.start, high - grid.rows.start)
        into[rows, left:right] = part.layout.fetch(field, low - top, high - top)
        return into

    inside = problem.on(part, cut(problem.heights)).imposing(
        imposed and dataclasses.replace(imposed, area=imposed.area / share), problem.mean_pressure / share
    )
    begin = None if start is None else cut(start)
    if begin is not None and not part.reduction.sum(begin) > 0:
        begin = None
    grid.free()
    with part.freed():
        found = ActiveSetIteration.contact(inside, tolerance, begin, monitor, overwrite_heights=True)
    part.tables.clear()
    del inside, begin
    pressure, most = put(found.pressure, np.zeros(grid.local_shape)), float(grid.reduction.max(found.pressure))
    found = dataclasses.replace(found, pressure=pressure)  # that of the rectangle goes before the gap comes
    gap, height = np.empty(grid.local_shape), most * max(ax, ay) / solid.contact_modulus
    level = found.approach - grid.reduction.max(problem.heights)

    def fill(first: int, stop: int, rows: np.ndarray) -> None:
        np.divide(pressure[first:stop], most, out=rows, casting="same_kind")

    def drain(first: int, stop: int, rows: np.ndarray) -> None:
        np.multiply(rows, height, out=gap[first:stop], dtype=np.float64)
        gap[first:stop] -= problem.heights[first:stop] + level

    real = np.dtype(np.float32 if tolerance >= SINGLE else np.float64)
    with wide.freed():
        action = solid.in_units(height, most).apply_compliance(wide, real, 1 / wide.modes)
        wide.convolve(fill, action, drain, real, (top, bottom))
    put(found.gap, gap)
    # The error of λ is that of `controls.MeanGap`.
    error, reach = found.certified_error, found.elastic_energy / found.mean_pressure
    higher = _higher(problem, found.approach + reach * (2 * math.sqrt(2 * error) + 2 * error))
    proved = all(a <= c and d <= b for (a, b), (c, d) in zip(box, higher, strict=True))
    mean = problem.mean_pressure if imposed is None else found.mean_pressure * share
    return dataclasses.replace(
        found, pressure=pressure, gap=gap, mean_pressure=mean, mean_gap=grid.reduction.sum(gap) / grid.size,
        elastic_energy=found.elastic_energy * share, transforms=found.transforms * share + wide.transforms,
        plastic_depth=np.zeros(gap.shape), cut=found.cut * share,
    ), proved and grid.reduction.min(gap) >= 0  # fmt: skip
