"""Contact patches: load against area with binned medians, and the distribution of their areas.

Patches of all loads and seeds of a setting are taken together.  Those of fewer than `--smallest` pixels are drawn, and
left out of the fits.  Size laws are fitted by maximum likelihood, with a test of goodness.
"""

from collections.abc import Callable, Sequence

import numpy as np
from choosing import AREAS, near
from estimators import broken_power_law, fit_power_law, goodness, left_out_error, tail_exponent
from plotting import BLACK, BLUE, COLOURS, GREY, MARKERS, Finding, Sheet, guide
from reading import Load
from samples import by_run, ensembles

from pgfmd.theory import bearing

CAPTION = """(a) Load of each contact patch against its area (dots), and medians in bins of the area, one symbol for
each contact area; dashed: exponents of Hertz (3/2) and of constant mean pressure (1). (b) Probability density of the
patch areas in elastic contact (filled) and of the bearing area (open), with power laws fitted by maximum likelihood
over the range that they span (full lines; grey: bearing area), and its law τ = 2 − H/2 (dashed). Bearing areas are
shown where the runs kept their patches. Dotted: the smallest patch in the fits."""
NEEDS = ("patches", "area", "roughness")
OPTIONS = AREAS | {
    "--smallest": {"type": int, "help": "pixels of the smallest patch in the fits (default 16)"},
}
SMALL, LARGE = 0.1, 1.0  # in λ_s²: patches up to SMALL are parts of single asperities, those from LARGE on hold many
PER_DECADE = 6  # bins
DOTS = 3000  # patches drawn one by one
FEWEST = 5  # patches whose median counts in a fit

Sample = tuple[np.ndarray, np.ndarray]
"""Areas in λ_s² and loads in E' g λ_s² of patches."""


def draw(loads: list[Load], areas: tuple[float, ...] = (), smallest: int = 16) -> Sheet:
    """Both panels, of the first setting; numbers of all loads and seeds together, with errors over the seeds."""
    settings = ensembles(near(loads, areas), by_load=False)
    setting, sheet = settings[0], Sheet(1, 2, height=2.9)
    if len(settings) > 1:
        sheet.notes.append(f"one of {len(settings)} settings is drawn: {setting.label}")
    unit = setting.wavelengths[0] ** 2
    resolved = smallest * float(np.prod(setting.spacings)) / unit
    runs = by_run(setting)
    samples = [merged([patches(load) for load in run]) for run in runs.values()]
    everything = merged(samples)
    if len(everything[0]) == 0:
        sheet.notes.append("there is no patch")
        return sheet
    _draw_loads(sheet, setting.loads, everything, resolved)
    report_loads(sheet, samples, resolved)
    islands = [merged([patches(load, "bearing_patches") for load in run]) for run in runs.values()]
    _draw_sizes(sheet, setting.hurst, everything[0], merged(islands)[0], resolved)
    report_sizes(sheet, "elastic", [size for size, _ in samples], resolved)
    if len(merged(islands)[0]):
        report_sizes(sheet, "bearing", [size for size, _ in islands], resolved)
        if setting.hurst is not None:
            sheet.findings.add("τ = 2 − H/2 of islands", bearing.patch_exponent(setting.hurst))
    for run, (size, force) in zip(runs, samples, strict=True):
        rows = ((run.name, "elastic", *row) for row in zip(size, force, strict=True))
        sheet.keep("data", ("run", "kind", "area", "load"), *rows)
    for run, (size, _) in zip(runs, islands, strict=True):
        sheet.keep("data", ("run", "kind", "area", "load"), *((run.name, "bearing", a, np.nan) for a in size))
    return sheet


def patches(load: Load, table: str = "patches") -> Sample:
    """Areas in λ_s² and loads in E' g λ_s² of a load's patches; loads are NaN for the bearing area."""
    if table not in load.kept:
        return np.empty(0), np.empty(0)
    kept, unit = load.groups[table], load.wavelengths[0] ** 2
    size = kept["area"] / unit
    return size, kept["load"] / (unit * load.modulus * load.rms_slope) if "load" in kept else np.full(len(size), np.nan)


def merged(samples: Sequence[Sample]) -> Sample:
    """All patches of several samples."""
    return tuple(np.concatenate([sample[i] for sample in samples]) for i in (0, 1))


