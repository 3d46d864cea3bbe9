"""Style of all figures, and figures that record what they draw; shared by the tools, no MPI.

A tool has `make(folders, output) -> Findings`, which draws one question's figure, and `main`, its command line.
"""

from __future__ import annotations

import argparse
import csv
import json
import logging
import math
import sys
from collections.abc import Callable
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from pgfmd.errors import InputError

# Okabe & Ito, Color Universal Design (2008): told apart by colour-blind readers, and in grey by line style and marker.
BLACK, BLUE, ORANGE, GREEN, RED, PURPLE, SKY, GREY = (
    "#000000", "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#7F7F7F",
)  # fmt: skip
COLOURS = (BLUE, RED, GREEN, ORANGE, PURPLE, SKY, BLACK)
MARKERS = ("o", "s", "^", "D", "v", "P", "X")

logging.getLogger("fontTools").setLevel(logging.ERROR)  # it remarks on the dates in the fonts

plt.rcParams.update({
    "font.size": 9,
    "axes.titlesize": 9,
    "legend.fontsize": 7.5,
    "legend.frameon": False,
    "figure.constrained_layout.use": True,
    "axes.linewidth": 0.7,
    "axes.grid": True,
    "axes.grid.which": "major",
    "grid.color": "0.9",
    "grid.linewidth": 0.5,
    "axes.axisbelow": True,
    "lines.linewidth": 1.2,
    "lines.markersize": 3.5,
    "xtick.direction": "in",
    "ytick.direction": "in",
    "savefig.dpi": 160,
    "pdf.fonttype": 42,
})  # fmt: skip


class Findings(dict):
    """Numbers that a figure comes to, name → (value, standard error or None); saved beside the figure as JSON."""

    def add(self, name: str, values, note: str | None = None):
        """The mean of `values` (one number or several, e.g. seeds) with its standard error."""
        values = np.atleast_1d(np.asarray(values, float))
        values = values[np.isfinite(values)]
        if values.size:
            error = float(values.std(ddof=1) / math.sqrt(values.size)) if values.size > 1 else None
            self[name] = (float(values.mean()), error)

    def text(self, name: str) -> str:
        """value ± error, with as many digits as the error warrants."""
        value, error = self[name]
        if not error:
            return f"{value:.4g}"
        digits = max(0, 1 - math.floor(math.log10(error)))
        return f"{value:.{digits}f} ± {error:.{digits}f}" if digits < 8 else f"{value:.3g} ± {error:.1g}"


class Sheet:
    """A figure whose curves are drawn and recorded together, so that its CSV holds what the picture shows."""

    def __init__(self, rows: int = 1, columns: int = 1, size: tuple[float, float] | None = None):
        size = size or (3.3 * columns + 0.9, 3.1 * rows + 0.2)
        self.figure, axes = plt.subplots(rows, columns, figsize=size, squeeze=False)
        self.panels = list(axes.flat)
        self._table = []

    def curve(self, panel: int, x, y, name: str | None = None, error=None, label: bool = True, **style):
        """Draw and record one curve; `name` is its row title in the CSV and, with `label`, its entry in the legend."""
        axes = self.panels[panel]
        x, y = np.atleast_1d(x), np.atleast_1d(y)
        shown = name if label else None
        if error is None:
            axes.plot(x, y, label=shown, **style)
        else:
            axes.errorbar(x, y, error, label=shown, capsize=2, elinewidth=0.8, **style)
        errors = np.full(len(x), np.nan) if error is None else np.broadcast_to(error, x.shape)
        self._table += [(panel + 1, name, *row) for row in zip(x, y, errors, strict=True)]

    def label(self, panel: int, x: str, y: str, title: str | None = None, scale: str = "linear", legend=True):
        """Axis labels, and the scale of both axes: "linear", "log", "semilogx" or "semilogy"."""
        axes = self.panels[panel]
        axes.set(xlabel=x, ylabel=y)
        if title:
            axes.set_title(title)
        if scale in ("log", "semilogx"):
            axes.set_xscale("log")
        if scale in ("log", "semilogy"):
            axes.set_yscale("log")
        if legend and axes.get_legend_handles_labels()[0]:
            axes.legend(**({"loc": legend} if isinstance(legend, str) else {}))

    def save(self, output: Path, name: str) -> list[Path]:
        """Write NAME.png, NAME.pdf and NAME.csv; their paths."""
        output.mkdir(parents=True, exist_ok=True)
        for axis in (axis for axes in self.panels for axis in (axes.xaxis, axes.yaxis)):
            _label_short_decades(axis)
        paths = [output / f"{name}.{kind}" for kind in ("png", "pdf", "csv")]
        self.figure.savefig(paths[0])
        self.figure.savefig(paths[1], metadata={"CreationDate": None})
        plt.close(self.figure)
        with open(paths[2], "w", newline="", encoding="utf-8") as file:
            for number, axes in enumerate(self.panels, 1):
                file.write(f"# panel {number}: x = {axes.get_xlabel()}; y = {axes.get_ylabel()}\n")
            table = csv.writer(file, lineterminator="\n")
            table.writerow(["panel", "curve", "x", "y", "error"])
            for panel, curve, *numbers in self._table:
                table.writerow([panel, curve, *("" if math.isnan(v) else f"{v:.6g}" for v in map(float, numbers))])
        return paths


