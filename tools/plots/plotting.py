"""Style of all figures; figures that record their curves and numbers.  No MPI.

Figures have the width of a journal's column or page at their printed size: letters of 7 to 9 points.
"""

import csv
import json
import logging
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullFormatter
from scipy import stats

COLUMN, PAGE = 3.4, 7.0  # inches
ROW = 0.13  # inches that a row of the legend takes above the panels

# Okabe & Ito, Color Universal Design (2008), for colour-blind readers; the first three also differ in grey, the others
# by their markers.
BLACK, BLUE, ORANGE, GREEN, RED, PURPLE, SKY, GREY = (
    "#000000", "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#7F7F7F",
)  # fmt: skip
COLOURS = (BLUE, ORANGE, GREEN, RED, PURPLE, SKY, BLACK)
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
MOST = 7  # ensembles in one panel: as many as there are colours and markers

logging.getLogger("fontTools").setLevel(logging.ERROR)  # it remarks on the dates in the fonts

plt.rcParams.update({
    "font.size": 8,
    "axes.labelsize": 8.5,
    "axes.titlesize": 8,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "legend.fontsize": 7,
    "legend.frameon": False,
    "legend.handlelength": 1.8,
    "legend.columnspacing": 1.0,
    "legend.labelspacing": 0.25,
    "figure.constrained_layout.use": True,
    "axes.linewidth": 0.6,
    "axes.formatter.use_mathtext": True,
    "lines.linewidth": 1.1,
    "lines.markersize": 3.2,
    "lines.markeredgewidth": 0.7,
    "xtick.direction": "in",
    "ytick.direction": "in",
    "xtick.top": True,
    "ytick.right": True,
    "savefig.dpi": 300,
    "pdf.fonttype": 42,
})  # fmt: skip


def style(number: int, *, filled: bool = True) -> dict:
    """Colour and marker of the n-th ensemble; open symbols where not `filled`."""
    colour = COLOURS[number % len(COLOURS)]
    return {"color": colour, "marker": MARKERS[number % len(MARKERS)], "mfc": colour if filled else "white"}


def tex(text: str) -> str:
    """A label for a figure: symbols in italics."""
    for plain, math_text in SYMBOLS.items():
        text = text.replace(plain, math_text)
    return text


SYMBOLS = {
    "f_c = ": "$f_c$ = ", "H = ": "$H$ = ", "ζ = ": r"$\zeta$ = ", "λ_s = ": r"$\lambda_s$ = ", "n = ": "$n$ = ",
    "λ_l = ": r"$\lambda_l$ = ", "λ_r = ": r"$\lambda_r$ = ", "p̄ = ": r"$\bar p$ = ", "ḡ = ": r"$\bar g$ = ",
    "d/L = ": "$d/L$ = ", "σ_Y = ": r"$\sigma_Y$ = ", "E' = ": "$E'$ = ",
}  # fmt: skip


def _fixed(value: float, error: float) -> str:
    """The value to the second digit of the error."""
    return f"{value:.{max(0, 1 - math.floor(math.log10(error)))}f}"


@dataclass(frozen=True)
class Finding:
    """A number with its two errors: the standard error over seeds, and the spread over defensible choices.

    count : seeds;  values : the number of each of them;  others : the number by each other choice
    """

    value: float
    seeds: float | None = None
    choices: float | None = None
    count: int = 1
    values: tuple[float, ...] = ()
    others: tuple[float, ...] = ()

    @property
    def error(self) -> float | None:
        """Both errors together; None if neither is known."""
        known = [error for error in (self.seeds, self.choices) if error is not None]
        return math.hypot(*known) if known else None

    @property
    def uncertainty(self) -> float | None:
        """Half of the 95 % interval: Student's t for the seeds; without several, the spread over choices; or None."""
        if self.seeds is None:
            return self.choices
        return self.seeds * float(stats.t.ppf(0.975, self.count - 1) if self.count > 1 else stats.norm.ppf(0.975))

    def text(self) -> str:
        """value ± error over seeds ± spread over choices: errors with two digits, the value to the second digit of the
        larger one.  Errors of the size of rounding are left out.
        """
        named = {"": self.seeds, " (choices)": self.choices}
        errors = {name: error for name, error in named.items() if error and error > 1e-9 * max(abs(self.value), 1e-3)}
        if not errors:
            return f"{self.value:.4g}"
        shown = _fixed(self.value, max(errors.values()))
        return shown + "".join(f" ± {_fixed(error, error)}{name}" for name, error in errors.items())


