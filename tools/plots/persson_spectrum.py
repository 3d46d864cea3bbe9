"""The stress spectrum over that of full contact, with the contact area f(q) at magnification q.

Persson's theory says that the ratio is f(q) = erf(√2 p̄/(E' g(q))).  Where the run kept lowpass, f(q) is drawn as
solved on the surface low-passed at q, at the same load.  One panel for each setting, with all its loads.
"""

import matplotlib
import numpy as np
from choosing import AREAS, near
from estimators import crossing, fit_power_law
from plotting import BLACK, Sheet, standard_error, tex
from reading import Load
from samples import Ensemble, common_bins, ensembles

from pgfmd.theory import persson

CAPTION = """Symbols: the stress spectrum over that of full contact, one curve for each load, named by its contact area.
Full lines: f(q) of Persson's theory at the same load. Broken lines: f(q) as solved for the surface low-passed at q,
where that was computed. Below, on a linear axis: contact areas from 0.4 to 0.95. Bars: standard error over seeds."""
NEEDS = ("spectra", "load", "roughness")
OPTIONS = AREAS
LEVELS = 0.9, 0.8, 0.95  # ratios at which it leaves full contact; the first is reported, the others are choices
MIDDLE = 0.4, 0.95  # contact areas that are drawn on a linear axis, too
INNER = 4.0  # q/q_l from which ratios are averaged, up to q_s/2


def draw(loads: list[Load], areas: tuple[float, ...] = ()) -> Sheet:
    """One panel for each setting, all loads in it."""
    settings = ensembles(near(loads, areas), by_load=False)
    linear = any(MIDDLE[0] < load.area < MIDDLE[1] for setting in settings[:2] for load in setting)
    columns = min(2, len(settings))
    sheet = Sheet(1 + linear, columns, height=2.7 if linear else 3.1)
    if len(settings) > 2:
        sheet.notes.append(f"{len(settings)} settings were given; the first two are drawn")
    for panel, setting in enumerate(settings[:2]):
        groups = ensembles(setting.loads)
        colours = matplotlib.colormaps["viridis"](np.linspace(0, 0.85, len(groups)))
        for number, group in enumerate(groups):
            title = setting.label + (", " if setting.label else "")
            look = colours[number], "os^DvPX"[number % 7]
            below = panel + columns if MIDDLE[0] < group.mean("area") < MIDDLE[1] else None
            _draw(sheet, (panel, below), group, title, look)
        lines = sheet.panels[panel + columns * linear]
        lines.plot([], [], color=BLACK, lw=0.9, label="$f(q)$, Persson")
        if any("lowpass_area" in load.kept for load in setting):
            lines.plot([], [], color=BLACK, lw=0.9, ls="--", label="$f(q)$, solved")
        sheet.label(panel, r"$q\,/\,q_l$", r"$|\tilde\sigma|^2$ / full contact, $f(q)$", scale="log", columns=3)
        if linear:
            sheet.label(panel + columns, r"$q\,/\,q_l$", r"$|\tilde\sigma|^2$ / full contact, $f(q)$", scale="semilogx")
        for each in range(panel, len(sheet.panels), columns):
            if setting.label:
                sheet.panels[each].set_xlabel(rf"$q\,/\,q_l$   ({tex(setting.label)})")
        low, _ = sheet.panels[panel].get_ylim()
        sheet.panels[panel].set_ylim(max(low, 1e-4), 1.5)
    return sheet


def ratio(load: Load) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """q, |σ̃|² and that of full contact per mode, and modes, in the bins that hold roughness: (m,) each."""
    q, stress, count = load.spectrum("stress")
    full = load.full_contact()
    common_bins([(q, stress), (load.spectrum("height")[0], full)])
    rough = (q <= load.q_limits[1] * (1 + 1e-9)) & (full > full.max() * 1e-12)
    return q[rough], stress[rough], full[rough], count[rough]


def theory(load: Load, q: np.ndarray) -> np.ndarray:
    """f(q) of Persson's theory at q."""
    q_height, height, count = load.spectrum("height")
    fraction = persson.scale_contact_fraction(load.mean_pressure, q_height, height, count, contact_modulus=load.modulus)
    return np.interp(q, q_height, fraction)


def solved(load: Load, q: np.ndarray) -> np.ndarray | None:
    """f(q) as solved for low-passed surfaces, by interpolation in logarithms; None where it was not computed."""
    if "lowpass_area" not in load.kept:
        return None
    kept = load.groups["lowpass_area"]
    return np.exp(np.interp(np.log(q), np.log(kept["q"]), np.log(np.maximum(kept["area_corrected"], 1e-12))))


