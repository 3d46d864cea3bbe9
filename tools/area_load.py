"""Contact area against load, raw and corrected for the pixels, beside Persson and Bush–Gibson–Thomas.

    python tools/area_load.py DIR… [--area 0.08]

Folders that differ by the seed alone are averaged; `--area` is where κ = f_c E' g/p̄ is reported.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import plotting
from plotting import BLACK, COLOURS, GREY, MARKERS, Findings, Sheet
from reading import Case, by_hurst, cases

from pgfmd.theory import asperity, persson
from pgfmd.theory.surface import SpectralMoments


def make(folders: list[Path], output: Path, area: float = 0.08) -> Findings:
    """f_c against p̄/(E'g), and κ against f_c, for each H."""
    found = cases(folders)
    sheet, findings = Sheet(1, 2), Findings()
    for number, (hurst, group) in enumerate(by_hurst(found).items()):
        style = {"color": COLOURS[number % len(COLOURS)], "marker": MARKERS[number % len(MARKERS)]}
        load, raw, corrected, kappa, kappa_corrected, error = columns(group)
        name = f"H = {hurst:g}"
        sheet.curve(0, load, corrected, name, ls="none", **style)
        sheet.curve(1, corrected, kappa_corrected, name, error=error, ls="none", **style)
        sheet.curve(1, raw, kappa, f"{name}, raw", label=False, ls="none", mfc="none", **style)
        chosen = [case for case in group if abs(case.area / area - 1) < 0.1]
        findings.add(f"κ at f_c = {area:g}, raw, {name}", [case.number("kappa") for case in chosen])
        findings.add(f"κ at f_c = {area:g}, corrected, {name}", [_corrected_kappa(case) for case in chosen])
    _draw_theory(sheet, found)
    sheet.label(0, r"$\bar p\,/\,(E'\bar g)$", "contact area", scale="log")
    ratio = r"$\kappa = f_c E'\bar g\,/\,\bar p$"
    sheet.label(1, "contact area", ratio, "open: raw, full: corrected area", scale="semilogx", legend=False)
    return plotting.finish(sheet, output, "area_load", findings)


def columns(group: list[Case]) -> tuple[np.ndarray, ...]:
    """Means over the seeds at each load: p̄/(E'g), f_c raw and corrected, κ raw and corrected, error of the last."""
    indices = sorted({case.index for case in group})
    rows = []
    for index in indices:
        same = [case for case in group if case.index == index]
        kappas = [_corrected_kappa(case) for case in same]
        numbers = ([case.load / (case.modulus * case.rms_slope) for case in same], [case.area for case in same],
                   [case.corrected_area for case in same], [case.number("kappa") for case in same], kappas)  # fmt: skip
        error = np.std(kappas, ddof=1) / np.sqrt(len(same)) if len(same) > 1 else 0.0
        rows.append([*map(np.mean, numbers), error])
    return tuple(np.array(rows).T)


def _corrected_kappa(case: Case) -> float:
    return case.modulus * case.rms_slope * case.corrected_area / case.load


def _draw_theory(sheet: Sheet, found: list[Case]):
    """Persson depends on p̄/(E'g) alone; BGT also on the bandwidth: that of the surfaces in hand."""
    loads = [case.load / (case.modulus * case.rms_slope) for case in found]
    load = np.geomspace(min(loads) / 1.5, max(loads) * 1.2, 200)
    fraction = persson.contact_fraction(load, 0.5)
    sheet.curve(0, load, fraction, "Persson", color=BLACK)
    sheet.curve(1, fraction, fraction / load, "Persson", color=BLACK)
    low = load[load < 0.05]
    linear = asperity.LOW_LOAD_KAPPA_BGT * low
    sheet.curve(0, low, linear, "BGT, low load", color=GREY, ls="--")
    sheet.curve(1, linear, np.full(len(low), asperity.LOW_LOAD_KAPPA_BGT), "BGT, low load", color=GREY, ls="--")
    case = found[0]
    q, power, count = case.spectrum("height")
    moments = SpectralMoments.from_spectrum(q, power, count)
    separation = np.sqrt(moments.m0) * np.linspace(0.3, 5, 48)
    area, pressure = asperity.bush_gibson_thomas(separation, moments, case.modulus)
    low = pressure / (case.modulus * moments.rms_slope)
    shown = low >= load[0]
    low, area = low[shown], area[shown]
    name = f"BGT, H = {case.hurst:g}"
    sheet.curve(0, low, area, name, color=GREY)
    sheet.curve(1, area, area / low, name, color=GREY)


def main(arguments: list[str] | None = None) -> int:
    """The command line."""
    return plotting.command_line(
        make, __doc__, arguments,
        lambda parser: parser.add_argument("--area", type=float, default=0.08, help="f_c where κ is reported"),
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
