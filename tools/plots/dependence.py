"""One number of each load against another: a column of the table of loads, a moment, an exponent, a crossover.

Runs that differ by the seed alone are averaged.  A curve holds the loads that differ by nothing but the seed and what
is on the horizontal axis.  `--fit` fits a power law to the absolute means in a range of that axis, and draws these;
`--level` says where each curve reaches a value; `--marks` draws values of the horizontal axis.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import contact_patches
import field_theory
import numpy as np
import persson_spectrum
from estimators import band_ratio, broken_power_law, crossing, fit_power_law, left_out_error, tail_exponent
from matplotlib.ticker import NullLocator
from plotting import BLACK, GREY, MOST, Finding, Sheet, standard_error, style
from reading import Load
from samples import Ensemble, ensembles, imposed, named_differences, setting

from pgfmd.errors import InputError

CAPTION = """Means over seeds with standard errors (none where one seed has the number). Lines join loads that differ by
nothing but what is on the horizontal axis. Dashed: a power law, drawn over the range of its fit, or a level. Dotted:
values named in the text. Where a power law is fitted to absolute values, open symbols are negative ones."""
NEEDS = ()
OPTIONS = {
    "--of": {"nargs": "+", "help": "what is drawn: columns of the table of loads, or m2, q_star, q_star_persson, "
                                   "field_theory_K_K (K: first and last q/q_l), patch_slope, patch_crossover, "
                                   "patch_tail, bearing_tail (default mean_gap)"},
    "--on": {"help": "horizontal axis: a column, or one of lambda_s (in grid spacings), waves (λ_l/λ_s), zeta, "
                     "gap_over_range (rms gap about its mean, over ζ) (default mean_pressure)"},
    "--fit": {"type": float, "nargs": 2, "metavar": ("FROM", "TO"), "help": "range of a power law on that axis"},
    "--level": {"type": float, "help": "value that curves reach: where they do is reported"},
    "--marks": {"type": float, "nargs": "+", "help": "places on the horizontal axis that are marked"},
    "--expected": {"type": float, "nargs": "+", "help": "values that are marked, one for each curve or for all"},
}  # fmt: skip
LEVEL = 0.9  # stress spectrum over that of full contact that defines q*: there the ratio falls below this
LEAST = 16  # pixels of the smallest patch that is fitted


@dataclass(frozen=True)
class Quantity:
    """A number of a load: the label of its axis, its value, the keys of a job that set it, its word in legends."""

    axis: str
    value: Callable[[Load], float]
    keys: tuple[str, ...] = ()
    of_setting: bool = False  # the same for all loads of a run
    word: str = ""


def m2(load: Load) -> float:
    """⟨σ²⟩_c/σ_c²."""
    return load.normalised_second_moment


def q_star(load: Load) -> float:
    """q*/q_l: where the stress spectrum over that of full contact falls below LEVEL; NaN if it never does."""
    q, stress, full, _ = persson_spectrum.ratio(load)
    return crossing(q / load.q_unit, stress / full, LEVEL)


def q_star_persson(load: Load) -> float:
    """The same for f(q), which Persson's theory has in place of that ratio."""
    q = persson_spectrum.ratio(load)[0]
    return crossing(q / load.q_unit, persson_spectrum.theory(load, q), LEVEL)


def departure(low: int, high: int) -> Callable[[Load], float]:
    """Stress spectrum over field theory − 1 in a band of q/q_l, summed mode by mode."""

    def value(load: Load) -> float:
        q, stress, count = load.spectrum("stress")
        ratio = band_ratio([(low, high)], np.round(q / load.q_unit), count, stress, field_theory.summed(load))
        return float(ratio[0]) - 1

    return value


def gap_over_range(load: Load) -> float:
    """Rms value of the gap about its mean, over ζ."""
    count, total, squares = 0, 0.0, 0.0
    for _, gap in load.results.blocks("gap", load.index):
        count, total, squares = count + gap.size, total + float(gap.sum()), squares + float(np.sum(gap**2))
    return math.sqrt(squares / count - (total / count) ** 2) / (load.zeta or math.nan)


def _patches(estimate: Callable, table: str = "patches") -> Callable[[Load], float]:
    def value(load: Load) -> float:
        sample = contact_patches.patches(load, table)
        resolved = LEAST * float(np.prod(load.spacings)) / load.wavelengths[0] ** 2
        return float(estimate(sample, resolved)) if len(sample[0]) else math.nan

    return value


def _crossover(sample: contact_patches.Sample, resolved: float) -> float:
    return broken_power_law(*contact_patches.medians_between(sample, resolved, math.inf))[2]


