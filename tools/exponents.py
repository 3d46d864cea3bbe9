"""The exponent μ of stress and contact spectra, C̃ ∝ q^−μ: joint and separate fits, and how much the fit range matters.

    python tools/exponents.py DIR… [--areas 0.04 0.08] [--window 8 128]

Folders that differ by the seed alone give the standard error.  The joint fit has one μ for stress and contact at every
area, and free prefactors.  Writes the figure, and exponents_table.csv with all windows.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import numpy as np
import plotting
from plotting import BLACK, BLUE, GREEN, ORANGE, RED, Findings, Sheet, fit_power_law
from reading import Case, by_hurst, cases, common_bins, nearest

KINDS = ("joint", "stress", "contact")
STYLES = (("stress", RED, "o"), ("contact", BLUE, "s"), ("stress", ORANGE, "^"), ("contact", GREEN, "v"))


def windows(base: tuple[float, float]) -> list[tuple[float, float]]:
    """The fit range asked for, and its neighbours: moved by a factor of 2 either way, and halved at each end."""
    low, high = base
    return [base, (low / 2, high / 2), (low * 2, high * 2), (low * 2, high), (low, high / 2)]


def make(
    folders: list[Path], output: Path, areas: tuple[float, ...] = (0.04, 0.08), window: tuple[float, float] = (8, 128)
) -> Findings:
    """One panel per H with the normalised spectra and the joint fit, one with μ against the fit range."""
    groups, window = by_hurst(cases(folders)), tuple(window)
    sheet, findings, rows = Sheet(1, len(groups) + 1), Findings(), []
    for panel, (hurst, group) in enumerate(groups.items()):
        curves = {area: spectra(nearest(group, area)) for area in areas}
        _draw(sheet, panel, curves, window)
        spectrum = r"$f_c\,|\tilde f(q)|^2\,/\,(1-f_c)\,|\tilde f(0)|^2$"
        sheet.label(panel, "waves per cell, qL/2π", spectrum, f"H = {hurst:g}",
                    scale="log", legend="lower left")  # fmt: skip
        for limits in windows(window):
            fits = {
                kind: np.array([fit(curves, kind, seed, limits) for seed in range(_seeds(curves))]) for kind in KINDS
            }
            fits["difference"] = fits["contact"] - fits["stress"]
            for kind, values in fits.items():
                found = Findings()
                found.add("", values)
                rows.append((hurst, *limits, kind, *found[""], len(values)))
                if limits == window:
                    findings.add(f"μ {kind}, H = {hurst:g}", values)
    for kind in ("contact", "stress"):
        findings[f"sum rule, {kind}"] = (worst_sum([case for group in groups.values() for case in group], kind), None)
    _draw_windows(sheet, len(groups), rows)
    _write(output, rows)
    return plotting.finish(sheet, output, "exponents", findings)


def spectra(chosen: list[Case]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Waves per cell (m,), and by kind f_c C̃/((1−f_c) C̃(0)) of each seed (seeds, m)."""
    curves = {}
    for kind in ("stress", "contact"):
        q, power = common_bins([case.spectrum(kind)[:2] for case in chosen])
        f = np.array([case.area for case in chosen])[:, None]
        zero = np.array([case.load if kind == "stress" else case.area for case in chosen])[:, None] ** 2
        curves[kind] = f * power / ((1 - f) * zero)
    return q / chosen[0].wave_unit, curves


def fit(curves: dict, kind: str, seed: int, limits: tuple[float, float]) -> float:
    """μ of one seed over a range of waves per cell, of one kind of spectrum or ("joint") of both, at all areas."""
    kinds = ("stress", "contact") if kind == "joint" else (kind,)
    waves = next(iter(curves.values()))[0]
    inside = (waves >= limits[0]) & (waves <= limits[1])
    lines = [powers[name][seed][inside] for _, powers in curves.values() for name in kinds]
    return -fit_power_law(waves[inside], *lines)[0]


