"""The distribution of contact pressures, with Persson's theory.

Theory is drawn at the load of the run with the surface's own slope: no free parameter.  The dashed curve is the same
form with the width that fits best.  Runs that differ by the seed alone are averaged.
"""

import numpy as np
from choosing import AREAS, near
from plotting import BLACK, BLUE, GREY, MOST, Sheet, limited, standard_error, tex
from reading import Load
from samples import Ensemble, ensembles

from pgfmd.theory import persson

CAPTION = """Probability density of the contact pressure over the whole surface; its integral is the contact area. One
setting: (a) linear, (b) logarithmic; several: a panel for each. Black lines: Persson's theory at the same load, without
a free parameter; grey dashed lines: the same form with the width that fits best, by least squares of the density, each
bin of the histogram weighted with its width. Bars: standard error over seeds."""
NEEDS = ("histogram", "area", "roughness")
OPTIONS = AREAS
COLUMNS = 4  # panels in a row, of several settings
BINS = 60  # on which seeds are averaged
BANDS = ((0.0, 0.1), (0.1, 0.5), (0.5, 1.0), (1.0, 2.0), (2.0, 3.0), (3.0, 4.0))  # of σ/(E'g/2)


def draw(loads: list[Load], areas: tuple[float, ...] = ()) -> Sheet:
    """P(σ): of one setting and load, linear and logarithmic; of several, logarithmic, in panels of their own."""
    groups = ensembles(near(loads, areas))
    one = len(groups) == 1
    columns = 2 if one else min(COLUMNS, len(groups))
    rows = -(-min(len(groups), MOST) // columns)
    sheet = Sheet(rows, columns, height=2.6 if rows == 1 else 1.9)
    shown = limited(groups, sheet)
    for number, group in enumerate(shown):
        _draw(sheet, group, (0, 1) if one else (number,))
    for group in groups:
        report(sheet, group)
    for panel in range(len(sheet.panels)):
        if panel >= max(len(shown), 2 * one):
            sheet.drop(panel)
            continue
        inner = panel % columns > 0 and not one
        sheet.label(panel, r"$\sigma\,/\,(E'\bar g/2)$", "" if inner else r"$P(\sigma)\;E'\bar g/2$",
                    scale="linear" if one and panel == 0 else "semilogy", columns=3,
                    legend="figure" if panel == 0 else False)  # fmt: skip
        if not one:
            label = tex(shown[panel].label.replace(", ", "\n"))
            sheet.panels[panel].text(0.06, 0.05, label, transform=sheet.panels[panel].transAxes, va="bottom")
    low, high = np.transpose([panel.get_ylim() for panel in sheet.panels[: len(shown)]])
    for panel in sheet.panels[: 0 if one else len(shown)]:
        panel.set_ylim(low.min(), high.max())
    return sheet


def distribution(load: Load) -> tuple[np.ndarray, np.ndarray]:
    """Bin edges (m+1,) and P(σ) (m,) over the whole surface: its integral is f_c."""
    histogram = load.groups["pressure_histogram"]
    return histogram["edges"], histogram["density"] * load.area


def averaged(group: Ensemble, edges: np.ndarray) -> np.ndarray:
    """P(σ) E'g/2 of each load (loads, m) in bins of σ/(E'g/2); the run's own bins are divided among these evenly."""
    densities = []
    for load in group:
        own, density = distribution(load)
        std = load.full_contact_std
        total = np.concatenate([[0.0], np.cumsum(density * np.diff(own))])
        densities.append(np.diff(np.interp(edges * std, own, total)) / np.diff(edges))
    return np.array(densities)


def report(sheet: Sheet, group: Ensemble):
    """κ, m₂ and widths with theory's, and P(σ) over the fitted and the unfitted form in bands of σ."""
    name = f", {group.name}"
    add = sheet.findings.add
    kappa = [load.modulus * load.rms_slope * load.corrected_area / load.mean_pressure for load in group]
    add(f"contact area f_c{name}", [load.area for load in group])
    add(f"κ, raw area{name}", [load.number("kappa") for load in group])
    other = [k * (1 + load.area_error / load.corrected_area) for k, load in zip(kappa, group, strict=True)]
    add(f"κ, corrected area{name}", kappa, [float(np.mean(other))] if np.all(np.isfinite(other)) else None)
    add(f"κ, Persson at this load{name}", [persson.kappa(load.mean_pressure, load.full_contact_std) for load in group])
    add(f"m₂ = ⟨σ²⟩_c/σ_c²{name}", [load.normalised_second_moment for load in group])
    add(f"m₂, Persson at this load{name}",
        [persson.normalised_second_moment(load.mean_pressure, load.full_contact_std) for load in group])  # fmt: skip
    add(f"fitted width over E'g/2{name}", [_fitted(load) / load.full_contact_std for load in group])
    first = [distribution(load)[1] for load in group]
    add(f"P in the first bin over its maximum{name}", [float(p[0] / p.max()) for p in first])
    for low, high in BANDS:
        measured = averaged(group, np.array([low, high]))[:, 0]
        for title, width in (("unfitted", lambda load: load.full_contact_std), ("fitted", _fitted)):
            theory = [-float(np.diff(persson.exceedance(np.array([low, high]) * load.full_contact_std,
                                                        load.mean_pressure, width(load)))[0]) / (high - low)
                      for load in group]  # fmt: skip
            ratio = [p / t if t > 0 else np.nan for p, t in zip(measured, theory, strict=True)]
            add(f"P over the {title} form, σ = {low:g} … {high:g} E'g/2{name}", ratio)
    for load in group:
        sheet.keep("loads", ("setting", "seed", "mean_pressure", "modulus", "rms_slope", "area", "area_corrected", "m2",
                             "fitted_width"),
                   (group.name, load.seed, load.mean_pressure, load.modulus, load.rms_slope, load.area,
                    load.corrected_area, load.normalised_second_moment, _fitted(load)))  # fmt: skip


def _draw(sheet: Sheet, group: Ensemble, panels: tuple[int, ...]):
    top = max(distribution(load)[0][-1] / load.full_contact_std for load in group)
    edges = np.linspace(0, top, BINS + 1)
    samples = averaged(group, edges)
    middle, mean, error = (edges[1:] + edges[:-1]) / 2, samples.mean(axis=0), standard_error(samples)
    seen = mean > 0
    std, width = group.mean("full_contact_std"), float(np.mean([_fitted(load) for load in group]))
    sigma = np.linspace(0, top, 500)[1:]
    floor = 0.3 * mean[seen].min()
    drawn = {"color": BLUE, "marker": "o", "ls": "none", "ms": 2.4, "zorder": 3}
    for panel in panels:
        name = group.label or f"f_c = {group.mean('area'):.3f}"
        sheet.curve(panel, middle[seen], mean[seen], name, label="simulation" if group.label else True,
                    error=error[seen], **drawn)  # fmt: skip
        for name, form, line in (("Persson", std, {"color": BLACK}),
                                 ("same form, fitted width", width, {"color": GREY, "ls": "--"})):  # fmt: skip
            theory = persson.pressure_density(sigma * std, group.mean("mean_pressure"), form) * std
            shown = theory > (floor if panel == panels[-1] else -1)
            sheet.curve(panel, sigma[shown], theory[shown], name, lw=0.9, **line)


def _fitted(load: Load) -> float:
    if "persson_fit" in load.kept:
        return float(np.ravel(load.groups["persson_fit"]["width"])[0])
    return persson.fit_std(*distribution(load), load.mean_pressure)
