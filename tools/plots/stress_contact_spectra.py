"""The stress spectrum against the contact spectrum: are they the same function?

From the observable spectra, or from the field pressure.  Each point is one bin in |q|; runs that differ by the seed
alone are averaged: ratio of the means.
"""

import numpy as np
from choosing import AREAS, near
from plotting import BLACK, GREY, Sheet, limited, style
from reading import Load
from samples import Ensemble, common_bins, ensembles, setting

CAPTION = """(a) Stress spectrum over σ_c² against the contact spectrum, one symbol for each bin of |q|, with the bounds
1 (full line) and 2 (dashed). (b) Their ratio, with the bounds 1 and 2; bars: standard error over seeds. Dotted: the
largest wave number along an axis of the grid; beyond it bins hold only waves along its diagonals."""
NEEDS = ("spectra", "partial contact")
OPTIONS = AREAS
LONG = 8.5  # q/q_l up to which waves are called long


def draw(loads: list[Load], areas: tuple[float, ...] = ()) -> Sheet:
    """|σ̃|²/σ_c² against |Θ̃|², and their ratio against q."""
    sheet = Sheet(1, 2, height=2.9)
    groups = limited(ensembles(near(loads, areas)), sheet)
    settings = list(dict.fromkeys(str(setting(group.loads[0])) for group in groups))
    ends: list[float] = []
    for number, group in enumerate(groups):
        name, label = group.name, group.label or f"f_c = {group.mean('area'):.3g}"
        x, count, stress, contact = samples(group)
        ratio, error = ratio_of_means(stress, contact)
        below = contact.mean(axis=0)
        # two loads of each setting: its colour, filled and open
        look = style(number, filled=number % 2 == 0) if len(groups) != 2 * len(settings) else style(
            settings.index(str(setting(group.loads[0]))), filled=number % 2 == 0)  # fmt: skip
        sheet.curve(0, below, stress.mean(axis=0), label, ls="none", ms=2.4, **look)
        ends += [below.min(), below.max()]
        sheet.curve(1, x, ratio, name, error=error, lw=0.7, ms=2, **look)
        report(sheet, group, name, (x, count, stress, contact, ratio))
    for value, dashes in ((1, "-"), (2, "--")):
        span = np.array([min(ends), max(ends)])
        sheet.curve(0, span, value * span, f"bound {value}", color=BLACK, lw=0.7, ls=dashes, zorder=5)
        sheet.panels[1].axhline(value, color=BLACK, lw=0.7, ls=dashes)
    for edge in {np.pi / max(group.spacings) / group.q_unit for group in groups}:
        sheet.panels[1].axvline(edge, color=GREY, lw=0.7, ls=":")
    sheet.label(
        0, r"$|\tilde\Theta(q)|^2$", r"$|\tilde\sigma(q)|^2\,/\,\sigma_c^2$", scale="log", columns=3, legend="figure"
    )
    sheet.label(
        1, r"$q\,/\,q_l$", r"$|\tilde\sigma|^2\,/\,(\sigma_c^2\,|\tilde\Theta|^2)$", scale="semilogx", legend=False
    )
    return sheet


def samples(group: Ensemble) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """q/q_l (m,), modes per bin (m,), and of each load (loads, m): |σ̃|²/σ_c² and |Θ̃|²."""
    q, contact = common_bins([load.spectrum("contact")[:2] for load in group])
    stress = np.array([load.spectrum("stress")[1] / load.contact_pressure**2 for load in group])
    count = group.loads[0].spectrum("contact")[2]
    seen = (contact > contact.max() * 1e-20).all(axis=0)  # a regular surface leaves bins empty up to rounding
    return (q / group.q_unit)[seen], count[seen], stress[:, seen], contact[:, seen]


def ratio_of_means(above: np.ndarray, below: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Σ above/Σ below over samples (samples, m), and its standard error by leaving one out at a time (NaN for one)."""
    ratio, count = above.sum(axis=0) / below.sum(axis=0), len(above)
    if count < 2:
        return ratio, np.full(len(ratio), np.nan)
    others = (above.sum(axis=0) - above) / (below.sum(axis=0) - below)
    return ratio, np.sqrt((count - 1) / count * np.sum((others - others.mean(axis=0)) ** 2, axis=0))


def report(sheet: Sheet, group: Ensemble, name: str, data: tuple):
    """The ratio at long and short waves, its maximum, and how much of the stress lies above the upper bound."""
    x, count, stress, contact, ratio = data
    add = sheet.findings.add
    long = x < LONG
    totals = [np.array([float(np.sum((count * row)[long])) for row in rows]) for rows in (stress, contact)]
    add(f"ratio at the longest waves (q ≤ 8 q_l), {name}", totals[0] / totals[1])
    per_seed = stress / contact
    add(f"ratio at the shortest waves, {name}", per_seed[:, -1])
    top = int(np.argmax(np.where(count >= 100, ratio, 0)))
    add(f"largest ratio (bins of 100 modes and more), {name}", per_seed[:, top])
    add(f"q/q_l of the largest ratio, {name}", x[top])
    m2 = np.array([load.normalised_second_moment for load in group])
    add(f"m₂, {name}", m2)
    for bound, values in (("m₂", m2), ("2", np.full(len(m2), 2.0))):
        if np.all(np.isfinite(values)):
            shares = [np.sum((count * row)[each > b]) / np.sum(count * row)
                      for row, each, b in zip(stress, per_seed, values, strict=True)]  # fmt: skip
            add(f"share of the stress spectrum above {bound} × contact, {name}", shares)
    for load, above, below in zip(group, stress, contact, strict=True):
        sheet.keep("data", ("setting", "seed", "q_over_q_l", "modes", "stress", "contact"),
                   *((name, load.seed, *row) for row in zip(x, count, above, below, strict=True)))  # fmt: skip