def guide(axes, x, y0: float, exponent: float, text: str, **style):
    """A power law y0 (x/x[0])^exponent as a guide to the eye, with its name beside it."""
    x = np.asarray(x, float)
    y = y0 * (x / x[0]) ** exponent
    axes.plot(x, y, **({"color": GREY, "lw": 0.9, "ls": "--"} | style))
    third = x[0] ** (2 / 3) * x[-1] ** (1 / 3), y[0] ** (2 / 3) * y[-1] ** (1 / 3)
    side = {"xytext": (-3, 4), "ha": "right"} if y[-1] > y[0] else {"xytext": (5, 3)}
    axes.annotate(text, third, textcoords="offset points", color="0.35", fontsize=7.5, **side)


def _label_short_decades(axis):
    """On a logarithmic axis of less than two decades label 1, 2 and 5 (or, in less than half a decade, 1 to 9)."""
    low, high = sorted(axis.get_view_interval())
    if axis.get_scale() == "log" and high < 100 * low:
        axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high > 3 * low else range(1, 10)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())


def fit_power_law(x, *curves) -> tuple[float, list[float]]:
    """The exponent that serves all curves (positive, same x) jointly, free prefactors; and ln of each prefactor.

    Least squares in ln y against ln x: every point counts alike.
    """
    logarithm = np.log(x)
    centred = logarithm - logarithm.mean()
    values = np.log(np.asarray(curves))
    exponent = float(np.sum(centred * values) / (len(curves) * np.sum(centred**2)))
    return exponent, list(values.mean(axis=1) - exponent * logarithm.mean())


def finish(sheet: Sheet, output: Path, name: str, findings: Findings) -> Findings:
    """Save the figure, its table and its numbers; returns the numbers."""
    sheet.save(output, name)
    (output / f"{name}.json").write_text(json.dumps(findings, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    return findings


def command_line(make: Callable[..., Findings], description: str, arguments=None, extend=None) -> int:
    """The command line of a tool: `make(folders, output, **options)`; prints what it found.  Exit code 0, or 2.

    extend : function(parser) that adds options, which `make` receives by their names
    """
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", nargs="+", type=Path, metavar="DIR", help="result folders")
    parser.add_argument(
        "--output",
        type=Path,
        metavar="DIR",
        help="folder of the pictures (default: figures/ in the first result folder)",
    )
    if extend:
        extend(parser)
    options = vars(parser.parse_args(arguments))
    folders, output = options.pop("results"), options.pop("output")
    output = output or folders[0] / "figures"
    try:
        findings = make(folders, output, **options)
    except InputError as error:
        print(f"{Path(sys.argv[0]).name}: error: {error}", file=sys.stderr)
        return 2
    width = max(map(len, findings), default=0)
    for name in findings:
        print(f"{name:<{width}}  {findings.text(name)}")
    print(f"pictures and tables: {output}")
    return 0
