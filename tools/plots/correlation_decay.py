"""Decay of the contact's correlation with distance: C_c(Δr) − C_c(∞) ∝ Δr^−ν, with ν = 2 − μ_c expected.

    pgfmd plot correlation_decay DIR… [--areas 0.08] [--window 4 64]

C_c(∞) is f_c².  `--window` is the fit range in units of the shortest wavelength; its neighbours give the spread over
choices.
"""

from __future__ import annotations

import sys

import figures
import numpy as np
from choosing import near
from estimators import fit_power_law, windows, within
from plotting import Finding, Sheet, limited, standard_error, style
from reading import Load
from samples import Ensemble, common_bins, ensembles

CAPTION = """Autocorrelation of the contact less its limit at large distance, over its value at zero. Full lines: power
laws fitted over the range that they span. Dashed: the law Δr^(−ν) with ν = 1 − H, which follows from μ_c = 1 + H. Bars:
standard error over seeds."""
NEEDS = ("correlations", "partial contact")
OPTIONS = {
    "--areas": {"type": float, "nargs": "+", "help": "only the loads near these contact areas"},
    "--window": {"type": float, "nargs": 2, "metavar": ("FROM", "TO"), "help": "fit range in Δr/λ_s (default 4 64)"},
}


def draw(loads: list[Load], areas: tuple[float, ...] = (), window: tuple[float, float] = (4, 64)) -> Sheet:
    """(C_c − f_c²)/(f_c − f_c²) of each setting and load, and ν."""
    sheet = Sheet()
    for number, group in enumerate(limited(ensembles(near(loads, areas) if areas else loads), sheet)):
        r, contact = common_bins([load.correlation("contact") for load in group])
        f = np.array([load.area for load in group])[:, None]
        x, decay = r / shortest(group), (contact - f**2) / (f - f**2)
        mean, error = decay.mean(axis=0), standard_error(decay)
        shown = (r > 0) & (mean > 0)
        look, label = style(number), group.label or f"f_c = {group.mean('area'):.3g}"
        sheet.curve(0, x[shown], mean[shown], label, error=None if error is None else error[shown], ls="none", **look)
        report(sheet, group, x, decay, window)
        inside = within(x, window) & shown
        if np.count_nonzero(inside) >= 3:
            slope, (offset,) = fit_power_law(x[inside], mean[inside])
            ends = x[inside][[0, -1]]
            sheet.curve(0, ends, np.exp(offset) * ends**slope, f"ν = {-slope:.2f}, {group.name}", lw=0.9, label=False,
                        color=look["color"], zorder=5)  # fmt: skip
            if group.hurst is not None:
                law = 0.7 * mean[inside][0] * (ends / ends[0]) ** (group.hurst - 1)
                sheet.curve(0, ends, law, f"ν = 1 − H, {group.name}", color=look["color"], ls="--", lw=0.9, label=False)
    sheet.label(0, r"$\Delta r\,/\,\lambda_s$", r"$(C_c - f_c^2)\,/\,(f_c - f_c^2)$", scale="log")
    return sheet


def shortest(group: Ensemble) -> float:
    """λ_s, or the grid spacing where every mode of the grid counts."""
    return max(group.wavelengths[0], max(group.spacings))


def report(sheet: Sheet, group: Ensemble, x: np.ndarray, decay: np.ndarray, limits: tuple[float, float]):
    """ν of the mean over seeds, with the error of leaving one out at a time; neighbouring ranges as choices."""

    def fit(rows: np.ndarray, each: tuple[float, float]) -> float:
        mean = rows.mean(axis=0)
        inside = within(x, each) & (x > 0)
        good = np.count_nonzero(inside) >= 3 and bool(np.all(mean[inside] > 0))
        return -fit_power_law(x[inside], mean[inside])[0] if good else float("nan")

    value, count = fit(decay, limits), len(decay)
    choices = [fit(decay, each) for each in windows(limits)[1:]]
    error = None
    if count > 1:
        left = np.array([fit(np.delete(decay, i, axis=0), limits) for i in range(count)])
        error = float(np.sqrt((count - 1) / count * np.sum((left - left.mean()) ** 2)))
        error = error if np.isfinite(error) else None
    for name, shift in ((f"ν, {group.name}", 0.0), (f"ν + H, {group.name}", group.hurst)):
        if shift is not None and np.isfinite(value):
            sheet.findings.add(name, value + shift, [other + shift for other in choices])
            found = sheet.findings[name]
            sheet.findings[name] = Finding(found.value, error, found.choices, count)
    for load, row in zip(group, decay, strict=True):
        sheet.keep("data", ("setting", "seed", "r_over_lambda_s", "decay"),
                   *((group.name, load.seed, *values) for values in zip(x, row, strict=True)))  # fmt: skip


if __name__ == "__main__":
    sys.exit(figures.main(["correlation_decay", *sys.argv[1:]]))
