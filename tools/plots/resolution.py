"""Convergence with resolution: one problem at one load, on finer and finer grids.

The finest grid's corrected area, mean gap and ⟨p²⟩ serve as the limit for the others; it is not drawn itself.
"""

import math

import numpy as np
from plotting import BLUE, GREEN, GREY, ORANGE, RED, Sheet, guide
from reading import Load
from samples import difference

from pgfmd.errors import InputError

CAPTION = """Relative deviation from the finest grid against grid points per shortest wave: (a) contact area, (b)
absolute values for area, mean gap and mean square pressure, with power laws as guides."""
NEEDS = ("area",)


def draw(loads: list[Load]) -> Sheet:
    """Deviations from the finest grid against the resolution."""
    found, sheet = choose(loads)
    points = np.array([_resolution(load) for load in found])
    limit, rest, x = found[-1], found[:-1], points[:-1]
    raw = np.array([load.area / limit.corrected_area - 1 for load in rest])
    corrected = np.array([load.corrected_area / limit.corrected_area - 1 for load in rest])
    for panel in (0, 1):
        size = np.abs if panel else np.asarray
        sheet.curve(panel, x, size(raw), "area, raw", color=RED, marker="o")
        sheet.curve(panel, x, size(corrected), "area, corrected", color=BLUE, marker="s")
    gap = np.array([load.number("mean_gap") / limit.number("mean_gap") - 1 for load in rest])
    square = np.array([_square(load) / _square(limit) - 1 for load in rest])
    for values, name, colour, marker in ((gap, "mean gap", GREEN, "^"), (square, r"$\langle p^2\rangle$", ORANGE, "D")):
        if np.all(np.isfinite(values)):
            sheet.curve(1, x, np.abs(values), name, color=colour, marker=marker)
    for values, order in ((0.5 * np.abs(raw[0]), -1), (0.4 * np.abs(gap[0]), -2)):
        if len(x) > 1 and values > 0:
            guide(sheet.panels[1], x[[0, -1]], values, order, f"slope −{-order}")
    sheet.panels[0].axhline(0, color=GREY, lw=0.7)
    quantity = r"$\lambda_s\,/\,a$" if limit.hurst is not None else "grid points per side"
    sheet.label(0, quantity, "relative deviation of area", scale="semilogx", legend=False)
    sheet.label(1, quantity, "|relative deviation|", scale="log", columns=4, legend="figure")
    for panel in sheet.panels:
        panel.set_xticks(x, [f"{at:.3g}" for at in x])
        panel.set_xticks([], minor=True)
    sheet.findings.add(f"corrected area on the finest grid, {points[-1]:.3g}", limit.corrected_area)
    for at, *values in zip(x, raw, corrected, gap, square, strict=True):
        for name, value in zip(("area raw", "area corrected", "mean gap", "⟨p²⟩"), values, strict=True):
            sheet.findings.add(
                f"{name}, λ_s = {at:.3g} a" if limit.hurst is not None else f"{name}, n = {at:.3g}", value
            )
    return sheet


def choose(loads: list[Load]) -> tuple[list[Load], Sheet]:
    """One load of each grid, coarse to fine, all of one problem; with the sheet that says what was left out.

    Raises InputError if the loads are not of one problem, or of fewer than three grids.
    """
    differing = difference(loads)
    if differing is not None:
        raise InputError(f"resolution takes one problem on several grids; these runs differ by {differing}")
    seeds = {load.seed for load in loads}
    if len(seeds) > 1:
        raise InputError("resolution takes one problem on several grids; these runs differ by surface.seed")
    by_target: dict[tuple, dict[tuple, Load]] = {}
    for load in loads:
        by_target.setdefault(load.target, {})[load.results.shape] = load
    target, grids = max(by_target.items(), key=lambda item: len(item[1]))
    if len(grids) < 3:
        raise InputError(
            f"resolution takes one load on at least three grids; at most {len(grids)} of these runs share one"
        )
    sheet = Sheet(1, 2)
    if len(by_target) > 1:
        sheet.notes.append(f"of {len(by_target)} loads, {target[0]} = {target[1]:g} is drawn")
    return [grids[shape] for shape in sorted(grids)], sheet


def _resolution(load: Load) -> float:
    return load.wavelengths[0] / load.spacings[0] if load.hurst is not None else float(load.results.shape[0])


def _square(load: Load) -> float:
    """⟨p²⟩/p̄² over the whole surface = m₂/f_c; NaN where the moments were not kept."""
    return load.normalised_second_moment / load.area if load.area else math.nan
