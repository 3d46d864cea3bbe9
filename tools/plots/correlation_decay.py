"""Decay of the contact's correlation with distance: C_c(Δr) − C_c(∞) ∝ Δr^−ν, with ν = 2 − μ_c expected.

C_c(∞) is f_c².  `--window` is the fit range in units of the shortest wavelength; its neighbours give the spread over
choices.
"""

from dataclasses import replace

import numpy as np
from choosing import AREAS, near
from estimators import fit_power_law, left_out_error, windows, within
from plotting import BLACK, Sheet, limited, standard_error, style
from reading import Load
from samples import Ensemble, common_bins, ensembles

CAPTION = """Autocorrelation of the contact less its limit at large distance, over its value at zero. Full lines: power
laws fitted over the range that they span, with their exponents ν. Dashed: the correlation of a spectrum q^(−1−H) in
the same cell, which falls as Δr^(−(1−H)) in an infinite one. Bars: standard error over seeds."""
NEEDS = ("correlations", "partial contact", "two dimensions")
OPTIONS = AREAS | {
    "--window": {"type": float, "nargs": 2, "metavar": ("FROM", "TO"), "help": "fit range in Δr/λ_s (default 4 64)"},
}


def draw(loads: list[Load], areas: tuple[float, ...] = (), window: tuple[float, float] = (4, 64)) -> Sheet:
    """(C_c − f_c²)/(f_c − f_c²) of each setting and load, and ν."""
    sheet = Sheet()
    for number, group in enumerate(limited(ensembles(near(loads, areas)), sheet)):
        r, contact = common_bins([load.correlation("contact") for load in group])
        f = np.array([load.area for load in group])[:, None]
        x, decay = r / shortest(group), (contact - f**2) / (f - f**2)
        mean, error = decay.mean(axis=0), standard_error(decay)
        shown = (r > 0) & (mean > 0)
        label = group.label or f"f_c = {group.mean('area'):.3g}"
        sheet.curve(0, x[shown], mean[shown], label, error=error[shown], ls="none", **style(number))
        report(sheet, group, r, decay, window)
        inside = within(x, window) & shown
        if np.count_nonzero(inside) >= 3:
            slope, (offset,) = fit_power_law(x[inside], mean[inside])
            ends = x[inside][[0, -1]]
            sheet.curve(0, ends, np.exp(offset) * ends**slope, f"ν = {-slope:.2f}, {group.name}", lw=0.9, label=False,
                        color=BLACK, zorder=5)  # fmt: skip
            sheet.panels[0].annotate(f"{-slope:.2f}", (ends[-1], mean[inside][-1]), (0, 5), "data", "offset points")
            if group.hurst is not None:
                law = cell_law(group, r)
                law *= mean[inside][0] / law[inside][0]
                shown = (r > 0) & (law > 0) & (x <= 2 * window[1])
                sheet.curve(0, x[shown], law[shown], f"q^−(1+H) in this cell, {group.name}", label=False,
                            color=BLACK, ls="--", lw=0.9, zorder=4)  # fmt: skip
    sheet.label(0, r"$\Delta r\,/\,\lambda_s$", r"$(C_c - f_c^2)\,/\,(f_c - f_c^2)$", scale="log")
    return sheet


def shortest(group: Ensemble) -> float:
    """λ_s, or the grid spacing where every mode of the grid counts."""
    return max(group.wavelengths[0], max(group.spacings))


def cell_law(group: Ensemble, r: np.ndarray) -> np.ndarray:
    """The correlation whose spectrum is q^−(1+H) between q_l and q_s, on this grid in this cell, at distances r: (m,).

    In a finite cell it falls faster than Δr^−(1−H), its limit in an infinite one.
    """
    shape, spacings = group.results.shape, group.spacings
    waves = np.meshgrid(*(2 * np.pi * np.fft.fftfreq(n, step) for n, step in zip(shape, spacings, strict=True)),
                        indexing="ij")  # fmt: skip
    q = np.hypot(*waves)
    low, high = group.q_limits
    inside = (q > 0) & (q >= low * (1 - 1e-9)) & (q <= high * (1 + 1e-9))
    correlation = np.fft.fft2(np.where(inside, np.where(q > 0, q, 1.0) ** -(1 + group.hurst), 0.0)).real
    apart = np.hypot(*np.meshgrid(*(n * step * np.fft.fftfreq(n) for n, step in zip(shape, spacings, strict=True)),
                                  indexing="ij"))  # fmt: skip
    ring = np.rint(apart / min(spacings)).astype(int).ravel()
    points = np.bincount(ring)
    mean, distance = (np.bincount(ring, field.ravel()) / np.maximum(points, 1) for field in (correlation, apart))
    return np.interp(r, distance[points > 0], mean[points > 0])


def report(sheet: Sheet, group: Ensemble, r: np.ndarray, decay: np.ndarray, limits: tuple[float, float]):
    """ν of the mean over seeds, with the error of leaving one out at a time; neighbouring ranges as choices; and its
    difference to ν of a spectrum q^−(1+H) in the same cell and range.
    """
    x = r / shortest(group)

    def fit(rows: np.ndarray, each: tuple[float, float]) -> float:
        mean = rows.mean(axis=0)
        inside = within(x, each) & (x > 0)
        good = np.count_nonzero(inside) >= 3 and bool(np.all(mean[inside] > 0))
        return -fit_power_law(x[inside], mean[inside])[0] if good else float("nan")

    count, ranges = len(decay), windows(limits)
    values = np.array([fit(decay, each) for each in ranges])
    error = left_out_error(list(decay), lambda rows: fit(np.array(rows), limits))
    shifts = {f"ν, {group.name}": np.zeros(len(ranges))}
    if group.hurst is not None:
        law = cell_law(group, r)[None]
        shifts[f"ν + H, {group.name}"] = np.full(len(ranges), group.hurst)
        shifts[f"ν less that of q^−(1+H) in this cell, {group.name}"] = -np.array([fit(law, each) for each in ranges])
    for name, shift in shifts.items():
        if np.isfinite(values[0] + shift[0]):
            sheet.findings.add(name, values[0] + shift[0], (values + shift)[1:])
            sheet.findings[name] = replace(sheet.findings[name], seeds=error, count=count)
    for load, row in zip(group, decay, strict=True):
        sheet.keep("data", ("setting", "seed", "r_over_lambda_s", "decay"),
                   *((group.name, load.seed, *values) for values in zip(x, row, strict=True)))  # fmt: skip
