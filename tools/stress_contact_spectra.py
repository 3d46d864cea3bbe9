"""The stress spectrum against the contact spectrum: are they the same function?

    python tools/stress_contact_spectra.py DIR… [--areas 0.04 0.08]

From the observable spectra, or from the field pressure.  Each point is one bin in |q|; folders that differ by the seed
alone are averaged.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import plotting
from plotting import BLACK, COLOURS, GREY, MARKERS, Findings, Sheet
from reading import Case, by_hurst, cases, common_bins, nearest


def make(folders: list[Path], output: Path, areas: list[float] | None = None) -> Findings:
    """|σ̃|²/σ_c² against |Θ̃|², and their ratio against q, for each H and each area."""
    found, sheet, findings, number = cases(folders), Sheet(1, 2), Findings(), 0
    for hurst, group in by_hurst(found).items():
        for area in areas or sorted({round(case.area, 2) for case in group}):
            chosen = nearest(group, area)
            waves, contact, ratio = averaged(chosen)
            name = f"H = {hurst:g}, $f_c$ = {area:g}"
            style = {"color": COLOURS[number % len(COLOURS)], "marker": MARKERS[number % len(MARKERS)]}
            sheet.curve(0, contact, contact * ratio, name, ls="none", ms=2.5, **style)
            sheet.curve(1, waves, ratio, name, lw=0.8, ms=2, **style)
            findings.add(f"ratio at the longest waves (up to 8 per cell), H = {hurst:g}, f_c = {area:g}",
                         ratio[waves < 8.5].mean())  # fmt: skip
            findings.add(f"ratio at the shortest waves, H = {hurst:g}, f_c = {area:g}", ratio[-5:].mean())
            number += 1
    low, high = sheet.panels[0].dataLim.intervalx
    sheet.curve(0, [low, high], [low, high], "equal", color=BLACK, lw=0.8)
    sheet.curve(0, [low, high], [2 * low, 2 * high], "twice", color=GREY, lw=0.8, ls="--")
    sheet.label(0, r"$|\tilde\Theta(q)|^2$", r"$|\tilde\sigma(q)|^2\,/\,\sigma_c^2$", scale="log")
    sheet.panels[1].axhline(1, color=BLACK, lw=0.8)
    sheet.label(1, "waves per cell, qL/2π", r"$|\tilde\sigma|^2\,/\,(\sigma_c^2\,|\tilde\Theta|^2)$", scale="semilogx",
                legend=False)  # fmt: skip
    return plotting.finish(sheet, output, "stress_contact_spectra", findings)


def averaged(chosen: list[Case]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Waves per cell, contact spectrum and |σ̃|²/(σ_c² |Θ̃|²), averaged over the seeds."""
    contacts = [case.spectrum("contact")[:2] for case in chosen]
    q, contact = common_bins(contacts)
    ratio = np.array([case.spectrum("stress")[1] / case.contact_pressure**2 for case in chosen]) / contact
    return q / chosen[0].wave_unit, contact.mean(axis=0), ratio.mean(axis=0)


def main(arguments: list[str] | None = None) -> int:
    """The command line."""
    return plotting.command_line(
        make, __doc__, arguments,
        lambda parser: parser.add_argument("--areas", type=float, nargs="+", help="only the loads near these f_c"),
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
