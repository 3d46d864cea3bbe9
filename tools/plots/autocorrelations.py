"""Real-space autocorrelations of stress and contact, and the paper's bounds on their ratio.

From the observable acf, or from the field pressure in row blocks.  The paper's bounds are C_c ≤ C_σ/σ_c² ≤ 2 C_c; the
ratio is m₂ = ⟨σ²⟩_c/σ_c² at Δr = 0.
"""

import numpy as np
from choosing import near
from plotting import BLACK, BLUE, GREY, RED, Sheet, standard_error
from reading import Load
from samples import common_bins, ensembles

CAPTION = """(a) Autocorrelation of the stress over σ_c², beside that of the contact (the paper's lower bound), twice
that (the approximate form of its upper one) and m₂ times that, with the measured m₂. (b) Their ratio, with 1 and 2, and
its value m₂ at Δr = 0. Dotted, upright: λ_s/8. Bars: standard error over seeds. At large Δr both tend to the square of
the mean, up to the noise of one cell."""
NEEDS = ("correlations", "area", "two dimensions")
OPTIONS = {"--area": {"type": float, "help": "the load near this contact area (default: the last)"}}
MARKS = (0.0, 1 / 8, 1 / 2, 1.0, 4.0)  # distances in λ_s whose ratio is reported


def draw(loads: list[Load], area: float | None = None) -> Sheet:
    """C_σ/σ_c² and C_c with the bounds, and their ratio, of one setting and load."""
    groups = ensembles(loads if area is None else near(loads, [area]))
    group, sheet = groups[-1], Sheet(1, 2)
    if len(groups) > 1:
        sheet.notes.append(f"one of {len(groups)} settings and loads is drawn: {group.label}")
    r, stress = common_bins([load.correlation("stress") for load in group])
    _, contact = common_bins([load.correlation("contact") for load in group])
    stress = stress / np.array([load.contact_pressure for load in group])[:, None] ** 2
    m2 = stress[:, 0] / contact[:, 0]
    x, drawn = r / group.wavelengths[0], r > 0
    mean, below, ratio = stress.mean(axis=0), contact.mean(axis=0), stress / contact
    sheet.curve(0, x[drawn], below[drawn], r"$C_c$, lower bound", color=BLUE, ls="--")
    sheet.curve(0, x[drawn], 2 * below[drawn], r"$2\,C_c$, upper bound if $m_2$ = 2", color=BLUE, ls=":")
    sheet.curve(0, x[drawn], m2.mean() * below[drawn], r"$m_2 C_c$", color=BLUE, ls="-.")
    sheet.curve(0, x[drawn], mean[drawn], r"$C_\sigma/\sigma_c^2$", error=standard_error(stress)[drawn],
                color=RED, marker="o", ms=2)  # fmt: skip
    floor = np.full(np.count_nonzero(drawn), np.mean([load.area**2 for load in group]))
    sheet.curve(0, x[drawn], floor, r"$f_c^2$: no correlation", color=GREY, lw=0.8)
    sheet.label(0, r"$\Delta r\,/\,\lambda_s$", "autocorrelation", scale="log")
    sheet.curve(1, x[drawn], ratio.mean(axis=0)[drawn], "simulation", color=RED, marker="o", ms=2,
                error=standard_error(ratio)[drawn])  # fmt: skip
    for value, name, dashes in ((1.0, "lower bound", "--"), (float(m2.mean()), f"$m_2$ = {m2.mean():.3f}", "-."),
                                (2.0, "upper bound if $m_2$ = 2", ":")):  # fmt: skip
        sheet.curve(1, x[drawn][[0, -1]], [value, value], name, color=BLACK, lw=0.8, ls=dashes)
    sheet.label(1, r"$\Delta r\,/\,\lambda_s$", r"$C_\sigma\,/\,(\sigma_c^2\,C_c)$", scale="semilogx")
    for panel in sheet.panels:
        panel.axvline(1 / 8, color=GREY, lw=0.7, ls=":")
        panel.text(0.13, 0.9, r"$\lambda_s/8$", color="0.35", transform=panel.get_xaxis_transform())
    report(sheet, list(group), x, ratio, m2)
    second = np.array([load.normalised_second_moment for load in group])
    areas = np.array([load.area for load in group])
    sheet.findings.add("C_c(0)/f_c − 1", contact[:, 0] / areas - 1)
    sheet.findings.add("C_σ(0)/(f_c ⟨σ²⟩_c) − 1", stress[:, 0] / (areas * second) - 1)
    sheet.findings.add("C_σ(0)/⟨σ²⟩_c", stress[:, 0] / second)
    for load, row, lower in zip(group, stress, contact, strict=True):
        columns = ("seed", "r_over_lambda_s", "stress", "contact")
        sheet.keep("data", columns, *((load.seed, *values) for values in zip(x, row, lower, strict=True)))
    return sheet


def report(sheet: Sheet, group: list[Load], x: np.ndarray, ratio: np.ndarray, m2: np.ndarray):
    """The ratio C_σ/(σ_c² C_c) against its bounds."""
    add = sheet.findings.add
    add("contact area f_c", [load.area for load in group])
    add("m₂ = C_σ(0)/(σ_c² f_c)", m2)
    for mark in MARKS:
        add(f"C_σ/(σ_c² C_c) at {mark:g} λ_s", [np.interp(mark, x, row) for row in ratio])
    inner = x <= 1 / 8 * (1 + 1e-9)
    add("share of the upper bound 2 up to λ_s/8, least", [row[inner].min() / 2 for row in ratio])
    shares = [(row[inner] / m).min() for row, m in zip(ratio, m2, strict=True)]
    add("share of the upper bound m₂ up to λ_s/8, least", shares)
    add("smallest ratio", ratio.min(axis=1))
    add("smallest ratio up to 4 λ_s", ratio[:, x <= 4].min(axis=1))
    add("largest ratio", ratio.max(axis=1))
    add("largest ratio over m₂", ratio.max(axis=1) / m2)
    places = [_last_above(x, row, m) for row, m in zip(ratio, m2, strict=True)]
    add("largest Δr/λ_s where the ratio exceeds m₂", places)


def _last_above(x: np.ndarray, row: np.ndarray, level: float) -> float:
    above = np.flatnonzero(row > level * (1 + 1e-9))
    return float(x[above[-1]]) if len(above) else 0.0
