"""Percolation: the critical constriction of the gap against the contact area, and where it is in the last load."""

import numpy as np
from leakage import constriction
from maps import show_field, thinned
from matplotlib.colors import ListedColormap
from plotting import RED, SKY, Sheet, limited, style
from reading import Load
from samples import ensembles

from pgfmd.errors import InputError

CAPTION = """(a) The least gap on the widest path through the gap, over the mean gap, against the corrected contact
area; full symbols: paths along x, open: along y. (b) The last load: contact (grey), gap at least as wide as the
critical constriction (blue), narrower gap (white). Circle: the constriction along x; square: along y."""
NEEDS = ("percolation", "area")


def draw(loads: list[Load]) -> Sheet:
    """Constrictions of all settings; the widest path of the last load whose gap was kept."""
    sheet = Sheet(1, 2)
    for number, group in enumerate(limited(ensembles(loads, by_load=False), sheet)):
        for axis, filled in (("x", True), ("y", False)):
            columns = "contact_area_corrected", f"constriction_{axis}", "mean_gap"
            x, value, gap = np.array([[load.number(name) for name in columns] for load in group]).T
            name = f"{group.label + ', ' if group.label else ''}along {axis}"
            if np.any(value > 0):
                ratio = np.where(value > 0, value, np.nan) / gap
                sheet.curve(0, x, ratio, name, ls="none", **style(number, filled=filled))
            if np.any(value <= 0):
                sheet.findings.add(f"least contact area without a path {name}", x[value <= 0].min())
    if not sheet.panels[0].has_data():
        raise InputError("percolation: nothing to draw: no path through the gap percolates at any load")
    sheet.label(0, "contact area $f_c$", r"constriction $/\,\bar u$", scale="semilogy", columns=2)
    shown = [load for load in loads if "gap" in load.fields]
    if shown:
        draw_path(sheet, 1, shown[-1])
    else:
        sheet.drop(1, 'no field "gap" was kept')
    return sheet


def draw_path(sheet: Sheet, panel: int, load: Load) -> None:
    """Contact, narrow gap and wide gap of a load, and its constrictions."""
    gap = thinned(load, "gap")
    widths = [load.number(f"constriction_{axis}") for axis in "xy"]
    critical = min((width for width in widths if width > 0), default=np.inf)
    kinds = np.where(gap <= 0, 0, np.where(gap < critical * (1 - 1e-6), 1, 2))  # fields may have single precision
    show_field(sheet, panel, load, kinds, cmap=ListedColormap(["0.6", "white", SKY]), vmin=0, vmax=2)
    for axis, marker in (("x", "o"), ("y", "s")):
        if place := constriction(load, axis):
            sheet.panels[panel].plot(*place, marker, mec=RED, mfc="none", ms=9, mew=1.2)
