"""What one load looks like: the surface with its contact, the distribution of pressures, stress and contact spectra.

    pgfmd plot overview DIR

Draws the last load of the first folder that has something to show; what was not kept is left out.
"""

from __future__ import annotations

import math
import sys

import figures
import matplotlib
import numpy as np
from matplotlib.colors import LightSource, ListedColormap
from plotting import BLACK, BLUE, GREY, PAGE, RED, Sheet
from reading import NEEDS as TESTS
from reading import Load

from pgfmd.errors import InputError
from pgfmd.options.text import printable
from pgfmd.theory import persson

CAPTION = """Left: the rigid surface, lit from the side, and the pressure where it touches. Middle: the distribution of
contact pressures with Persson's prediction, which has no free parameter. Right: spectra of the stress and of the
contact, scaled so that they coincide where stress and contact are alike."""
NEEDS = ("load",)
PIXELS = 1024  # a larger field is thinned to about this many points per side


def draw(loads: list[Load]) -> Sheet:
    """Up to three panels of the last load."""
    first = loads[0].results.directory
    load = [load for load in loads if load.results.directory == first][-1]
    drawings = {"height": draw_surface, "histogram": draw_distribution, "spectra": draw_spectra}

    there = {need: function for need, function in drawings.items() if TESTS[need][0](load)}
    if not there:
        raise InputError(f"{load.folder}: nothing to draw: no field height, no observable histogram or spectra")
    sheet = Sheet(1, len(there), width=PAGE if len(there) > 1 else None, height=2.5)
    for panel, function in enumerate(there.values()):
        function(sheet, panel, load)
    sheet.notes += [f"not drawn: {load.folder} has no {TESTS[need][1]}" for need in drawings if need not in there]
    for name, value in {
        "mean pressure": load.mean_pressure, "contact area f_c": load.area,
        "contact area, corrected": load.corrected_area, "κ = f_c E' g/p̄": load.number("kappa"),
        "κ, corrected": load.number("kappa") * load.corrected_area / load.area if load.area else math.nan,
        "certified error": load.number("certified_error"), "transforms": load.number("transforms"),
        "seconds of the relaxation": load.number("seconds"),
    }.items():  # fmt: skip
        sheet.findings.add(name, value)
    return sheet


def thinned(load: Load, name: str) -> np.ndarray:
    """The field on every k-th point, read in row blocks: float array of at most about PIXELS × PIXELS."""
    step = max(1, max(load.results.shape) // PIXELS)
    return np.concatenate([values[-rows.start % step :: step, ::step] for rows, values in load.blocks(name)])


def draw_surface(sheet: Sheet, panel: int, load: Load):
    """The heights, lit from the side, with the contact on top; x to the right, y upwards."""
    axes, height = sheet.panels[panel], thinned(load, "height").T
    lx, ly = load.results.lengths
    light = LightSource(azdeg=135, altdeg=40)
    span = np.ptp(height) or 1.0
    shaded = 0.6 * (height - height.min()) / span + 0.4 * light.hillshade(height, vert_exag=60 / span)
    axes.imshow(shaded, cmap="gray", vmin=-0.1, vmax=1, origin="lower", extent=(0, lx, 0, ly))
    output = load.job.get("output", {})
    units = (output.get("length_unit", "length"), output.get("pressure_unit", "pressure"))
    unit, pressure_unit = (printable(str(unit), 20).replace("$", "?") for unit in units)
    name = "grid spacings" if unit == "length" and max(load.steps) == 1 else unit
    axes.set(xlabel=f"x / {name}", ylabel=f"y / {name}")
    if "pressure" not in load.fields:
        return
    pressure = thinned(load, "pressure").T
    contact = np.ma.masked_where(pressure <= 0, pressure)
    top = float(np.quantile(pressure[pressure > 0], 0.99)) if np.any(pressure > 0) else 1.0
    colours = ListedColormap(matplotlib.colormaps["inferno"](np.linspace(0.35, 1, 256)))  # bright against the grey
    image = axes.imshow(contact, cmap=colours, vmin=0, vmax=top, origin="lower", extent=(0, lx, 0, ly),
                        interpolation="nearest")  # fmt: skip
    if math.isfinite(load.area):
        axes.set_title(f"contact on {100 * load.area:.2g} % of the surface")
    label = "pressure" + (f" / {pressure_unit}" if pressure_unit != "pressure" else "")
    axes.figure.colorbar(image, ax=axes, label=label, shrink=0.85, extend="max")


def draw_distribution(sheet: Sheet, panel: int, load: Load):
    """P(σ) over the whole surface in units of the full-contact pressure, with Persson's prediction at the same load."""
    histogram, std = load.groups["pressure_histogram"], load.full_contact_std
    middle = (histogram["edges"][1:] + histogram["edges"][:-1]) / 2
    density = (load.area if load.area > 0 else 1.0) * histogram["density"] * std
    shown = density > 0
    if not np.any(shown) or not std > 0:
        return
    sheet.curve(panel, middle[shown] / std, density[shown], "simulation", color=BLUE, marker="o", ls="none", ms=2)
    sigma = np.linspace(0, middle[shown].max(), 400)[1:]
    theory = persson.pressure_density(sigma, load.mean_pressure, std) * std
    visible = theory > 0.3 * density[shown].min()
    if np.any(visible):
        sheet.curve(panel, sigma[visible] / std, theory[visible], "Persson", color=BLACK)
    sheet.label(panel, r"$\sigma\,/\,(E'\bar g/2)$", r"$P(\sigma)\;E'\bar g/2$", scale="semilogy")


def draw_spectra(sheet: Sheet, panel: int, load: Load):
    """Stress and contact spectra, normalised so that both tend to one curve where they are alike."""
    f, unit = load.area, load.q_unit
    partial = 0 < f < 1
    kinds = [("stress", load.mean_pressure**2, RED, "-")] + [("contact", f**2, BLUE, "--")] * partial
    for name, square, colour, dashes in kinds:
        q, value, _ = load.spectrum(name)
        scale = f / (1 - f) if partial else 1.0
        sheet.curve(panel, q / unit, scale * value / square, name, color=colour, ls=dashes)
    sheet.panels[panel].axvline(load.q_limits[1] / unit, color=GREY, lw=0.8, ls=":")
    quantity = r"$f_c\,|\tilde f(q)|^2\,/\,(1-f_c)\,|\tilde f(0)|^2$" if partial else r"$|\tilde\sigma|^2/\bar p^2$"
    sheet.label(panel, r"$q\,/\,q_l$", quantity, scale="log")


if __name__ == "__main__":
    sys.exit(figures.main(["overview", *sys.argv[1:]]))