def binned(size: np.ndarray, load: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Median size, median load and number of patches in logarithmic bins of the size that are not empty: (m,) each.

    Bins lie at fixed places, six to a decade.
    """
    index = np.floor(np.log10(size) * PER_DECADE + 1e-9).astype(int)
    bins = [index == number for number in np.unique(index)]
    return tuple(np.array([f(chosen) for chosen in bins]) for f in (
        lambda chosen: np.median(size[chosen]), lambda chosen: np.median(load[chosen]), np.count_nonzero))  # fmt: skip


def medians_between(sample: Sample, least: float, most: float) -> tuple[np.ndarray, np.ndarray]:
    """Binned medians of the patches with least ≤ area ≤ most, in bins of FEWEST patches and more."""
    size, load = sample
    inside = (size >= least) & (size <= most)
    if not np.any(inside):
        return np.empty(0), np.empty(0)
    x, y, count = binned(size[inside], load[inside])
    return x[count >= FEWEST], y[count >= FEWEST]


def slope(sample: Sample, least: float, most: float) -> float:
    """Exponent of l_c ∝ a_c^m by least squares of binned medians; NaN for fewer than three bins."""
    x, y = medians_between(sample, least, most)
    return fit_power_law(x, y)[0] if len(x) >= 3 else float("nan")


def report_loads(sheet: Sheet, samples: list[Sample], resolved: float):
    """Slopes below and above, the crossover, and the mean pressure of large patches."""
    everything = merged(samples)
    sheet.findings.add("patches", len(everything[0]))
    sheet.findings.add("patches of the fits", np.count_nonzero(everything[0] >= resolved))
    whole = np.inf
    _report(sheet, "slope of small patches (to 0.1 λ_s²)", samples, lambda s: slope(s, resolved, SMALL),
            [lambda s: slope(s, resolved, SMALL / 2), lambda s: slope(s, resolved, 2 * SMALL),
             lambda s: slope(s, 2 * resolved, SMALL)])  # fmt: skip
    _report(sheet, "slope of large patches (from λ_s²)", samples, lambda s: slope(s, LARGE, whole),
            [lambda s: slope(s, LARGE / 2, whole), lambda s: slope(s, 2 * LARGE, whole)])  # fmt: skip
    _report(sheet, "crossover area/λ_s², two lines that meet", samples, lambda s: _broken(s, resolved),
            [lambda s: _meeting(s, resolved), lambda s: _broken(s, 2 * resolved)])  # fmt: skip
    _report(sheet, "mean pressure of patches ≥ λ_s², over E'g", samples, lambda s: _saturated(s, LARGE),
            [lambda s: _saturated(s, 2 * LARGE)])  # fmt: skip


def report_sizes(sheet: Sheet, kind: str, sizes: list[np.ndarray], resolved: float):
    """Exponents of P(a_c) ∝ a_c^−τ by maximum likelihood, below 0.3 λ_s² and above λ_s², and their goodness."""

    def law(least, most=np.inf):
        return lambda size: tail_exponent(size, least, most)[0]

    everything, large = np.concatenate(sizes), max(LARGE, resolved)
    _report(sheet, f"τ of large patches (from λ_s²), {kind}", sizes, law(large),
            [law(max(large / 2, resolved)), law(2 * large)])  # fmt: skip
    _report(sheet, f"τ of small patches (to 0.3 λ_s²), {kind}", sizes, law(resolved, 0.3),
            [law(resolved, 0.15), law(resolved, 0.6), law(2 * resolved, 0.3)])  # fmt: skip
    _report(sheet, f"τ over all resolved patches, {kind}", sizes, law(resolved), [law(2 * resolved), law(4 * resolved)])
    for title, least, most in (("large", large, np.inf), ("small", resolved, 0.3)):
        sheet.findings.add(f"goodness of the law of {title} patches (p), {kind}", goodness(everything, least, most))
    sheet.findings.add(f"patches ≥ λ_s², {kind}", np.count_nonzero(everything >= LARGE))


def _report(sheet: Sheet, name: str, samples: list, estimate: Callable, others: Sequence[Callable]):
    """A number of all samples together; error by leaving one sample (seed) out at a time; others as choices."""
    join = merged if isinstance(samples[0], tuple) else np.concatenate
    whole = join(samples)
    value = estimate(whole)
    if not np.isfinite(value):
        return
    sheet.findings.add(name, value, [other(whole) for other in others])
    if (error := left_out_error(samples, lambda some: estimate(join(some)))) is not None:
        sheet.findings[name] = Finding(value, error, sheet.findings[name].choices, len(samples))


def _broken(sample: Sample, resolved: float) -> float:
    return broken_power_law(*medians_between(sample, resolved, np.inf))[2]


def _meeting(sample: Sample, resolved: float) -> float:
    """Where the lines fitted to small and to large patches meet."""
    small, large = medians_between(sample, resolved, SMALL), medians_between(sample, LARGE, np.inf)
    if min(len(small[0]), len(large[0])) < 3:
        return float("nan")
    (m, (c,)), (n, (d,)) = fit_power_law(*small), fit_power_law(*large)
    return float(np.exp((d - c) / (m - n)))


def _saturated(sample: Sample, least: float) -> float:
    size, load = sample
    large = size >= least
    return float(load[large].sum() / size[large].sum()) if np.any(large) else float("nan")


def _draw_loads(sheet: Sheet, loads: Sequence[Load], everything: Sample, resolved: float):
    size, force = everything
    dots = np.random.default_rng(1).permutation(len(size))[:DOTS]
    sheet.curve(0, size[dots], force[dots], "patches", color="0.75", marker=".", ls="none", ms=1.2, label=False)
    for number, group in enumerate(ensembles(loads)[: len(COLOURS)]):
        x, y, count = binned(*merged([patches(load) for load in group]))
        enough = count >= FEWEST
        if np.any(enough):
            sheet.curve(0, x[enough], y[enough], f"f_c = {group.mean('area'):.2g}", color=COLOURS[number],
                        marker=MARKERS[number], mfc="white", ls="none")  # fmt: skip
    x, y = medians_between(everything, 0, np.inf)
    # one guide below all medians of its range, the other one above
    for least, most, law, text, outer, shift in ((resolved, 1.0, 1.5, "3/2", np.min, 0.3),
                                                 (0.3, np.inf, 1.0, "1", np.max, 3.0)):  # fmt: skip
        part = (x >= least) & (x <= most)
        if np.count_nonzero(part) >= 2:
            start = shift * outer(y[part] / x[part] ** law) * x[part][0] ** law
            guide(sheet.panels[0], x[part][[0, -1]], start, law, text, above=shift > 1)
    sheet.label(0, r"area $a_c\,/\,\lambda_s^2$", r"load $l_c\,/\,(E'\bar g\,\lambda_s^2)$", scale="log", columns=3)


def _draw_sizes(sheet: Sheet, hurst: float | None, elastic: np.ndarray, islands: np.ndarray, resolved: float):
    """Probability densities of the patch areas."""
    for name, size, fill in (("elastic contact", elastic, BLUE), ("bearing area", islands, "white")):
        if len(size) == 0:
            continue
        edges = np.geomspace(size.min() * 0.999, size.max() * 1.001,
                             int(np.log10(size.max() / size.min()) * PER_DECADE) + 2)  # fmt: skip
        count, _ = np.histogram(size, edges)
        seen = count > 0
        density = count / (np.diff(edges) * len(size))
        middle, error = np.sqrt(edges[1:] * edges[:-1]), density / np.sqrt(np.maximum(count, 1))
        sheet.curve(1, middle[seen], density[seen], name, error=error[seen], color=BLUE if fill == BLUE else GREY,
                    mfc=fill, marker="o" if fill == BLUE else "s", ls="none")  # fmt: skip
        for least, most in (
            ((max(LARGE, resolved), np.inf), (resolved, 0.3)) if name == "elastic contact" else ((resolved, np.inf),)
        ):
            _draw_law(sheet, size, least, most, name)
    if hurst is not None:
        tail = islands[islands >= resolved]
        if len(tail) > 10:
            tau = bearing.patch_exponent(hurst)
            ends = np.array([resolved, tail.max()])
            scale = len(tail) / len(islands) * (tau - 1) / resolved
            sheet.curve(
                1, ends, scale * (ends / resolved) ** -tau, rf"$2 - H/2$ = {tau:.2f}", color=BLACK, ls="--", lw=0.8
            )
    sheet.panels[1].axvline(resolved, color=GREY, lw=0.7, ls=":")
    sheet.label(1, r"area $a_c\,/\,\lambda_s^2$", r"$P(a_c)\,\lambda_s^2$", scale="log", columns=2)


def _draw_law(sheet: Sheet, size: np.ndarray, least: float, most: float, name: str):
    tau = tail_exponent(size, least, most)[0]
    inside = size[(size >= least) & (size <= most)]
    if np.isnan(tau) or len(inside) < 10 or most < 2 * least:
        return
    ends = np.geomspace(inside.min(), inside.max(), 40)
    shape = (ends / least) ** -tau
    norm = np.sum((shape[1:] + shape[:-1]) / 2 * np.diff(ends))
    sheet.curve(1, ends, shape / norm * len(inside) / len(size), f"τ = {tau:.2f}, {name}", label=False,
                color=BLACK if name == "elastic contact" else GREY, lw=0.9, zorder=5)  # fmt: skip
    place = (-30, -11) if name == "elastic contact" else (6, 5)
    sheet.panels[1].annotate(rf"$\tau$ = {tau:.2f}", (ends[20], shape[20] / norm * len(inside) / len(size)), place,
                             "data", "offset points", fontsize=7, color="0.2")  # fmt: skip
