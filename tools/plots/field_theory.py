"""Exponential walls against field theory: |σ̃|² = G₁² (E'q/2)² |h̃|², G₁ = 1/(1 + ζ q E'/(2 p̄)).

Theory is summed mode by mode from the heights, so that the ratio is 1 in every band where theory holds exactly.  Runs
that differ by the seed alone are averaged; bands in q/q_l carry the standard error over the seeds.
"""

import numpy as np
from estimators import band_ratio
from persson_spectrum import theory as persson_area
from plotting import BLACK, Sheet, limited, standard_error, style
from reading import Load
from samples import Ensemble, common_bins, ensembles

from pgfmd.theory import exponential

CAPTION = """(a) The stress spectrum under an exponential wall over that of full contact; lines: field theory to first
order in the heights; dashed: full contact, f = 1; dotted: f(q) of Persson's theory of a hard wall. (b) The ratio to
field theory in bands of q, both summed mode by mode, with standard errors over seeds; settings are moved sideways;
shaded: ±20 %."""
NEEDS = ("exponential wall", "spectra", "height", "load")
BANDS = ((1, 1), (2, 3), (4, 7), (8, 15), (16, 32))  # bins of q/q_l, rounded, both ends included


def draw(loads: list[Load]) -> Sheet:
    """The ratio to full contact with G₁², and in bands the ratio to field theory, for each setting."""
    sheet = Sheet(1, 2)
    sheet.panels[1].axhspan(0.8, 1.2, color="0.92")
    for number, group in enumerate(limited(ensembles(loads), sheet)):
        name, label, look = group.name, group.label or f"ζ = {group.zeta:g}", style(number)
        q, stress = common_bins([load.spectrum("stress")[:2] for load in group])
        x, count = q / group.q_unit, group.loads[0].spectrum("stress")[2]
        full = np.array([load.full_contact() for load in group])
        model = np.array([summed(load) for load in group])
        rough = (full > full.max() * 1e-12).all(axis=0)
        x, count, stress, full, model = x[rough], count[rough], stress[:, rough], full[:, rough], model[:, rough]
        sheet.curve(
            0, x, stress.sum(axis=0) / full.sum(axis=0), label, error=standard_error(stress / full), ls="none", **look
        )
        sheet.curve(
            0, x, model.sum(axis=0) / full.sum(axis=0), f"field theory, {name}", color=look["color"], label=False
        )
        ratios = np.array([band_ratio(BANDS, np.round(x), count, s, m) for s, m in zip(stress, model, strict=True)])
        for (low, high), values in zip(BANDS, ratios.T, strict=True):
            sheet.findings.add(f"ratio to field theory, {name}, k = {low}–{high}", values)
            correction = [band_ratio([(low, high)], np.round(x), count, m, f)[0]
                          for m, f in zip(model, full, strict=True)]  # fmt: skip
            sheet.findings.add(f"field theory over full contact, {name}, k = {low}–{high}", correction)
            part = (np.round(x) >= low) & (np.round(x) <= high)
            hard = [band_ratio([(low, high)], np.round(x), count, s, f * persson_area(load, x * group.q_unit))[0]
                    for s, f, load in zip(stress, full, group, strict=True)] if np.any(part) else []  # fmt: skip
            sheet.findings.add(f"ratio to Persson's f(q), {name}, k = {low}–{high}", hard)
        middle = np.sqrt([low * high for low, high in BANDS]) * (1 + 0.05 * number)
        seen = np.isfinite(ratios).all(axis=0)
        error = standard_error(ratios)[seen]
        sheet.curve(1, middle[seen], ratios.mean(axis=0)[seen], label, error=error, lw=0.7, **look)
        for load, s, f, m in zip(group, stress, full, model, strict=True):
            sheet.keep("data", ("setting", "seed", "q_over_q_l", "modes", "stress", "full_contact", "field_theory"),
                       *((name, load.seed, *row) for row in zip(x, count, s, f, m, strict=True)))  # fmt: skip
    _draw_persson(sheet, ensembles(loads)[0])
    sheet.panels[1].axhline(1, color=BLACK, lw=0.7)
    sheet.panels[0].axhline(1, color=BLACK, ls="--", lw=0.9, label="full contact, $f$ = 1")
    sheet.label(0, r"$q\,/\,q_l$", r"$|\tilde\sigma|^2$ / full contact", scale="log", columns=5, legend="figure")
    sheet.label(1, r"$q\,/\,q_l$", "ratio to field theory", scale="semilogx", legend=False)
    return sheet


def summed(load: Load) -> np.ndarray:
    """G₁² (stiffness |h̃|)², per mode, averaged over the modes of each bin of `Load.spectrum`: (m,)."""

    def weight(q: np.ndarray) -> np.ndarray:
        # G₁ for the effective modulus 2 stiffness/q, which is E' except for a slab
        stiffness = load.stiffness(q)
        modulus = 2 * stiffness / q
        return (exponential.response(q, load.mean_pressure, load.zeta, contact_modulus=modulus) * stiffness) ** 2

    return load.weighted_spectrum("height", weight)[1]


def _draw_persson(sheet: Sheet, group: Ensemble):
    load = group.loads[0]
    q = load.spectrum("height")[0]
    inside = q <= load.q_limits[1] * (1 + 1e-9)
    sheet.curve(
        0, q[inside] / group.q_unit, persson_area(load, q[inside]), "$f(q)$, Persson", color=BLACK, ls=":", lw=0.9
    )
