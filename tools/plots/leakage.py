"""Leakage: flow factors against load, and the flow through the gap of the last load."""

import numpy as np
from contact_stiffness import column, means
from maps import show_field, thinned
from matplotlib.colors import LogNorm
from plotting import BLACK, RED, Sheet, limited, style
from reading import Load
from samples import ensembles

from pgfmd.errors import InputError

CAPTION = """(a) Pressure flow factor, the conductivity of the gap over the cube of the mean gap, along x (full symbols)
and along y (open). Bars: standard error over seeds; of one seed, the error that its run estimated. (b) Flux
in the gap of the last load, on a logarithmic scale. About equal parts of it flow between neighbouring lines. Circle:
the critical constriction. White: no flow, in contact or in gap that no path through the cell reaches."""
NEEDS = ("load", "roughness", "leakage")
LINES = 16  # streamlines
COARSE = 256  # points each way of the flux that lines follow
DIM = 1e-4  # part of the largest flux below which all is drawn alike


def draw(loads: list[Load]) -> Sheet:
    """Flow factors of all settings, and streamlines of the last load whose fluxes were kept."""
    sheet = Sheet(1, 2)
    for number, group in enumerate(limited(ensembles(loads, by_load=False), sheet)):
        for axis, filled in (("x", True), ("y", False)):
            rows = sorted(means(column(group, f"flow_factor_{axis}")))
            if closed := sum(not row[1] > 0 for row in rows):
                sheet.notes.append(f"{group.name}: no flow along {axis} at {closed} of {len(rows)} loads")
            if open_ := [row for row in rows if row[1] > 0]:
                x, value, error, _ = np.array(open_).T
                name = f"{group.label + ', ' if group.label else ''}along {axis}"
                sheet.curve(0, x, value, name, error=error, ls="none", **style(number, filled=filled))
                sheet.findings.add(f"flow factor at the lowest load, {name}", value[0])
    if not sheet.panels[0].has_data():
        raise InputError("leakage: nothing to draw: no path through the gap percolates at any load")
    sheet.label(0, r"$\bar p\,/\,(E'\bar g)$", r"flow factor $K/\bar u^3$", scale="log", columns=2)
    kept = [load for load in loads if {"flux_x", "flux_y"} <= load.fields]
    flowing = [load for load in kept if load.number("flow_factor_x") > 0]
    if flowing:
        draw_stream(sheet, 1, flowing[-1])
    else:
        lacking = 'give output.fields "flux_x" and "flux_y" of a flow along x'
        sheet.drop(1, "nothing flows along x" if kept else lacking)
    return sheet


def draw_stream(sheet: Sheet, panel: int, load: Load) -> None:
    """The size of the flux, and lines along it, which begin in the row where it is spread most widely."""
    flux = np.array([thinned(load, name) for name in ("flux_x", "flux_y")], float)
    size = np.hypot(*flux)
    shown = np.ma.masked_where(size == 0, size / size.max())
    show_field(sheet, panel, load, shown, "flux over the largest", cmap="viridis", norm=LogNorm(DIM, 1.0))
    axes, lengths = sheet.panels[panel], load.results.lengths
    for axis in (1, 2):  # means over blocks
        side = -(-flux.shape[axis] // COARSE)
        flux = np.add.reduceat(flux, np.arange(0, flux.shape[axis], side), axis) / side
    spread = np.maximum(flux[0], 0.0)
    row = int(np.argmax(spread.sum(axis=1) ** 2 / np.maximum((spread**2).sum(axis=1), 1e-300)))
    passed = np.cumsum(spread[row]) / spread[row].sum()
    columns = np.searchsorted(passed, (np.arange(LINES) + 0.5) / LINES)
    # nine copies of the cell, so that lines go on beyond its borders
    x, y = (
        (np.arange(3 * count) + 0.5) * length / count - length
        for count, length in zip(flux.shape[1:], lengths, strict=True)
    )
    starts = np.meshgrid(x[row :: len(x) // 3], np.add.outer(y[:: len(y) // 3], y[columns] - y[0]).ravel())
    copies = np.transpose(starts).reshape(-1, 2)
    axes.streamplot(x, y, *np.tile(flux, (1, 3, 3)).transpose(0, 2, 1), start_points=copies, color=BLACK,
                    linewidth=0.4, arrowsize=0.4, broken_streamlines=False)  # fmt: skip
    axes.set(xlim=(0, lengths[0]), ylim=(0, lengths[1]))
    if place := constriction(load):
        axes.plot(*place, "o", mec=RED, mfc="none", ms=9, mew=1.2)


def constriction(load: Load, axis: str = "x") -> tuple[float, float] | None:
    """Where the critical constriction is; None if no path percolates, or the run did not look for it."""
    if "percolation" not in load.kept:
        return None
    row, column = (float(load.groups["percolation"][f"constriction_{axis}_{place}"]) for place in ("row", "column"))
    ax, ay = load.spacings
    return ((row + 0.5) * ax, (column + 0.5) * ay) if row >= 0 else None
