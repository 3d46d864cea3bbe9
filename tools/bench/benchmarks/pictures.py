"""Run time against error, drawn."""

from pathlib import Path

import csv_rows

from .case import Case

# Okabe and Ito's colours, which colour-blind readers can distinguish; markers differ as well.
STYLES = {
    "pgfmd": ("#D55E00", "o"),
    "ASPHER": ("#0072B2", "s"),
    "tamaas": ("#009E73", "^"),
    "ContactMechanics": ("#CC79A7", "v"),
    "Polonsky-Keer": ("#56B4E9", "D"),
    "GFMD": ("#E69F00", "P"),
}
TIMES = {"seconds": "wall time in s", "cpu": "processor time in s"}  # by the clock of the report
LINES = {(1, 1): ("-", ""), (1, 2): ("--", ", 2 threads")}
NAMES = {
    "pgfmd": "pgfmd (this project)",
    "GFMD": "pgfmd's GFMD dynamics",
    "Polonsky-Keer": "Polonsky–Keer on pgfmd's FFT",
}


def draw(folder: Path, cases: dict, clock: str) -> None:
    """One picture per case, `DIR/<case>.png`: pressure and area error against seconds and against transforms."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    for case, curves in cases.items():
        figure, axes = plt.subplots(2, 2, figsize=(9, 7), sharey="row", constrained_layout=True)
        for row, error in enumerate(("pressure_error", "area_error")):
            for column, cost in enumerate(("seconds", "transforms")):
                panel(axes[row, column], curves, cost, error)
        axes[0, 0].set_ylabel("relative error of pressure, 2-norm")
        axes[1, 0].set_ylabel("relative error of contact area")
        axes[1, 0].set_xlabel(TIMES[clock])
        axes[1, 1].set_xlabel("transform pairs (double precision, finest grid)")
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=8)
        figure.suptitle(_title(case))
        figure.savefig(folder / f"{Case(*case).name}.png", dpi=130)
        plt.close(figure)


def overview(folder: Path, cases: dict, clock: str) -> None:
    """`DIR/benchmark.png`, for the README: a smooth and a rough surface, each on the largest grid that most methods
    were run on, and resolution.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    measured = [case for case, curves in cases.items() if case[3] == 0.08 and any(key[0] == "tamaas" for key in curves)]

    def methods_and_size(case: tuple):
        return len({key[0] for key in cases[case]}), case

    smooth = max((case for case in measured if case[2] == 16), key=methods_and_size, default=None)
    rough = max((case for case in measured if case[2] == 1), key=methods_and_size, default=None)
    panels = [(case, cost) for case, cost in ((smooth, "seconds"), (rough, "seconds"), (smooth, "transforms")) if case]
    table = folder / "resolution.csv"
    if not panels:
        return
    count = len(panels) + table.exists()
    figure, axes = plt.subplots(2, 2, figsize=(9.5, 7.5), constrained_layout=True)
    for at, (case, cost) in zip(axes.flat, panels, strict=False):
        panel(at, cases[case], cost, "pressure_error")
        at.set_ylim(1e-7, 1)
        at.set_ylabel("relative error of pressure, 2-norm")
        at.set_xlabel(TIMES[clock] if cost == "seconds" else "transform pairs (double precision, finest grid)")
        at.set_title(_title(case), fontsize=9)
    if table.exists():
        _resolution(axes.flat[len(panels)], table)
    for at in list(axes.flat)[count:]:
        at.remove()
    shown = {}
    for at in axes.flat[: len(panels)]:
        lines, labels = at.get_legend_handles_labels()
        shown |= dict(zip(labels, lines, strict=True))
    figure.legend(shown.values(), shown.keys(), loc="outside lower center", ncols=4, fontsize=8)
    figure.savefig(folder / "benchmark.png", dpi=130)
    plt.close(figure)


def _title(case: tuple) -> str:
    n, hurst, lambda_s, area = case
    length = "a" if lambda_s == 1 else f"{lambda_s:g}a"
    return f"{n}² points, H = {hurst:g}, $\\lambda_s$ = {length}, contact area {area:g}"


def _resolution(axes, table: Path) -> None:
    *rows, limit = [{key: float(value) for key, value in row.items()} for row in csv_rows.read(table)]
    shown = {
        "area_raw": ("contact area, raw", "#D55E00", "o", "area_corrected"),
        "area_corrected": ("contact area, corrected", "#0072B2", "s", "area_corrected"),
        "second_moment": ("⟨p²⟩", "#CC79A7", "v", "second_moment"),
        "mean_gap": ("mean gap", "#009E73", "^", "mean_gap"),
    }
    for name, (label, colour, marker, right) in shown.items():
        x = [row["points_per_lambda_s"] for row in rows]
        y = [abs(row[name] / limit[right] - 1) for row in rows]
        axes.plot(x, y, color=colour, marker=marker, markersize=4, linewidth=1.2, label=label)
    axes.set_xscale("log", base=2)
    axes.set_yscale("log")
    axes.set_xticks([row["points_per_lambda_s"] for row in rows], [f"{row['points_per_lambda_s']:.0f}" for row in rows])
    axes.grid(True, alpha=0.3)
    axes.legend(fontsize=8)
    axes.set_xlabel("grid points per shortest wavelength")
    axes.set_ylabel("relative discretisation error")
    axes.set_title("one surface on ever finer grids", fontsize=9)


def panel(axes, curves: dict, cost: str, error: str) -> None:
    """Each method's curves: solid on one core, dashed on two threads, dotted on two ranks.

    Of complete runs, all settings of a method together, those are drawn that no other beats in both cost and error.
    """
    seen = set()
    for key, points in sorted(curves.items()):
        method, _, ranks, threads = key
        if method not in STYLES or (cost == "transforms" and (ranks, threads) != (1, 1)):
            continue
        if (method, ranks, threads) in seen:
            continue
        if method in ("ASPHER", "pgfmd"):
            alike = [ps for k, ps in curves.items() if k[0] == method and k[2:] == (ranks, threads)]
            points = _hull([p for ps in alike for p in ps], cost, error)
        seen.add((method, ranks, threads))
        points = [p for p in points if p[error] > 0]
        colour, marker = STYLES[method]
        line, cores = LINES.get((ranks, threads), (":", f", {ranks} ranks"))
        label = NAMES.get(method, method) + cores
        x, y, every = [p[cost] for p in points], [p[error] for p in points], max(1, len(points) // 15)
        axes.plot(x, y, color=colour, ls=line, lw=1.2, marker=marker, ms=4, markevery=every,
                  label=label if cost == "seconds" else None)  # fmt: skip
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.xaxis.set_minor_formatter("")
    axes.grid(True, alpha=0.3)


def _hull(points: list[dict], cost: str, error: str) -> list[dict]:
    """Of many settings, the points that no other beats in both cost and error."""
    best, kept = float("inf"), []
    for point in sorted(points, key=lambda p: (p[cost], p[error])):
        if point[error] < best:
            kept.append(point)
            best = point[error]
    return kept