class Findings(dict):
    """Numbers that a figure yields: name → Finding."""

    def add(self, name: str, values, choices: Iterable | None = None):
        """The mean of `values` (one number or several, of seeds) with its standard error.

        choices : the same number, or numbers of which the mean is taken, by each other defensible fit range or
        estimator; the largest deviation from the mean is the spread.  Numbers that are not finite are left out; nothing
        is added if none is finite.
        """
        values = np.atleast_1d(np.asarray(values, float))
        values = values[np.isfinite(values)]
        if values.size:
            mean = float(values.mean())
            seeds = float(values.std(ddof=1) / math.sqrt(values.size)) if values.size > 1 else None
            means = [] if choices is None else [float(np.mean(choice)) for choice in choices]
            others = [other for other in means if math.isfinite(other)]
            spread = max((abs(other - mean) for other in others), default=None)
            self[name] = Finding(mean, seeds, spread, int(values.size), tuple(values.tolist()), tuple(others))

    def text(self, name: str) -> str:
        """The number with its errors."""
        return self[name].text()


class Sheet:
    """A figure whose curves are drawn and recorded together, so that its CSV holds what the picture shows.

    findings : the numbers it yields;  notes : what a reader must know, one line each;  extra_files : see `save`
    """

    def __init__(self, rows: int = 1, columns: int = 1, *, width: float | None = None, height: float = 2.6):
        width = width or (COLUMN if columns == 1 else PAGE)
        self.figure, axes = plt.subplots(rows, columns, figsize=(width, height * rows), squeeze=False)
        self.panels = list(axes.flat)
        self.findings, self.notes = Findings(), []
        self.extra_files: list[Callable[[Path], Path]] = []  # each writes one into the folder of the figure
        self._legend_rows = 0
        self._titles: list[list[str]] = [[] for _ in self.panels]  # of the legends, in the order of drawing
        self._table: list[tuple] = []
        self._tables: dict[str, tuple[Sequence[str], list[tuple]]] = {}
        if len(self.panels) > 1:
            for number, panel in enumerate(self.panels):
                panel.annotate(f"({chr(97 + number)})", (0, 1), xytext=(-24, 4), xycoords="axes fraction",
                               textcoords="offset points")  # fmt: skip

    def curve(self, panel: int, x, y, name: str | None = None, error=None, label: bool | str = True, **style):
        """Draw and record one curve; `name` is its title in the CSV and, with `label`, its entry in the legend, which
        may be another text.

        A curve without a finite point has no entry; a bar that would reach down to zero has no lower half.  Errors that
        are not known are NaN.
        """
        axes = self.panels[panel]
        x, y = np.atleast_1d(x), np.atleast_1d(y)
        errors = np.broadcast_to(np.nan if error is None else error, x.shape)
        entry = label if isinstance(label, str) else name
        shown = tex(entry) if label and entry and np.any(np.isfinite(x) & np.isfinite(y)) else None
        self._titles[panel] += [shown] * bool(shown)
        if np.isnan(errors).all():
            axes.plot(x, y, label=shown, **style)
        else:
            lower = np.where((y > 0) & (errors > 0.9 * y), 0.0, errors)  # a logarithmic axis has no zero
            axes.errorbar(x, y, [lower, errors], label=shown, capsize=1.5, elinewidth=0.6, capthick=0.6, **style)
        self._table += [(panel + 1, name, *row) for row in zip(x, y, errors, strict=True)]

    def keep(self, table: str, columns: Sequence[str], *rows: Sequence):
        """Rows of a table that is saved beside the figure as NAME_TABLE.csv: what the numbers are computed from."""
        self._tables.setdefault(table, (columns, []))[1].extend(tuple(row) for row in rows)

    def label(
        self, panel: int, x: str, y: str, *, scale: str = "linear", columns: int = 2, legend: bool | str = True
    ) -> None:
        """Axis labels, and the scale of both axes: "linear", "log", "semilogx" or "semilogy"; the legend above, in at
        most that many columns.

        legend : "figure" puts the legend of this panel above all panels
        """
        axes = self.panels[panel]
        axes.set(xlabel=x, ylabel=y)
        if scale in ("log", "semilogx"):
            axes.set_xscale("log")
        if scale in ("log", "semilogy"):
            axes.set_yscale("log")
        titles = [*self._titles[panel], *axes.get_legend_handles_labels()[1]]
        # Matplotlib puts curves with error bars last.
        entries = sorted(zip(*axes.get_legend_handles_labels(), strict=True), key=lambda entry: titles.index(entry[1]))
        if legend and entries:
            handles, labels = zip(*entries, strict=True)
            columns = 1 if max(map(len, labels)) > 44 and legend != "figure" else columns
            rows = -(-len(labels) // columns)
            columns = -(-len(labels) // rows)
            if legend == "figure":
                self.figure.legend(handles, labels, loc="outside upper center", ncols=columns)
            else:
                axes.legend(handles, labels, loc="lower left", bbox_to_anchor=(0, 1), ncols=columns, borderaxespad=0.3)
            self._legend_rows = max(self._legend_rows, rows)

    def drop(self, panel: int, why: str = ""):
        """Leave a panel out; why: for the notes."""
        self.panels[panel].remove()
        self.notes += [f"no panel ({chr(97 + panel)}): {why}"] * bool(why)

    def save(self, output: Path, name: str) -> list[Path]:
        """Write NAME.png, .pdf, .csv (curves), .json (numbers), NAME_TABLE.csv and `extra_files`; their paths."""
        output.mkdir(parents=True, exist_ok=True)
        for axis in (axis for axes in self.panels if axes.figure for axis in (axes.xaxis, axes.yaxis)):
            _label_short_decades(axis)
        width, height = self.figure.get_size_inches()
        self.figure.set_size_inches(width, height + ROW * self._legend_rows)
        paths = [output / f"{name}.{kind}" for kind in ("png", "pdf", "csv", "json")]
        self.figure.savefig(paths[0])
        self.figure.savefig(paths[1], metadata={"CreationDate": None})
        plt.close(self.figure)
        heads = [f"# panel {number}: x = {axes.get_xlabel()}; y = {axes.get_ylabel()}\n"
                 for number, axes in enumerate(self.panels, 1)]  # fmt: skip
        _write_csv(paths[2], ("panel", "curve", "x", "y", "error"), self._table, heads)
        numbers = {key: vars(found) for key, found in self.findings.items()}
        text = json.dumps({"numbers": numbers, "notes": self.notes}, indent=1, ensure_ascii=False)
        paths[3].write_text(text + "\n", encoding="utf-8")
        for table, (columns, rows) in self._tables.items():
            paths.append(output / f"{name}_{table}.csv")
            _write_csv(paths[-1], columns, rows)
        return paths + [write(output) for write in self.extra_files]


def _write_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence], heads: Iterable[str] = ()):
    with open(path, "w", newline="", encoding="utf-8") as file:
        file.writelines(heads)
        table = csv.writer(file, lineterminator="\n")
        table.writerow(columns)
        table.writerows([_cell(value) for value in row] for row in rows)