def worst_sum(group: list[Case], kind: str) -> float:
    """The largest residual of Σ_{q≠0} |f̃|² = ⟨f²⟩ − ⟨f⟩², relative to ⟨f²⟩, of loads whose bins hold every mode."""
    residuals = [0.0]
    for case in group:
        _, power, count = case.spectrum(kind)
        if round(count.sum()) == np.prod(case.results.shape) - 1:
            square = (
                case.area if kind == "contact" else case.normalised_second_moment * case.contact_pressure * case.load
            )
            mean = case.area if kind == "contact" else case.load
            residuals.append(float(np.sum(power * count) + mean**2) / square - 1)
    return max(residuals, key=abs)


def _seeds(curves: dict) -> int:
    return min(len(powers["stress"]) for _, powers in curves.values())


def _draw(sheet: Sheet, panel: int, curves: dict, window: tuple[float, float]):
    styles = iter(STYLES)
    for area, (waves, powers) in curves.items():
        for kind in ("stress", "contact"):
            _, colour, marker = next(styles)
            mean = np.exp(np.log(powers[kind]).mean(axis=0))
            sheet.curve(panel, waves, mean, f"{kind}, $f_c$ = {area:g}", color=colour, marker=marker, ls="none", ms=2.5)
    inside = (waves >= window[0]) & (waves <= window[1])
    lines = [np.exp(np.log(powers[kind]).mean(axis=0))[inside] for _, powers in curves.values() for kind in powers]
    exponent, logarithms = fit_power_law(waves[inside], *lines)
    ends = np.array(window, float)
    top = np.exp(max(logarithms)) * 2 * ends**exponent
    sheet.curve(panel, ends, top, f"joint fit, μ = {-exponent:.2f}", color=BLACK, lw=1.0)


def _draw_windows(sheet: Sheet, panel: int, rows: list[tuple]):
    """μ of the joint fit for each fit range, beside 1 + H."""
    hursts = sorted({row[0] for row in rows})
    ranges = list(dict.fromkeys(row[1:3] for row in rows))
    for hurst, colour, marker in zip(hursts, (BLUE, GREEN, RED, ORANGE), "os^D", strict=False):
        joint = [row for row in rows if row[0] == hurst and row[3] == "joint"]
        errors = [row[5] or 0.0 for row in joint]
        values = [row[4] for row in joint]
        sheet.curve(panel, np.arange(len(joint)), values, f"H = {hurst:g}", error=errors, color=colour,
                    marker=marker, ls="none")  # fmt: skip
        sheet.panels[panel].axhline(1 + hurst, color=colour, lw=0.8, ls="--")
    axes = sheet.panels[panel]
    sheet.label(panel, "fit range, waves per cell", "μ, joint fit", "dashed: 1 + H")
    axes.set_xticks(range(len(ranges)), [f"{low:g}–{high:g}" for low, high in ranges], rotation=30)
    axes.set_xlim(-0.6, len(ranges) - 0.4)
    axes.set_ylim(top=axes.get_ylim()[1] + 0.3)


def _write(output: Path, rows: list[tuple]):
    output.mkdir(parents=True, exist_ok=True)
    with open(output / "exponents_table.csv", "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["hurst", "waves_from", "waves_to", "fit", "mu", "standard_error", "seeds"])
        for hurst, low, high, kind, value, error, seeds in rows:
            table.writerow([hurst, f"{low:g}", f"{high:g}", kind, f"{value:.4f}", f"{error or 0:.4f}", seeds])


def options(parser):
    """The options of the command line."""
    parser.add_argument("--areas", type=float, nargs="+", default=(0.04, 0.08), help="the loads near these f_c")
    parser.add_argument("--window", type=float, nargs=2, default=(8, 128), metavar=("FROM", "TO"),
                        help="waves per cell between which μ is fitted (default 8 128)")  # fmt: skip


def main(arguments: list[str] | None = None) -> int:
    """The command line."""
    return plotting.command_line(make, __doc__, arguments, options)


if __name__ == "__main__":
    sys.exit(main())
