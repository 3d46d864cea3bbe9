"""The distribution of contact pressures beside Persson's theory.

    python tools/pressure_distribution.py DIR… [--area 0.08]

Needs the observable histogram.  Theory at the load of the run, with the surface's own slope: no free parameter.  The
broken curve is the same form with the width that fits best.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import plotting
from plotting import BLACK, COLOURS, MARKERS, RED, Findings, Sheet
from reading import Case, cases, nearest

from pgfmd.theory import persson


def distribution(case: Case) -> tuple[np.ndarray, np.ndarray]:
    """Bin edges (m+1,) and P(σ) (m,) over the whole surface: its integral is f_c."""
    histogram = case.groups["pressure_histogram"]
    return histogram["edges"], histogram["density"] * case.area


def make(folders: list[Path], output: Path, area: float | None = None) -> Findings:
    """P(σ) of every load, or of the one nearest to `area` in each folder; linear and logarithmic."""
    chosen = cases(folders) if area is None else nearest(cases(folders), area)
    sheet, findings = Sheet(1, 2), Findings()
    for number, case in enumerate(chosen):
        _draw(sheet, case, number, len(chosen) == 1)
    for panel, scale in enumerate(("linear", "semilogy")):
        sheet.label(panel, r"$\sigma\,/\,(E'\bar g/2)$", r"$P(\sigma)\;E'\bar g/2$", scale=scale, legend=panel == 0)
    width = [_fitted(case) / case.full_contact_std for case in chosen]
    kappa = [case.number("kappa") for case in chosen]
    corrected = [case.modulus * case.rms_slope * case.corrected_area / case.load for case in chosen]
    theory = [float(persson.kappa(case.load, case.full_contact_std)) for case in chosen]
    findings.add("contact area f_c", [case.area for case in chosen])
    findings.add("κ, raw area", kappa)
    findings.add("κ, corrected area", corrected)
    findings.add("κ, Persson at this load", theory)
    findings.add("m₂ = ⟨σ²⟩_c/σ_c²", [case.normalised_second_moment for case in chosen])
    findings.add("m₂, Persson at this load", [float(persson.normalised_second_moment(case.load, case.full_contact_std))
                                              for case in chosen])  # fmt: skip
    findings.add("fitted width over E'g/2", width)
    return plotting.finish(sheet, output, "pressure_distribution", findings)


def _draw(sheet: Sheet, case: Case, number: int, alone: bool):
    std = case.full_contact_std
    edges, density = distribution(case)
    middle = (edges[1:] + edges[:-1]) / 2
    seen = density > 0
    sigma = np.linspace(0, edges[-1], 500)[1:]
    title = f"simulation, $f_c$ = {case.area:.3f}"
    colour = COLOURS[number % len(COLOURS)]
    floor = 0.3 * density[seen].min()
    for panel in (0, 1):
        sheet.curve(panel, middle[seen] / std, density[seen] * std, title, color=colour, ls="none",
                    marker=MARKERS[number % len(MARKERS)], ms=2.5)  # fmt: skip
        for name, width, style in (("Persson", std, "-"), ("same form, fitted width", _fitted(case), "--")):
            theory = persson.pressure_density(sigma, case.load, width)
            drawn = theory > (floor if panel else -1)
            line = {"color": (BLACK if style == "-" else RED) if alone else colour, "ls": style, "lw": 1.0}
            sheet.curve(panel, sigma[drawn] / std, theory[drawn] * std, name, label=number == 0, **line)


def _fitted(case: Case) -> float:
    if case.has("persson_fit"):
        return float(np.ravel(case.groups["persson_fit"]["width"])[0])
    return persson.fit_std(*distribution(case), case.load)


def main(arguments: list[str] | None = None) -> int:
    """The command line."""
    return plotting.command_line(
        make,
        __doc__,
        arguments,
        lambda parser: parser.add_argument("--area", type=float, help="only loads near this f_c"),
    )


if __name__ == "__main__":
    sys.exit(main())
