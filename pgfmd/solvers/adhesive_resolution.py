"""Whether a grid resolves an attraction, and whether rough surfaces stick by it."""

from __future__ import annotations

import logging
import math

import numpy as np

from pgfmd.errors import InputError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.physics.laws.adhesive_laws import AttractiveWall
from pgfmd.physics.problem import ContactProblem
from pgfmd.theory import adhesion

WARNED, REFUSED = 2.0, 0.8  # process zone in pixels: the edge of a straight contact errs by 1–2 % at 2, 5–11 % at .8
SUMMIT_PIXELS = 4.0  # along √(2Rρ), for μ_T ≤ 1
ROUNDING = 1e-6  # a part of a point, by which numbers of points may be too large
log = logging.getLogger("pgfmd")


def roughness(problem: ContactProblem) -> tuple[float, float]:
    """Rms of |∇h| and of ∇²h by differences between neighbours, the border left out.  Collective."""
    grid, own = problem.grid, problem.heights
    last = min(grid.rows.stop + 2, grid.shape[0]) if len(own) else grid.rows.stop
    after, pixel = grid.fetch(own, grid.rows.stop, last), max(grid.spacing)
    dx, dy = (a / pixel for a in grid.spacing)

    def sums_of(first: int, stop: int) -> list[float]:
        rows = np.concatenate([own[first : stop + 2], after[: max(0, stop + 2 - len(own))]]) / pixel
        x, y = np.diff(rows, axis=0)[: stop - first] / dx, np.diff(rows[: stop - first], axis=1) / dy
        bend = np.diff(rows, 2, axis=0)[:, 1:-1] / dx**2 + np.diff(rows[1:-1], 2, axis=1) / dy**2
        return [float(v) for each in (x, y, bend) for v in (np.vdot(each, each), each.size)]

    sums = grid.reduction.sums(*np.sum(grid.threads.collect(sums_of, len(own), grid.band), axis=0))
    return math.hypot(*np.sqrt(sums[0:3:2] / np.maximum(sums[1:4:2], 1))), math.sqrt(sums[4] / max(sums[5], 1)) / pixel


def resolved(problem: ContactProblem, law: AttractiveWall) -> float:
    """The criterion of stickiness; NaN for a flat surface.  Warns where the process zone ℓ = ρ²E'/w is shorter than 2
    pixels, or for μ_T ≤ 1 √(2Rρ), the radius within which a summit is as near as ρ, than 4 pixels.  Raises InputError
    where ℓ is below .8 pixels, unless the law allows it: the grid then pins the edge of a contact.  Collective.
    """
    modulus, pixel, (reach, stress) = problem.solid.contact_modulus, max(problem.grid.spacing), law.units
    zone, alone = law.process_zone(modulus), problem.grid.comm.rank == 0
    points = _points(problem.grid, WARNED / (zone / pixel) if zone else math.inf)
    text = f"wall: the process zone ρ²E'/w = {zone:.3g} is {zone / pixel:.2g} pixels; 2 need grid.n = {points}"
    if zone < REFUSED * pixel and not law.unresolved:
        raise InputError(f"{text}; below {REFUSED:g} the grid pins contact edges (wall.unresolved = true: solve)")
    if zone < WARNED * pixel and alone:
        log.warning("%s: areas err by about 2 %% at 1.3 pixels, pull-off forces by 1 %%, 11 %% at .8", text)
    slope, bend = roughness(problem)
    if not slope or not bend:
        return math.nan
    radius = 2 / bend  # of a paraboloid, and a typical one of summits
    mu, within = adhesion.transition(stress / modulus, 1.0, radius / reach, 1.0), reach * math.sqrt(2 * radius / reach)
    if mu <= 1 and within < SUMMIT_PIXELS * pixel and alone:
        log.warning(
            "wall: with μ_T = %.2g, summits attract within √(2Rρ) = %.3g, %.2g pixels; %g need grid.n = %s: "
            "pull-off forces err by 6 %% at 2 pixels, by 8 to 40 %% at 1",
            mu, within, within / pixel, SUMMIT_PIXELS, _points(problem.grid, SUMMIT_PIXELS / (within / pixel)),
        )  # fmt: skip
    found = adhesion.stickiness(stress / modulus, 1.0, slope, bend * reach, 1.0)
    if alone:
        log.info("wall: stickiness criterion of Pastewka and Robbins %.3g; rough surfaces stick below 1", found)
    return found


def _points(grid: SlabGrid, factor: float) -> str:
    """The points of a grid whose pixels are so many times smaller than the longer sides of these: one number, or both
    where they differ.
    """
    counts = [np.ceil(factor * length / max(grid.spacing) - ROUNDING) for length in grid.lengths]
    return f"{counts[0]:.9g}" if counts[0] == counts[1] else f"[{counts[0]:.9g}, {counts[1]:.9g}]"
