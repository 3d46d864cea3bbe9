"""Convergence with resolution: one band-limited surface at one load, on finer and finer grids.

    python tools/resolution.py DIR…

The finest grid's corrected area, mean gap and ⟨p²⟩ serve as the limit for the others; it is not drawn itself.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import plotting
from plotting import BLUE, GREEN, GREY, ORANGE, RED, Findings, Sheet, guide
from reading import Case, cases

from pgfmd.errors import InputError


def make(folders: list[Path], output: Path) -> Findings:
    """Deviations from the finest grid against the points per shortest wave."""
    found = sorted(cases(folders), key=lambda case: case.results.shape[0])
    if len(found) < 3:
        raise InputError("give at least three runs of one surface on different grids")
    resolution = np.array([case.wavelengths[0] / case.config.grid.steps[0] for case in found])
    limit, rest = found[-1], found[:-1]
    sheet, findings, x = Sheet(1, 2), Findings(), resolution[:-1]
    raw = np.array([case.area / limit.corrected_area - 1 for case in rest])
    corrected = np.array([case.corrected_area / limit.corrected_area - 1 for case in rest])
    for panel in (0, 1):
        size = np.abs if panel else np.asarray
        sheet.curve(panel, x, size(raw), "contact area, raw", color=RED, marker="o", ls="-")
        sheet.curve(panel, x, size(corrected), "contact area, corrected", color=BLUE, marker="s", ls="-")
    gap = np.array([case.number("mean_gap") / limit.number("mean_gap") - 1 for case in rest])
    square = np.array([_square(case) / _square(limit) - 1 for case in rest])
    sheet.curve(1, x, np.abs(gap), "mean gap", color=GREEN, marker="^", ls="-")
    sheet.curve(1, x, np.abs(square), r"$\langle p^2\rangle/\bar p^2$", color=ORANGE, marker="D", ls="-")
    guide(sheet.panels[1], x[[0, -1]], 0.6 * np.abs(raw[0]), -1, "−1")
    guide(sheet.panels[1], x[[0, -1]], 0.5 * np.abs(gap[0]), -2, "−2")
    sheet.panels[0].axhline(0, color=GREY, lw=0.8)
    sheet.label(0, r"$\lambda_s\,/\,a$", "deviation of the contact area", scale="semilogx")
    sheet.label(1, r"$\lambda_s\,/\,a$", "|deviation|", scale="log", legend="lower left")
    sheet.panels[1].set_ylim(bottom=sheet.panels[1].get_ylim()[0] / 100)  # room for the legend
    findings.add(f"corrected area on the finest grid, λ_s = {resolution[-1]:.3g} a", limit.corrected_area)
    for points, first, second, third, fourth in zip(x, raw, corrected, gap, square, strict=True):
        at = f"λ_s = {points:.3g} a"
        findings.add(f"area raw, {at}", first)
        findings.add(f"area corrected, {at}", second)
        findings.add(f"mean gap, {at}", third)
        findings.add(f"⟨p²⟩, {at}", fourth)
    return plotting.finish(sheet, output, "resolution", findings)


def _square(case: Case) -> float:
    """⟨p²⟩/p̄² over the whole surface = m₂/f_c."""
    return case.normalised_second_moment / case.area


def main(arguments: list[str] | None = None) -> int:
    """The command line."""
    return plotting.command_line(make, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
