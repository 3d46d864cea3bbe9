"""Partial slip: how much of the contact sticks at each load, and the traction of the last load."""

import numpy as np
from contact_stiffness import column, means
from maps import show_field, thinned
from plotting import Sheet, limited, style
from reading import Load
from samples import ensembles

CAPTION = """(a) The part of the contact that sticks under the tangential load. Bars: standard error over seeds. (b) The
tangential traction over its limit μp: 1 where the bodies slip."""
NEEDS = ("load", "roughness", "partial slip")


def draw(loads: list[Load]) -> Sheet:
    """The part that sticks in all settings; the traction of the last load that kept it."""
    sheet = Sheet(1, 2)
    for number, group in enumerate(limited(ensembles(loads, by_load=False), sheet)):
        touching = {load.target: load.area for load in group if load.area > 0}
        parts = ((key, x, value / touching[key], error) for key, x, value, error in column(group, "stick_area")
                 if key in touching)  # fmt: skip
        x, value, error, _ = np.array(sorted(means(parts))).T
        sheet.curve(0, x, value, group.name, error=error, label=bool(group.label), ls="none", **style(number))
        sheet.findings.add(f"part that sticks at the lowest load, {group.name}", value[0])
    sheet.label(0, r"$\bar p\,/\,(E'\bar g)$", "part that sticks", scale="semilogx", columns=2)
    sheet.panels[0].set_ylim(0, 1)
    shown = [load for load in loads if {"traction", "pressure"} <= load.fields and load.area > 0]
    if shown:
        traction, pressure = (thinned(shown[-1], name) for name in ("traction", "pressure"))
        limit = float(shown[-1].job["output"]["partial_slip"]["friction"]) * np.ma.masked_where(pressure <= 0, pressure)
        show_field(sheet, 1, shown[-1], traction / limit, r"$\tau\,/\,(\mu p)$", cmap="viridis", vmin=0, vmax=1)
    else:
        sheet.drop(1, 'give output.fields "traction" and "pressure"')
    return sheet