def _draw(sheet: Sheet, panels: tuple[int, int | None], group: Ensemble, title: str, look: tuple):
    colour, marker = look
    parts = [ratio(load) for load in group]
    q, stress = common_bins([(q, stress) for q, stress, _, _ in parts])
    full, count = np.array([full for _, _, full, _ in parts]), parts[0][3]
    x, curves = q / group.q_unit, stress / full
    area = group.mean("area")
    name = f"{title}f_c = {area:.2f}" if np.isfinite(area) else f"{title}p̄ = {group.mean('mean_pressure'):.3g}"
    named = f"{title}{group.name}"
    short = f"{area:.2g}" if np.isfinite(area) else f"{group.mean('mean_pressure'):.2g}"
    f = np.array([theory(load, q) for load in group])
    known = [solved(load, q) for load in group]
    numeric = np.array(known) if all(each is not None for each in known) else None
    symbol = {"color": colour, "marker": marker, "ls": "none", "ms": 2}
    for panel in (panel for panel in panels if panel is not None):
        sheet.curve(panel, x, stress.sum(axis=0) / full.sum(axis=0), name, error=standard_error(curves), label=False,
                    **symbol)  # fmt: skip
        sheet.curve(panel, x, f.mean(axis=0), f"{name}, f(q) of Persson", color=colour, label=False, lw=0.9)
        if numeric is not None:
            sheet.curve(panel, x, numeric.mean(axis=0), f"{name}, f(q) as solved", color=colour, ls="--", label=False,
                        lw=0.9)  # fmt: skip
    label = f"$f_c$ = {short}" if np.isfinite(area) else rf"$\bar p$ = {short}"
    sheet.panels[panels[0]].plot([], [], label=label, **symbol)
    report(sheet, group, named, (x, count, stress, full, f, numeric))


def report(sheet: Sheet, group: Ensemble, name: str, data: tuple):
    """Ratios to both f(q), slopes, and where full contact ends, of each seed."""
    x, count, stress, full, f, numeric = data
    add, curves = sheet.findings.add, stress / full
    top = group.q_limits[1] / group.q_unit
    inner = (x >= INNER) & (x <= top / 2)
    others = [(x >= INNER / 2) & (x <= top / 2), (x >= INNER) & (x <= top), (x >= 2 * INNER) & (x <= top / 4)]
    add(f"contact area, {name}", [load.area for load in group])
    if min(load.area for load in group) == 1:
        add(f"largest |ratio − 1| of a bin in full contact, {name}", np.abs(curves - 1).max(axis=1))
    if not np.any(inner):
        return

    def averaged(part, below):
        return [np.sum(a[part]) / np.sum(b[part]) for a, b in zip(count * stress, count * below, strict=True)]

    for title, fraction in (("f_Persson", f), ("f_solved", numeric)):
        if fraction is not None:
            # the mean over modes counts short waves most; the mean over bins, as the eye sees it, is the other choice
            logarithmic = [np.exp(np.mean(np.log(row[inner]))) for row in curves / fraction]
            spread = [averaged(part, full * fraction) for part in (*others, inner) if np.any(part)]
            add(f"ratio/{title}, {name}", logarithmic, spread)
    add(f"ratio to full contact, {name}", averaged(inner, full),
        [averaged(part, full) for part in others if np.any(part)])  # fmt: skip
    middle = (x >= INNER) & (x <= top / 4)
    neighbours = [(x >= 2 * INNER) & (x <= top / 4), (x >= INNER) & (x <= top / 8), (x >= INNER) & (x <= top / 2)]
    short = (x >= top / 16) & (x <= top / 2)
    choices = [(x >= top / 32) & (x <= top / 2), (x >= top / 16) & (x <= top), (x >= top / 8) & (x <= top / 2)]
    slopes = (("data", curves), ("f_Persson", f), ("f_solved", numeric))
    for title, values in slopes:
        if values is not None and np.count_nonzero(middle) >= 3:
            add(f"slope of {title}, {INNER:g} q_l … q_s/4, {name}", _slopes(x, values, middle),
                [_slopes(x, values, part) for part in neighbours if np.count_nonzero(part) >= 3])  # fmt: skip
        if values is not None and np.count_nonzero(short) >= 3:
            add(f"slope of {title} at large q, {name}", _slopes(x, values, short),
                [_slopes(x, values, part) for part in choices if np.count_nonzero(part) >= 3])  # fmt: skip
    crossings = {level: [crossing(x, row, level) for row in curves] for level in LEVELS}
    if np.all(np.isfinite(crossings[LEVELS[0]])):
        add(
            f"q*/q_l where the ratio falls below {LEVELS[0]:g}, {name}",
            crossings[LEVELS[0]],
            [float(np.nanmean(crossings[level])) for level in LEVELS[1:] if np.any(np.isfinite(crossings[level]))],
        )
        logarithms = {level: np.log(values) for level, values in crossings.items()}
        others = [float(np.nanmean(each)) for each in list(logarithms.values())[1:] if np.any(np.isfinite(each))]
        add(f"ln(q*/q_l), {name}", logarithms[LEVELS[0]], others)
        for title, values in (("f_Persson", f), ("f_solved", numeric)):
            if values is not None:
                add(f"q*/q_l of {title}, {name}", [crossing(x, row, LEVELS[0]) for row in values])
    columns = ("setting", "seed", "q_over_q_l", "modes", "stress", "full_contact", "f_persson", "f_solved")
    for seed, load in enumerate(group):
        last = np.full(len(x), np.nan) if numeric is None else numeric[seed]
        sheet.keep("data", columns, *((name, load.seed, *row) for row in
                                      zip(x, count, stress[seed], full[seed], f[seed], last, strict=True)))  # fmt: skip


def _slopes(x: np.ndarray, curves: np.ndarray, part: np.ndarray) -> list[float]:
    """The exponent of each curve (samples, m) over a part of x."""
    return [fit_power_law(x[part], np.maximum(row[part], 1e-300))[0] for row in curves]
