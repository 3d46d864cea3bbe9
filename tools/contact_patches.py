"""Contact patches: load against area with binned medians, mean pressure, and the distribution of sizes.

    python tools/contact_patches.py DIR [--area 0.08] [--smallest 16]

Needs the observable patches.  Patches of fewer than `--smallest` pixels are drawn, and left out of the fits.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import plotting
from plotting import BLACK, BLUE, GREY, RED, Findings, Sheet, guide
from reading import Case, cases, nearest

from pgfmd.theory import bearing

SMALL, LARGE = 0.1, 1.0  # in λ_s²: patches up to SMALL are parts of single asperities, those from LARGE on hold many
PER_DECADE = 6  # bins
DOTS = 4000  # patches drawn one by one


def make(folders: list[Path], output: Path, area: float | None = None, smallest: int = 16) -> Findings:
    """Three panels of the load nearest to `area` (default: the first)."""
    case = cases(folders)[0] if area is None else nearest(cases(folders), area)[0]
    table = case.groups["patches"]
    unit, pixel = case.wavelengths[0] ** 2, float(np.prod(case.config.grid.steps))
    size, load = table["area"] / unit, table["load"] / (unit * case.modulus * case.rms_slope)
    centres, medians, counts = binned(size, load)
    sheet, findings = Sheet(1, 3), Findings()
    findings.add("patches", len(size))
    _draw_loads(sheet, size, load, centres, medians)
    kept = (counts >= 3) & (centres >= smallest * pixel / unit)
    for name, chosen, law in (("small", centres <= SMALL, 1.5), ("large", centres >= LARGE, 1.0)):
        chosen = chosen & kept
        if np.count_nonzero(chosen) >= 3:
            findings[f"slope of {name} patches"] = slope(centres[chosen], medians[chosen])
            guide(sheet.panels[0], centres[chosen][[0, -1]], 2.5 * medians[chosen][0], law, f"{law:g}")
    for end in (SMALL / 2, 2 * SMALL):
        chosen = kept & (centres <= end)
        if np.count_nonzero(chosen) >= 3:
            findings[f"slope of patches up to {end:g} λ_s²"] = slope(centres[chosen], medians[chosen])
    saturated = load[size >= 1].sum() / size[size >= 1].sum() if np.any(size >= 1) else np.nan
    findings.add("mean pressure of patches ≥ λ_s², over E'g", saturated)
    _draw_pressures(sheet, size, load, centres, medians, saturated)
    _draw_sizes(sheet, case, size, smallest * pixel / unit)
    return plotting.finish(sheet, output, "contact_patches", findings)


def binned(size: np.ndarray, load: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Median size, median load and number of patches in logarithmic bins of the size that are not empty: (m,) each."""
    index = np.floor(np.log10(size / size.min()) * PER_DECADE + 1e-9).astype(int)
    bins = [index == number for number in np.unique(index)]
    return tuple(np.array([f(chosen) for chosen in bins]) for f in (
        lambda chosen: np.median(size[chosen]), lambda chosen: np.median(load[chosen]), np.count_nonzero))  # fmt: skip


def slope(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Exponent of y ∝ x^m by least squares in logarithms, with its standard error from the scatter about the line."""
    x, y = np.log(x), np.log(y)
    x, y = x - x.mean(), y - y.mean()
    exponent = np.sum(x * y) / np.sum(x**2)
    variance = np.sum((y - exponent * x) ** 2) / (len(x) - 2)
    return float(exponent), float(np.sqrt(variance / np.sum(x**2)))


def _draw_loads(sheet: Sheet, size, load, centres, medians):
    dots = np.random.default_rng(1).permutation(len(size))[:DOTS]
    sheet.curve(0, size[dots], load[dots], "patches", color=GREY, marker=".", ls="none", ms=1.5, alpha=0.5)
    sheet.curve(0, centres, medians, "binned medians", color=RED, marker="o", ls="none")
    sheet.label(0, r"area $a_c\,/\,\lambda_s^2$", r"load $l_c\,/\,(E'\bar g\,\lambda_s^2)$", scale="log")


def _draw_pressures(sheet: Sheet, size, load, centres, medians, saturated: float):
    dots = np.random.default_rng(1).permutation(len(size))[:DOTS]
    ratio = load / size
    sheet.curve(1, size[dots], ratio[dots], "patches", color=GREY, marker=".", ls="none", ms=1.5, alpha=0.5)
    sheet.curve(1, centres, medians / centres, "binned medians", color=RED, marker="o", ls="none")
    sheet.curve(
        1, [1, size.max()], [saturated, saturated], rf"{saturated:.2f}: mean from $\lambda_s^2$ on", color=BLACK, lw=1.0
    )
    sheet.label(1, r"area $a_c\,/\,\lambda_s^2$", r"mean pressure $l_c\,/\,(a_c E'\bar g)$", scale="semilogx")


def _draw_sizes(sheet: Sheet, case: Case, size: np.ndarray, resolved: float):
    """Probability density of the patch areas, with the bearing-area law as a guide."""
    edges = np.geomspace(
        size.min() * 0.999, size.max() * 1.001, int(np.log10(size.max() / size.min()) * PER_DECADE) + 2
    )
    count, _ = np.histogram(size, edges)
    seen = count > 0
    middle = np.sqrt(edges[1:] * edges[:-1])[seen]
    density = (count / (np.diff(edges) * len(size)))[seen]
    error = density / np.sqrt(count[seen])
    sheet.curve(2, middle, density, "elastic contact", error=error, color=BLUE, marker="o", ls="none")
    tail = middle >= 1
    if case.hurst is not None and np.count_nonzero(tail) >= 2:
        exponent = bearing.patch_exponent(case.hurst)
        guide(sheet.panels[2], middle[tail][[0, -1]], 3 * density[tail][0], -exponent, f"−{exponent:.2f}")
    sheet.panels[2].axvline(resolved, color=GREY, lw=0.8, ls=":")
    sheet.label(2, r"area $a_c\,/\,\lambda_s^2$", r"$P(a_c)\,\lambda_s^2$", "dotted: smallest in the fits", scale="log")


def options(parser):
    """The options of the command line."""
    parser.add_argument("--area", type=float, help="the load near this f_c")
    parser.add_argument(
        "--smallest", type=int, default=16, help="pixels of the smallest patch in the fits (default 16)"
    )


def main(arguments: list[str] | None = None) -> int:
    """The command line."""
    return plotting.command_line(make, __doc__, arguments, options)


if __name__ == "__main__":
    sys.exit(main())
