"""What a run looks like: a page with fields to zoom into, and a picture of the last load.

Writes overview.html, which shows all loads of the first folder, and draws the last one; what was not kept is left out.
"""

import math
from collections.abc import Callable, Iterator, Sequence

import matplotlib
import numpy as np
from choosing import NEEDS as TESTS
from maps import PIXELS, show_field, thinned, thinned_blocks, unit_text
from matplotlib.colors import LightSource, ListedColormap, LogNorm, PowerNorm
from overview_charts import distribution, scaled_spectra
from overview_page import write_page
from patch_areas import PATCHES, areas
from plotting import BLACK, BLUE, GREY, PAGE, RED, Sheet
from reading import Load

from pgfmd.theory import persson

CAPTION = """The rigid surface, lit from the side, and the pressure where it touches; the gap, on a scale that spreads
its small values; contact patches by their area; the distribution of contact pressures with Persson's prediction, which
has no free parameter; spectra C̃ of the stress and of the contact, scaled so that they coincide where both are alike,
up to q_s (dotted); and the contact area, corrected for the pixels, at all loads."""
NEEDS = ("load",)
OPTIONS = {
    "--loads": {"type": int, "nargs": "+", "metavar": "N", "dest": "chosen",
                "help": "loads whose fields are on the page (default: six of them)"},
    "--no-tiles": {"action": "store_false", "dest": "tiles",
                   "help": "no folder beside the page: of a large field, a coarse picture and its most loaded part"},
}  # fmt: skip
MOST_POINTS = 2**24  # of a grid whose spectra are made from the fields, if the run kept none


