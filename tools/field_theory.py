"""Exponential walls against field theory: |σ̃|² = G₁² (E'q/2)² |h̃|², G₁ = 1/(1 + ζ q E'/(2 p̄)).

    python tools/field_theory.py DIR…

Folders that differ by the seed alone are averaged; bands in waves per cell carry the standard error over the seeds.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import plotting
from persson_spectrum import ratio
from plotting import BLACK, COLOURS, MARKERS, Findings, Sheet
from reading import Case, cases, common_bins

from pgfmd.theory import exponential

BANDS = ((1, 1), (2, 3), (4, 7), (8, 15), (16, 32))  # waves per cell, both ends included


def make(folders: list[Path], output: Path) -> Findings:
    """The ratio to full contact with G₁², and in bands the ratio to field theory, for each ζ."""
    walls: dict[float, list[Case]] = {}
    for case in sorted(cases(folders), key=lambda case: getattr(case.config.wall, "zeta", 0.0)):
        if case.config.wall.kind == "exponential":
            walls.setdefault(case.config.wall.zeta, []).append(case)
    sheet, findings = Sheet(1, 2), Findings()
    for number, (zeta, chosen) in enumerate(walls.items()):
        style = {"color": COLOURS[number % len(COLOURS)], "marker": MARKERS[number % len(MARKERS)]}
        q, ratios = common_bins([ratio(case) for case in chosen])
        waves = q / chosen[0].wave_unit
        name = f"ζ = {zeta:g}"
        sheet.curve(0, waves, ratios.mean(axis=0), name, ls="none", **style)
        theory = np.array([_response(case, q) for case in chosen])
        sheet.curve(0, waves, theory.mean(axis=0), f"$G_1^2$, {name}", color=style["color"], label=False)
        averages = bands(waves, ratios / theory, chosen[0])
        for (low, high), values in zip(BANDS, averages.T, strict=True):
            findings.add(f"ratio to G₁² full contact, {name}, k = {low}–{high}", values)
        middle = [np.sqrt(low * high) for low, high in BANDS]
        error = averages.std(axis=0, ddof=1) / np.sqrt(len(chosen)) if len(chosen) > 1 else None
        sheet.curve(
            1, np.multiply(middle, 1 + 0.04 * number), averages.mean(axis=0), name, error=error, ls="-", lw=0.8, **style
        )
    sheet.label(0, "waves per cell, qL/2π", r"$|\tilde\sigma|^2$ / full contact", "lines: field theory", scale="log")
    sheet.panels[1].axhline(1, color=BLACK, lw=0.8)
    sheet.label(1, "waves per cell, qL/2π", "ratio to field theory", "in bands, with standard error", scale="semilogx")
    return plotting.finish(sheet, output, "field_theory", findings)


def bands(waves: np.ndarray, values: np.ndarray, case: Case) -> np.ndarray:
    """Means of (cases, m) values over all modes of each band: (cases, bands); NaN where a band holds no mode."""
    q, _, count = case.spectrum("stress")
    weight = np.interp(waves * case.wave_unit, q, count)
    means = []
    for low, high in BANDS:
        inside = (waves > low - 0.5) & (waves <= high + 0.5)
        empty = np.full(len(values), np.nan)
        means.append(np.average(values[:, inside], axis=1, weights=weight[inside]) if np.any(inside) else empty)
    return np.array(means).T


def _response(case: Case, q: np.ndarray) -> np.ndarray:
    return exponential.response(q, case.load, case.config.wall.zeta, contact_modulus=case.modulus) ** 2


def main(arguments: list[str] | None = None) -> int:
    """The command line."""
    return plotting.command_line(make, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
