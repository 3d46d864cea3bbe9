"""Contact spectra of the elastic solid and of the bearing area: the highest points, as many as touch.

Exponents μ of |Θ̃|² ∝ q^−μ are fitted to each run, over the range of the figure `exponents`; the error over seeds, and
over the choice of the fit range.  Theory of the bearing area: μ = 2 + H.
"""

from collections.abc import Sequence

import numpy as np
from choosing import AREAS, WINDOW, near
from estimators import fit_power_law, windows, within
from exponents import default_window
from plotting import BLACK, BLUE, ORANGE, Sheet, standard_error, tex
from reading import Load
from samples import Ensemble, common_bins, ensembles

from pgfmd.theory import bearing

CAPTION = """Contact spectra of the elastic solid (open symbols) and of the bearing area (filled), scaled so that their
sum over all q ≠ 0 is one; lines: power laws fitted over the range that they span, with the exponents named; dotted:
published ones, named in brackets. Bars: standard error over seeds."""
NEEDS = ("spectra", "bearing", "partial contact")
OPTIONS = AREAS | WINDOW
KINDS = (("contact", "elastic contact", ORANGE, "o", "white", "-"), ("bearing", "bearing area", BLUE, "s", BLUE, "--"))
MOST = 3


def draw(
    loads: list[Load], areas: tuple[float, ...] = (), window: tuple[float, float] | None = None,
    reference: Sequence[tuple[float, float, float]] = (),
) -> Sheet:  # fmt: skip
    """One panel for each setting and load (at most three are drawn, all are fitted); beside published exponents:
    (H, elastic, bearing) each.
    """
    groups = ensembles(near(loads, areas, slack=0.15))
    sheet = Sheet(1, min(MOST, len(groups)), height=2.5)
    if len(groups) > MOST:
        sheet.notes.append(f"{len(groups)} settings and loads were given; the first {MOST} are drawn, all are fitted")
    for panel, group in enumerate(groups):
        name, limits = group.name, tuple(window) if window else default_window(group)
        drawn, text = panel < MOST, group.label.split(", ")
        published = next((each[1:] for each in reference if each[0] == group.hurst), (None, None))
        for (kind, title, colour, marker, fill, dashes), known in zip(KINDS, published, strict=True):
            x, curves = normalised(group, kind)
            keep_exponents(sheet, group, f"μ_c {title}, {name}", x, curves, limits)
            for load, curve in zip(group, curves, strict=True):
                sheet.keep("data", ("setting", "kind", "seed", "q_over_q_l", "spectrum"),
                           *((name, kind, load.seed, *row) for row in zip(x, curve, strict=True)))  # fmt: skip
            if drawn:
                mean = curves.mean(axis=0)
                sheet.curve(panel, x, mean, title, error=standard_error(curves), color=colour, marker=marker, mfc=fill,
                            ls="none", ms=2.2)  # fmt: skip
                inside = _window(x, limits, mean)
                slope, offset = fit_power_law(x[inside], mean[inside])
                text.append(f"$\\mu$ = {-slope:.2f}, {title.split()[0]}")
                sheet.curve(panel, x[inside], np.exp(offset[0]) * x[inside] ** slope, text[-1], label=False,
                            color=BLACK, ls=dashes, lw=1.0, zorder=5)  # fmt: skip
                if known is not None:
                    text[-1] += f" ({known:g})"
                    middle = np.exp(np.mean(np.log(x[inside])))
                    sheet.curve(panel, x[inside], np.exp(offset[0]) * middle**slope * (x[inside] / middle) ** -known,
                                f"published, {title}", label=False, color=BLACK, ls=":", lw=1.2)  # fmt: skip
        if group.hurst is not None:
            sheet.findings.add(f"theory 2 + H of the bearing area, {name}", bearing.spectrum_exponent(group.hurst))
        if drawn:
            quantity = r"$f_c\,|\tilde\Theta(q)|^2\,/\,[(1-f_c)\,|\tilde\Theta(0)|^2]$" if panel == 0 else ""
            sheet.label(panel, r"$q\,/\,q_l$", quantity, scale="log", legend="figure" if panel == 0 else False)
            sheet.panels[panel].text(0.05, 0.04, tex("\n".join(filter(None, text))), va="bottom", fontsize=7,
                                     transform=sheet.panels[panel].transAxes)  # fmt: skip
    return sheet


def _window(x: np.ndarray, limits: tuple[float, float], curve: np.ndarray) -> np.ndarray:
    """The bins within limits where the curve is positive; all of those if there are fewer than three within."""
    inside = within(x, limits) & (curve > 0)
    return inside if np.count_nonzero(inside) >= 3 else curve > 0


def keep_exponents(sheet: Sheet, group: Ensemble, name: str, x, curves, limits):
    """μ of each load's curve over the fit range, and over its neighbours as choices."""
    values = []
    for low, high in windows(limits):
        inside = within(x, (low, high)) & np.all(curves > 0, axis=0)
        enough = np.count_nonzero(inside) >= 3
        values.append([-fit_power_law(x[inside], curve[inside])[0] if enough else np.nan for curve in curves])
    sheet.findings.add(name, values[0], values[1:])


def normalised(group: Ensemble, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """q/q_l (m,) and f_c |Θ̃|²/((1−f_c) |Θ̃(0)|²) of each load (loads, m)."""
    q, spectra = common_bins([load.spectrum(kind)[:2] for load in group])
    f = np.array([load.area for load in group])[:, None]
    return q / group.q_unit, spectra / (f * (1 - f))
