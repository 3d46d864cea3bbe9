"""Contact spectra of the elastic solid and of the bearing area: the same area, cut from the surface at one height.

    python tools/bearing_area.py DIR… [--area 0.09] [--window 8 128]

Needs the observables spectra and bearing.  Folders that differ by the seed alone are averaged; exponents are fitted to
each, and given with the standard error over the seeds.  Theory of the bearing area: μ = 2 + H.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import plotting
from plotting import BLACK, BLUE, RED, Findings, Sheet, fit_power_law
from reading import Case, by_hurst, cases, common_bins, nearest

from pgfmd.theory import bearing


def make(folders: list[Path], output: Path, area: float = 0.09, window: tuple[float, float] = (8, 128)) -> Findings:
    """One panel per H: both spectra, with power laws over the waves per cell in `window`."""
    groups = by_hurst(nearest(cases(folders), area, slack=0.15))
    sheet, findings = Sheet(1, len(groups)), Findings()
    for panel, (hurst, chosen) in enumerate(groups.items()):
        for kind, title, colour, marker, dashes in (
            ("contact", "elastic contact", RED, "o", "-"),
            ("bearing", "bearing area", BLUE, "s", "--"),
        ):
            waves, spectra = normalised(chosen, kind)
            inside = (waves >= window[0]) & (waves <= window[1])
            exponents = [fit_power_law(waves[inside], curve[inside])[0] for curve in spectra]
            mean = np.exp(np.log(spectra).mean(axis=0))
            sheet.curve(panel, waves, mean, title, color=colour, marker=marker, ls="none")
            findings.add(f"μ_c {title}, H = {hurst:g}", -np.array(exponents))
            slope, offset = fit_power_law(waves[inside], mean[inside])
            line = np.exp(offset[0]) * waves[inside] ** slope
            sheet.curve(panel, waves[inside], line, f"$\\mu$ = {-slope:.2f}", color=BLACK, ls=dashes, lw=1.0)
        findings.add(f"theory 2 + H of the bearing area, H = {hurst:g}", bearing.spectrum_exponent(hurst))
        text = f"H = {hurst:g}, $f_c$ = {chosen[0].area:.3f}; 2 + H = {bearing.spectrum_exponent(hurst):g}"
        spectrum = r"$f_c\,|\tilde\Theta(q)|^2\,/\,(1-f_c)\,|\tilde\Theta(0)|^2$"
        sheet.label(panel, "waves per cell, qL/2π", spectrum, text,
                    scale="log", legend="lower left")  # fmt: skip
    return plotting.finish(sheet, output, "bearing_area", findings)


def normalised(chosen: list[Case], kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Waves per cell (m,) and f_c |Θ̃|²/((1−f_c) |Θ̃(0)|²) of each case (cases, m)."""
    q, spectra = common_bins([case.spectrum(kind)[:2] for case in chosen])
    f = np.array([case.area for case in chosen])[:, None]
    return q / chosen[0].wave_unit, spectra / (f * (1 - f))


def options(parser):
    """The options of the command line."""
    parser.add_argument("--area", type=float, default=0.09, help="the load near this f_c (default 0.09)")
    parser.add_argument("--window", type=float, nargs=2, default=(8, 128), metavar=("FROM", "TO"),
                        help="waves per cell between which exponents are fitted (default 8 128)")  # fmt: skip


def main(arguments: list[str] | None = None) -> int:
    """The command line."""
    return plotting.command_line(make, __doc__, arguments, options)


if __name__ == "__main__":
    sys.exit(main())
