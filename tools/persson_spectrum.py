"""The stress spectrum over that of full contact, beside the contact area f(q) seen at magnification q.

    python tools/persson_spectrum.py DIR [--areas …] [--gamma 0.45] [--name persson_spectrum]

Persson's theory says that the ratio is f(q) = erf(√2 p̄/(E' g(q))).  Needs the observable spectra; with lowpass, f(q) is
drawn as measured on the surface low-passed at q, at the same load.  The third curve is f (γ + (1−γ) f²), Yang & Persson
(2008).
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import plotting
from plotting import BLACK, BLUE, GREEN, ORANGE, Findings, Sheet
from reading import Case, cases, common_bins, nearest

from pgfmd.theory import persson


def make(
    folders: list[Path],
    output: Path,
    areas: list[float] | None = None,
    gamma: float = 0.45,
    name: str = "persson_spectrum",
) -> Findings:
    """One panel for each load of the first folder."""
    found = cases(folders[:1])
    chosen = [nearest(found, area)[0] for area in areas] if areas else found
    columns = min(3, len(chosen))
    sheet, findings = Sheet(-(-len(chosen) // columns), columns), Findings()
    for axes in sheet.panels[len(chosen) :]:
        axes.remove()
    sheet.panels = sheet.panels[: len(chosen)]
    for panel, case in enumerate(chosen):
        _draw(sheet, panel, case, gamma, findings)
    return plotting.finish(sheet, output, name, findings)


def ratio(case: Case) -> tuple[np.ndarray, np.ndarray]:
    """q and |σ̃|² over that of full contact, (E'q/2)² |h̃|²; bins without roughness left out."""
    q, stress, _ = case.spectrum("stress")
    q_height, height, _ = case.spectrum("height")
    full = persson.full_contact_spectrum(q_height, height, contact_modulus=case.modulus)
    rough = (q_height <= case.q_limits[1] * (1 + 1e-9)) & (full > 0)
    common_bins([(q, stress), (q_height, height)])
    return q[rough], stress[rough] / full[rough]


def _draw(sheet: Sheet, panel: int, case: Case, gamma: float, findings: Findings):
    q, measured = ratio(case)
    waves = q / case.wave_unit
    q_height, height, count = case.spectrum("height")
    theory = persson.scale_contact_fraction(case.load, q_height, height, count, contact_modulus=case.modulus)
    corrected = theory * persson.energy_factor(theory, gamma)
    x = q_height / case.wave_unit
    shown = q_height <= case.q_limits[1] * (1 + 1e-9)
    sheet.curve(panel, waves, measured, r"$|\tilde\sigma|^2$ / full contact", color=BLUE, marker="o", ls="none")
    sheet.curve(panel, x[shown], theory[shown], "f(q), Persson", color=BLACK)
    sheet.curve(panel, x[shown], corrected[shown], f"f(q) with γ = {gamma:g}", color=GREEN, ls=":")
    title = f"$f_c$ = {case.area:.3f}"
    inner = (waves >= 4) & (q <= case.q_limits[1] / 2)
    at = f"f_c = {case.area:.2f}"
    findings.add(f"load at {at}", case.load)
    findings.add(f"ratio/f_Persson, mean over 4 waves … λ = 2 λ_s, {at}",
                 (measured / np.interp(q, q_height, theory))[inner].mean())  # fmt: skip
    if case.has("lowpass_area"):
        kept = case.groups["lowpass_area"]
        sheet.curve(
            panel,
            kept["q"] / case.wave_unit,
            kept["area_corrected"],
            "f(q), low-passed surface",
            color=ORANGE,
            marker="s",
            ls="--",
        )
        numeric = np.exp(np.interp(np.log(q), np.log(kept["q"]), np.log(np.maximum(kept["area_corrected"], 1e-12))))
        findings.add(f"ratio/f_numerical, {at}", (measured / numeric)[inner].mean())
        known = np.interp(kept["q"], q_height, theory)
        findings.add(f"f_numerical/f_Persson at the shortest wave, {at}", kept["area_corrected"][-1] / known[-1])
    hurst = f"H = {case.hurst:g}, " if case.hurst is not None else ""
    sheet.label(panel, "waves per cell, qL/2π", "ratio to full contact, f(q)", hurst + title, scale="log",
                legend="lower left" if panel == 0 else False)  # fmt: skip
    low = min(measured.min(), corrected[shown].min())
    sheet.panels[panel].set_ylim(min((0.2 if panel == 0 else 0.6) * low, 0.5), 1.6)


def options(parser):
    """The options of the command line."""
    parser.add_argument("--areas", type=float, nargs="+", help="only the loads near these f_c")
    parser.add_argument("--gamma", type=float, default=0.45, help="γ of the corrected theory (default 0.45)")
    parser.add_argument("--name", default="persson_spectrum", help="name of the picture")


def main(arguments: list[str] | None = None) -> int:
    """The command line."""
    return plotting.command_line(make, __doc__, arguments, options)


if __name__ == "__main__":
    sys.exit(main())