def draw(loads: list[Load], chosen: Sequence[int] | None = None, tiles: bool = True) -> Sheet:
    """Up to six panels of the last load, and the page of all."""
    first = loads[0].results.directory
    run = [load for load in loads if load.results.directory == first]
    load, others = run[-1], {other.results.directory for other in loads} - {first}
    notes = [f"of {len(others) + 1} runs, the first is shown: {load.folder}"] if others else []
    panels = list(_panels(run, notes))
    columns = len(panels) if len(panels) <= 3 else -(-len(panels) // 2)
    sheet = Sheet(-(-len(panels) // columns), columns, width=PAGE if columns > 1 else None, height=2.3)
    for panel, function in enumerate(panels):
        function(sheet, panel, load)
    for panel in range(len(panels), len(sheet.panels)):
        sheet.drop(panel)
    sheet.notes += notes
    sheet.extra_files.append(lambda output: write_page(run, output, chosen, tiles))
    for name, value in {
        "mean pressure": load.mean_pressure, "contact area f_c": load.area,
        "contact area, corrected": load.corrected_area, "κ = f_c E' ḡ/p̄": load.number("kappa"),
        "κ, corrected": load.number("kappa") * load.corrected_area / load.area if load.area else math.nan,
        "certified error": load.number("certified_error"), "transforms": load.number("transforms"),
        "seconds of the relaxation": load.number("seconds"),
    }.items():  # fmt: skip
        sheet.findings.add(name, value)
    return sheet


def _panels(run: list[Load], notes: list[str]) -> Iterator[Callable]:
    """The functions that draw the panels of the last load; missing ones are named in `notes`."""
    load = run[-1]
    spectra = "stress_spectrum" in load.kept or np.prod(load.results.shape) <= MOST_POINTS
    there = {
        draw_surface: ("height" in load.fields, TESTS["height"][1]),
        draw_gap: ("gap" in load.fields, 'field "gap"'),
        draw_patches: (areas(load, PIXELS) is not None, PATCHES.removeprefix("the ")),
        draw_distribution: (TESTS["histogram"][0](load), TESTS["histogram"][1]),
        draw_spectra: (spectra and TESTS["spectra"][0](load),
                       'observable "spectra"'),
    }  # fmt: skip
    for function, (known, lacking) in there.items():
        if known:
            yield function
        else:
            notes.append(f"not drawn: {load.folder} has no {lacking}")
    yield draw_numbers if len(run) == 1 else lambda sheet, panel, _: draw_loads(sheet, panel, run)


def draw_surface(sheet: Sheet, panel: int, load: Load):
    """The heights, lit from the side, with the contact on top."""
    height = thinned(load, "height")
    light = LightSource(azdeg=135, altdeg=40)
    span = np.ptp(height) or 1.0
    shaded = 0.6 * (height - height.min()) / span
    if min(height.shape) > 1:  # a profile has no slope across
        shaded += 0.4 * light.hillshade(height.T, vert_exag=60 / span).T
    show_field(sheet, panel, load, shaded, cmap="gray", vmin=-0.1, vmax=1)
    if "pressure" not in load.fields:
        return
    pressure = thinned(load, "pressure")
    contact = np.ma.masked_where(pressure <= 0, pressure)
    top = float(np.quantile(pressure[pressure > 0], 0.99)) if np.any(pressure > 0) else 1.0
    colours = ListedColormap(matplotlib.colormaps["inferno"](np.linspace(0.35, 1, 256)))  # bright against the grey
    unit = unit_text(load, "pressure")
    show_field(sheet, panel, load, contact, "pressure" + (f" / {unit}" if unit else ""), cmap=colours, vmin=0, vmax=top)
    if math.isfinite(load.area):
        sheet.panels[panel].set_title(f"contact: {100 * load.area:.2g} %", loc="right")


def draw_gap(sheet: Sheet, panel: int, load: Load):
    """The gap; blank where it is 0."""
    gap, unit = thinned(load, "gap"), unit_text(load, "length")
    shown = np.ma.masked_where(gap <= 0, gap) if load.releases else gap
    norm = PowerNorm(0.5, vmin=0) if load.releases else None
    show_field(sheet, panel, load, shown, "gap" + (f" / {unit}" if unit else ""), cmap="viridis", norm=norm)


def draw_patches(sheet: Sheet, panel: int, load: Load):
    """The contact patches, coloured by their area."""
    count = max(1, 2**22 // load.results.shape[1])
    starts = range(0, load.results.shape[0], count)
    blocks = ((slice(start, None), rows) for start, rows in zip(starts, areas(load, count), strict=True))
    area = thinned_blocks(load, blocks)
    unit, point = unit_text(load, "length"), float(np.prod(load.spacings))
    norm = LogNorm(point, max(float(area.max()), 10 * point))
    label = "area of the patch" + (" / points" if unit == "grid spacings" else f" / {unit}²" if unit else "")
    show_field(sheet, panel, load, np.ma.masked_where(area <= 0, area), label, cmap="cividis", norm=norm)


def draw_numbers(sheet: Sheet, panel: int, load: Load):
    """The numbers of a single load, as text."""
    axes, (nx, ny) = sheet.panels[panel], load.results.shape
    unit, length = unit_text(load, "pressure"), unit_text(load, "length")
    numbers = {
        "points": f"{nx} × {ny}", "mean pressure": f"{load.mean_pressure:.4g} {unit}",
        "contact area": f"{load.area:.4g}", "corrected": f"{load.corrected_area:.4g}",
        r"$\kappa = f_c E' \bar g / \bar p$": f"{load.number('kappa'):.4g}",
        "mean gap": f"{load.number('mean_gap'):.4g} {length}",
        "certified error": f"{load.number('certified_error'):.1e}",
    }  # fmt: skip
    axes.axis("off")
    for number, (name, text) in enumerate(numbers.items()):
        height = 0.9 - 0.12 * number
        axes.text(0.0, height, name, transform=axes.transAxes, color="0.35")
        axes.text(1.0, height, text.strip(), transform=axes.transAxes, ha="right")


def draw_loads(sheet: Sheet, panel: int, run: Sequence[Load]):
    """The contact area (where there is no contact, the mean gap) at all loads, against the mean pressure."""
    touching = [load for load in run if load.area > 0]
    name, used = ("corrected_area", touching) if touching else ("", run)
    y = [load.corrected_area if touching else load.number("mean_gap") for load in used]
    std, unit = run[0].full_contact_std, unit_text(run[0], "pressure")
    x = np.array([load.mean_pressure for load in used]) / (std if std > 0 else 1)
    errors = [load.area_error for load in used]
    error = np.array(errors) if name and np.all(np.isfinite(errors)) else None
    sheet.curve(panel, x, y, "simulation", error, color=BLUE, marker="o", ls="none")
    if touching and run[0].law == "hard" and std > 0 and len(used) > 1:
        p = np.geomspace(x.min(), x.max(), 60)
        sheet.curve(panel, p, persson.contact_fraction(p, 1.0), "Persson", color=BLACK)
    label = r"$\bar p\,/\,(E'\bar g/2)$" if std > 0 else r"$\bar p$" + (f" / {unit}" if unit else "")
    gap = "mean gap" + (f" / {unit_text(run[0], 'length')}" if unit_text(run[0], "length") else "")
    sheet.label(panel, label, "contact area $f_c$" if touching else gap, scale="log" if touching else "semilogx")


def draw_distribution(sheet: Sheet, panel: int, load: Load):
    """P(σ) over the whole surface in units of the full-contact pressure, with Persson's prediction at the same load."""
    (sigma, density, smooth, theory), std = distribution(load), load.full_contact_std
    if len(sigma):
        sheet.curve(panel, sigma / std, density * std, "simulation", color=BLUE, marker="o", ls="none", ms=2)
        sheet.curve(panel, smooth / std, theory * std, "Persson", color=BLACK)
        sheet.label(panel, r"$\sigma\,/\,(E'\bar g/2)$", r"$P(\sigma)\;E'\bar g/2$", scale="semilogy")


def draw_spectra(sheet: Sheet, panel: int, load: Load):
    """Stress and contact spectra, normalised so that both tend to one curve where they are alike."""
    for (name, q, value), colour, dashes in zip(scaled_spectra(load), (RED, BLUE), ("-", "--"), strict=False):
        sheet.curve(panel, q, value, name, color=colour, ls=dashes)
    sheet.panels[panel].axvline(load.q_limits[1] / load.q_unit, color=GREY, lw=0.8, ls=":")
    partial = 0 < load.area < 1
    quantity = r"$f_c\,\tilde C(q)\,/\,[(1-f_c)\,\tilde C(0)]$" if partial else r"$|\tilde\sigma|^2/\bar p^2$"
    sheet.label(panel, r"$q\,/\,q_l$", quantity, scale="log")
