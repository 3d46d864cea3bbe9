"""Real-space autocorrelations of stress and contact, and the bounds that tie them together.

    python tools/autocorrelations.py DIR… [--area 0.14]

From the observable acf, or from the field pressure in row blocks (a file larger than memory is no obstacle).  The
bounds are C_c ≤ C_σ/σ_c² ≤ m₂ C_c, m₂ = ⟨σ²⟩_c/σ_c²; with the constant 2 the upper one is that of the paper.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import plotting
from plotting import BLACK, BLUE, GREY, RED, Findings, Sheet
from reading import Case, cases, nearest

MARKS = (0.0, 1 / 8, 1 / 2, 1.0, 4.0)  # distances in λ_s whose ratio is reported


def make(folders: list[Path], output: Path, area: float | None = None) -> Findings:
    """C_σ/σ_c² and C_c with the bounds, and their ratio, of the load nearest to `area` (default: the last one)."""
    case = cases(folders)[-1] if area is None else nearest(cases(folders), area)[0]
    r, stress = case.correlation("stress")
    _, contact = case.correlation("contact")
    stress = stress / case.contact_pressure**2
    m2 = stress[0] / case.area
    unit, near = case.wavelengths[0], r > 0
    sheet = Sheet(1, 2)
    x = r[near] / unit
    sheet.curve(0, x, contact[near], r"$C_c$, lower bound", color=BLUE, ls="--")
    sheet.curve(0, x, 2 * contact[near], r"$2\,C_c$, upper bound", color=BLUE, ls=":")
    sheet.curve(0, x, stress[near], r"$C_\sigma/\sigma_c^2$", color=RED)
    sheet.curve(0, x, np.full(len(x), case.area**2), r"$f_c^2$: no correlation", color=GREY, lw=0.8)
    title = f"H = {case.hurst:g}, $f_c$ = {case.area:.3f}" if case.hurst is not None else None
    sheet.label(0, r"$\Delta r\,/\,\lambda_s$", "autocorrelation", title, scale="log")
    ratio = stress / contact
    sheet.curve(1, x, ratio[near], "simulation", color=RED)
    for value, name, style in ((1, "1", "--"), (m2, f"m₂ = {m2:.3f}", "-."), (2, "2", ":")):
        sheet.curve(1, x[[0, -1]], [value, value], name, color=BLACK, lw=0.8, ls=style)
    sheet.label(
        1,
        r"$\Delta r\,/\,\lambda_s$",
        r"$C_\sigma\,/\,(\sigma_c^2\,C_c)$",
        "the bounds",
        scale="semilogx",
        legend="upper right",
    )
    sheet.panels[1].set_ylim(top=2.6)  # room for the legend
    findings = Findings()
    findings.add("contact area f_c", case.area)
    findings.add("m₂ = C_σ(0)/(σ_c² f_c)", m2)
    for mark in MARKS:
        findings.add(f"C_σ/(σ_c² C_c) at {mark:g} λ_s", np.interp(mark * unit, r, ratio))
    findings.add("smallest ratio", ratio.min())
    findings.add("largest ratio", ratio.max())
    findings.add("C_c(0)/f_c − 1", contact[0] / case.area - 1)
    findings.add("C_σ(0)/(f_c ⟨σ²⟩_c) − 1", _square_residual(case, m2))
    return plotting.finish(sheet, output, "autocorrelations", findings)


def _square_residual(case: Case, m2: float) -> float:
    """m₂ of the autocorrelation against that of the pressures themselves, where the run kept their moments."""
    return m2 / case.normalised_second_moment - 1 if case.has("pressure_moments") else np.nan


def main(arguments: list[str] | None = None) -> int:
    """The command line."""
    return plotting.command_line(
        make,
        __doc__,
        arguments,
        lambda parser: parser.add_argument("--area", type=float, help="the load near this f_c"),
    )


if __name__ == "__main__":
    sys.exit(main())
