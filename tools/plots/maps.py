"""Fields in a panel: thinned, with axes and a bar of colours.  No MPI."""

from collections.abc import Iterable

import numpy as np
from matplotlib.patches import Rectangle
from plotting import RED, Sheet
from reading import Load

PIXELS = 1024  # a larger field is thinned to about this many points per side


def thinned(load: Load, name: str) -> np.ndarray:
    """The field on every k-th point, read in row blocks: float array of at most about PIXELS × PIXELS."""
    return thinned_blocks(load, load.results.blocks(name, None if name == "height" else load.index))


def thinned_blocks(load: Load, blocks: Iterable[tuple[slice, np.ndarray]]) -> np.ndarray:
    """The same of a field in row blocks."""
    step = max(1, max(load.results.shape) // PIXELS)
    parts = [values[-rows.start % step :: step, ::step].copy() for rows, values in blocks]  # a view keeps its block
    return np.concatenate(parts)


def unit_text(load: Load, name: str) -> str:
    """The unit of "length" or "pressure" as text in a figure, in which $ would begin a formula."""
    return load.unit(name).replace("$", "?")


def show_field(sheet: Sheet, panel: int, load: Load, values: np.ndarray, label: str | None = None, **style):
    """A field in a panel, x to the right and y upwards, with a bar of its colours if it has a label."""
    axes, (lx, ly), unit = sheet.panels[panel], load.results.lengths, unit_text(load, "length")
    image = axes.imshow(values.T, origin="lower", extent=(0, lx, 0, ly), interpolation="nearest", **style)
    axes.set(xlabel=f"x / {unit or 'length'}", ylabel=f"y / {unit or 'length'}")
    axes.locator_params(nbins=4)
    axes.ticklabel_format(scilimits=(-2, 5))
    if load.open:
        axes.add_patch(Rectangle((0, 0), lx, ly, fill=False, ec=RED, lw=1.2))
        axes.set(xlim=(-0.04 * lx, 1.04 * lx), ylim=(-0.04 * ly, 1.04 * ly))
    if label is not None:
        bar = axes.figure.colorbar(image, ax=axes, label=label, orientation="horizontal", pad=0.02, shrink=0.9)
        bar.ax.tick_params(which="both", top=False)
        if style.get("norm") is None:
            bar.ax.locator_params(nbins=4)  # numbers of four digits would touch