QUANTITIES = {
    "m2": Quantity(r"$m_2 = \langle\sigma^2\rangle_c\,/\,\sigma_c^2$", m2),
    "q_star": Quantity(r"$q^*/\,q_l$", q_star, word="simulation"),
    "q_star_persson": Quantity(r"$q^*/\,q_l$", q_star_persson, word="Persson"),
    "patch_slope": Quantity(
        r"exponent of $l_c(a_c)$, $a_c \leq 0.1\,\lambda_s^2$",
        _patches(lambda sample, least: contact_patches.slope(sample, least, contact_patches.SMALL)),
        word="exponent",
    ),
    "patch_crossover": Quantity(r"crossover $a_c\,/\,\lambda_s^2$", _patches(_crossover), word="crossover"),
    "patch_tail": Quantity(
        r"$\tau$ of patches above $\lambda_s^2$",
        _patches(lambda sample, least: tail_exponent(sample[0], max(contact_patches.LARGE, least))[0]),
    ),
    "bearing_tail": Quantity(
        r"$\tau$ of patches of the bearing area",
        _patches(lambda sample, least: tail_exponent(sample[0], least)[0], "bearing_patches"),
    ),
    "lambda_s": Quantity(
        r"$\lambda_s\,/\,a$", lambda load: load.wavelengths[0] / min(load.spacings), ("surface.lambda_s",), True
    ),
    "waves": Quantity(
        r"$\lambda_l\,/\,\lambda_s$", lambda load: load.wavelengths[1] / load.wavelengths[0],
        ("surface.lambda_s", "grid."), True,
    ),
    "zeta": Quantity(r"$\zeta$", lambda load: load.zeta or math.nan, ("wall.zeta",), True),
    "gap_over_range": Quantity(r"rms gap $/\,\zeta$", gap_over_range, ("wall.zeta",)),
}  # fmt: skip


def quantity(name: str, loads: list[Load]) -> Quantity:
    """The number of that name.  Raises InputError if it is neither in QUANTITIES nor a column of the loads."""
    if name.startswith("field_theory_"):
        ends = name.removeprefix("field_theory_").split("_")
        if len(ends) == 2 and all(end.isdigit() for end in ends):
            band = "–".join(ends)
            return Quantity("ratio to field theory $-$ 1", departure(*map(int, ends)), word=f"$q/q_l$ = {band}")
    if name in QUANTITIES:
        return QUANTITIES[name]
    columns = sorted({column for load in loads for column in load.results.loads})
    if name not in columns:
        raise InputError(f"{name!r} is no column of these loads; it is one of {', '.join([*QUANTITIES, *columns])}")
    axis = "contact area $f_c$" if name == "contact_area" else name.replace("_", " ")
    return Quantity(axis, lambda load: load.number(name))