def _cell(value) -> str:
    """A value in a CSV: ten digits, nothing for NaN."""
    if isinstance(value, float | np.floating):
        return "" if math.isnan(value) else f"{value:.10g}"
    return "" if value is None else str(value)


def limited(ensembles: Sequence, sheet: Sheet) -> Sequence:
    """The first MOST ensembles, with a note if there are more."""
    if len(ensembles) > MOST:
        sheet.notes.append(f"{len(ensembles)} settings were given; the first {MOST} are drawn: give fewer folders, "
                           "or choose loads with --targets")  # fmt: skip
    return ensembles[:MOST]


def standard_error(values) -> np.ndarray:
    """Standard error of the mean over samples (samples, …): (…); NaN for a single sample."""
    values = np.asarray(values, float)
    if len(values) == 1:
        return np.full(values.shape[1:], np.nan)
    return values.std(axis=0, ddof=1) / math.sqrt(len(values))


def guide(axes, x, y0: float, exponent: float, text: str, *, above: bool = False, **style):
    """A power law y0 (x/x[0])^exponent as a guide to the eye, with its name above or below its middle."""
    x = np.asarray(x, float)
    y = y0 * (x / x[0]) ** exponent
    axes.plot(x, y, **({"color": GREY, "lw": 0.9, "ls": "--"} | style))
    middle = np.sqrt(x[0] * x[-1]), np.sqrt(y[0] * y[-1])
    place = {"xytext": (-6, 6) if above else (6, -11), "textcoords": "offset points", "ha": "center"}
    axes.annotate(text, middle, color="0.35", fontsize=7, **place)


def _label_short_decades(axis):
    """On a logarithmic axis of less than two decades label 1 and 3; in less than 1.3 decades 1, 2 and 5; in less than
    .8 of a decade 1, 2, 3, 4, 6 and 8, in less than half a decade 1 to 9.  Ticks at given places stay.
    """
    low, high = sorted(axis.get_view_interval())
    if axis.get_scale() == "log" and high < 100 * low and not isinstance(axis.get_major_locator(), FixedLocator):
        span, ladder = high / low, ((20, (1, 3)), (6.3, (1, 2, 5)), (3, (1, 2, 3, 4, 6, 8)), (1, range(1, 10)))
        digits = next(subs for least, subs in ladder if span > least)
        axis.set_major_locator(LogLocator(subs=digits))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())