def draw(
    loads: list[Load], of: Sequence[str] = ("mean_gap",), on: str = "mean_pressure",
    fit: tuple[float, float] | None = None, level: float | None = None, marks: Sequence[float] = (),
    expected: Sequence[float] = (),
) -> Sheet:  # fmt: skip
    """The numbers `of` against the number `on`, one curve for each setting (and load, if `on` is of the setting), and a
    panel for each label of an axis.
    """
    horizontal, drawn = quantity(on, loads), 0
    axes = list(dict.fromkeys(quantity(what, loads).axis for what in of))
    sheet, curves, ticks = Sheet(1, len(axes)), list(_curves(loads, horizontal).values()), set()
    place_of = {load: number for number, groups in enumerate(curves) for group in groups for load in group}
    x = cache(horizontal.value)
    for what in of:
        vertical = quantity(what, loads)
        panel, y = axes.index(vertical.axis), cache(vertical.value)
        alike = [other for other in of if quantity(other, loads).axis == vertical.axis]
        known = [load for load in loads if math.isfinite(y(load))]
        if len(known) < len(loads):
            name = vertical.word or what.replace("_", " ")
            sheet.notes.append(f"{len(loads) - len(known)} of {len(loads)} loads have no number for “{name}”")
        for name, groups in _curves(known, horizontal).items():
            title = ", ".join(filter(None, ([vertical.word or vertical.axis, name] if len(alike) > 1 else [name])))
            points = sorted(((float(np.mean([x(load) for load in group])), group) for group in groups), key=_place)
            for place, group in points:
                sheet.findings.add(f"{what}, {group.name}", [y(load) for load in group])
                rows = ((what, name, group.name, load.seed, x(load), place, y(load)) for load in group)
                sheet.keep("data", ("of", "curve", "setting", "seed", on, f"mean {on}", "value"), *rows)
            # a setting has one colour; of two numbers of one axis, the second has open symbols
            turn = alike.index(what)
            number = place_of[groups[0].loads[0]] + len(curves) * (turn // 2) if len(curves) > 1 else turn
            look = style(number, filled=len(curves) == 1 or turn % 2 == 0)
            if drawn < MOST * len(axes):
                _draw(sheet, panel, title or what, points, (y, look, bool(fit)))
            ticks |= {place for place, _ in points}
            seeds: dict[object, list[tuple[float, float]]] = {}
            for load in (load for _, group in points for load in group):
                seeds.setdefault(load.seed, []).append((x(load), y(load)))
            after = f", {name}" if name else ""
            if level is not None:
                places = [reached(*np.array(each).T, level) for each in seeds.values()]
                sheet.findings.add(f"{on} where {what} reaches {level:g}{after}", places)
            if fit:
                name = f"exponent of {what} against {on}{after}"
                _fit(sheet, name, list(seeds.values()), fit, (panel, look["color"]))
            drawn += 1
    if not drawn:
        raise InputError(f"dependence needs a load whose {' or '.join(of)} is known")
    if drawn > MOST * len(axes):
        sheet.notes.append(f"{drawn} curves; the first {MOST * len(axes)} are drawn, all are in the tables")
    positive = all(row[column] > 0 for row in sheet._table for column in (2, 3))
    for panel, axis in enumerate(axes):
        _finish(sheet.panels[panel], (level, marks, expected), len(curves))
        title = f"|{axis}|" if fit else axis
        sheet.label(panel, horizontal.axis, title, scale=SCALES[positive], columns=2 if len(axes) == 1 else 4,
                    legend=len(axes) == 1 or panel == 0 and "figure")  # fmt: skip
        if horizontal.of_setting and len(ticks) < 9:
            sheet.panels[panel].set_xticks(sorted(ticks), [f"{tick:g}" for tick in sorted(ticks)])
            sheet.panels[panel].xaxis.set_minor_locator(NullLocator())
    return sheet


def _finish(panel, lines: tuple[float | None, Sequence[float], Sequence[float]], curves: int):
    """Draw the level, the marks, and the values expected of each curve or of all."""
    level, marks, expected = lines
    if level is not None:
        panel.axhline(level, color=BLACK, ls="--", lw=0.7)
    for mark in marks:
        panel.axvline(mark, color=GREY, ls=":", lw=0.9)
    for number, value in enumerate(expected):
        panel.axhline(value, color=style(number)["color"] if len(expected) == curves else BLACK, ls=":", lw=1.0)


SCALES = {True: "log", False: "semilogx"}


def _place(point: tuple[float, Ensemble]) -> float:
    return point[0]


def _curves(loads: list[Load], horizontal: Quantity) -> dict[str, list[Ensemble]]:
    """Loads that differ by nothing but what is on the horizontal axis and the seed: name of the curve → its points."""
    groups: dict[tuple, list[Ensemble]] = {}
    settings: dict[tuple, dict] = {}
    for group in ensembles(loads):
        first = group.loads[0]
        varied = [key for key in setting(first) if horizontal.keys and key.startswith(horizontal.keys)]
        fixed = {key: value for key, value in setting(first).items() if key not in varied}
        key = (*((key, str(value)) for key, value in fixed.items()), imposed(first) * horizontal.of_setting)
        groups.setdefault(key, []).append(group)
        settings[key] = fixed
    titles = [", ".join(words) for words in named_differences(list(settings.values()))]
    several = len({key[-1] for key in groups}) > 1
    names = [", ".join(filter(None, (title, key[-1] * several))) for title, key in zip(titles, groups, strict=True)]
    return dict(zip(names, groups.values(), strict=True))


def _draw(sheet: Sheet, panel: int, name: str, points: list, what: tuple[Callable, dict, bool]):
    """Means with errors, NaN for a single seed; where they are absolute, negative ones have open symbols."""
    y, look, absolute = what
    values = [[y(load) for load in group] for _, group in points]
    errors = np.array([standard_error(each) for each in values])
    x, means = np.array([place for place, _ in points]), np.array([np.mean(each) for each in values])
    sheet.curve(panel, x, np.abs(means) if absolute else means, name, error=errors, lw=0.7, **look)
    if absolute and np.any(means < 0):
        sheet.curve(panel, x[means < 0], -means[means < 0], f"{name}, negative", label=False, ls="none", zorder=5,
                    **look | {"mfc": "white"})  # fmt: skip


def reached(x: np.ndarray, y: np.ndarray, level: float) -> float:
    """The first x (ascending) at which y passes the level, from below or above; NaN if it does not."""
    return crossing(x, y, level) if y[0] > level else crossing(x, -y, -level)


def _fit(sheet: Sheet, name: str, seeds: list[list[tuple[float, float]]], limits: tuple[float, float], look: tuple):
    """The exponent of |mean over the seeds that have all loads| between limits; its error by leaving one out."""

    def exponent(chosen: list) -> tuple[float, float, np.ndarray]:
        x, y = np.mean(np.array(chosen), axis=0).T
        part = (x >= limits[0]) & (x <= limits[1]) & (y != 0)
        if np.count_nonzero(part) < 3:
            return math.nan, math.nan, x[part]
        slope, (offset,) = fit_power_law(x[part], np.abs(y[part]))
        return slope, offset, x[part]

    longest = max(map(len, seeds))
    whole = [each for each in seeds if len(each) == longest]
    slope, offset, x = exponent(whole)
    sheet.findings.add(name, slope)
    if name not in sheet.findings:
        return
    if len(whole) > 2:
        error = left_out_error(whole, lambda some: exponent(some)[0])
        sheet.findings[name] = Finding(slope, error, None, len(whole))
    along = np.geomspace(x[0], x[-1], 40)
    panel, colour = look
    sheet.curve(panel, along, np.exp(offset) * along**slope, name, label=False, color=colour, ls="--", lw=0.9)
