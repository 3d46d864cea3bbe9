"""Tables and pictures from DIR/runs.csv: cost to reach an error, ratios to the peers, run time against error."""

import math
from collections import defaultdict
from pathlib import Path

import csv_rows

from .pictures import draw, overview
from .recorder import LEVELS

OURS = "pgfmd"
HEAD = f"{'n':>5} {'H':>4} {'lambda_s':>8} {'f_c':>5}"
CASE = ("n", "hurst", "lambda_s", "area")


def asked(peer: str, n: int, lambda_s: float, area: float) -> float | None:
    """The ratio of times that is the project's goal, None if there is none."""
    if n not in (1024, 2048):
        return None
    if peer == "tamaas" or (peer == "ContactMechanics" and area < 0.9):
        return 30.0
    if peer == "ASPHER":
        return 2.0 if area >= 0.9 else 10.0 if lambda_s == 1 else 3.0 if lambda_s >= 16 else None
    return None


def load(folder: Path, clock: str = "seconds") -> dict[tuple, dict[tuple, list[dict]]]:
    """{case: {(method, setting, ranks, threads): points by tolerance and step, the fastest of the repeats}}.

    With clock = "cpu" the processor time stands for the seconds.
    """
    best: dict[tuple, dict] = {}
    for row in csv_rows.read(folder / "runs.csv"):
        if not row["seconds"]:
            continue
        case = (int(row["n"]), float(row["hurst"]), float(row["lambda_s"]), float(row["area"]))
        curve = (row["method"], row["setting"], int(row["ranks"]), int(row["threads"]))
        key = (case, curve, float(row["tolerance"]), int(row["point"]))
        numbers = "seconds cpu transforms pressure_error area_error mean_pressure certified_error energy_error"
        point = {name: float(row.get(name) or math.nan) for name in numbers.split()}
        point["seconds"] = point[clock]
        if key not in best or point["seconds"] < best[key]["seconds"]:
            best[key] = point
    cases: dict[tuple, dict[tuple, list[dict]]] = defaultdict(lambda: defaultdict(list))
    for (case, curve, *_), point in sorted(best.items(), key=lambda item: (item[0][0], -item[0][2], item[0][3])):
        cases[case][curve].append(point)
    return cases


def cost(points: list[dict], error: float, what: str = "seconds", between: bool = True) -> float:
    """Least cost at which the pressure error is reached; with `between` interpolated (logarithmically) between points.

    Peers' costs are interpolated, as their points are few, or they could stop anywhere; our own are not.
    """
    of = "pressure_error"
    least, before = math.inf, None
    for point in points:
        if point[of] <= error:
            found = point[what]
            if between and before and before[of] > error and before[what] < found:
                share = math.log(before[of] / error) / math.log(before[of] / max(point[of], 1e-300))
                found = before[what] + share * (found - before[what])
            least = min(least, found)
        before = point
    return least


def fastest(curves: dict[tuple, list[dict]], method: str, error: float):
    """(least seconds, setting) over all settings of a method, on one core."""
    found = [
        (cost(points, error, between=method != OURS), key[1])
        for key, points in curves.items()
        if key[0] == method and key[2:] == (1, 1)
    ]
    return min(found, default=(math.inf, ""))


def certified(curves: dict[tuple, list[dict]], method: str, error: float) -> tuple[float, float]:
    """Certified and true energy error of the pressure with which a method, on one core, passed a pressure error; NaN if
    it never did.
    """
    found = [
        (point["certified_error"], point["energy_error"])
        for key, points in curves.items()
        for point in points
        if key[0] == method and key[2:] == (1, 1) and point["pressure_error"] <= error and point["certified_error"] > 0
    ]
    return max(found, default=(math.nan, math.nan))


def report(folder: Path, clock: str = "seconds") -> None:
    """Print the tables, write them as CSV, and draw."""
    if not (folder / "runs.csv").exists():
        print("nothing measured yet")
        return
    cases = load(folder, clock)
    print((folder / "machine.txt").read_text().strip())
    ratios = list(_ratios(cases))
    csv_rows.write(folder / "ratios.csv", ratios, digits=5)
    _print_ratios(ratios)
    costs = list(_costs(cases))
    csv_rows.write(folder / "costs.csv", costs, digits=5)
    print("\nTransform equivalents (coarse grids included) and seconds of this solver")
    print(f"{HEAD} {'cores':>6} {'error':>6} {'transf.':>8} {'seconds':>8} {'speed-up':>8}")
    for row in costs:
        cores = f"{row['ranks']}r × {row['threads']}t"
        numbers = f"{row['transforms']:8.1f} {row['seconds']:8.3f} {row['speedup']:8.2f}"
        print(f"{_start(row)} {cores} {row['error']:6.0e} {numbers}")
    draw(folder, cases, clock)
    overview(folder, cases, clock)


def _ratios(cases):
    for case, curves in sorted(cases.items()):
        for error in LEVELS:
            ours, _ = fastest(curves, OURS, error)
            for peer in ("ASPHER", "tamaas", "ContactMechanics", "Polonsky-Keer", "GFMD"):
                if not any(key[0] == peer and key[2:] == (1, 1) for key in curves):
                    continue
                theirs, setting = fastest(curves, peer, error)
                lower = min(
                    max(point["seconds"] for point in points)
                    for key, points in curves.items()
                    if key[0] == peer and key[2:] == (1, 1)
                )
                row = dict(zip(CASE, case, strict=True)) | {"error": error, "peer": peer, "setting": setting}
                row |= {"ours": ours, "theirs": theirs, "ratio": theirs / ours, "at_least": lower / ours}
                row |= dict(zip(("certified", "true"), certified(curves, peer, error), strict=True))
                yield row | {"asked": asked(peer, case[0], case[2], case[3]) or ""}


def _print_ratios(ratios) -> None:
    print("\nTime in s to a relative pressure error, one core each; the peer at its best setting, its certified error")
    print(f"{HEAD} {'error':>6}  {'peer':17} {'ours':>8} {'theirs':>9} {'ratio':>7} {'certified':>9} {'asked':>6}")
    for row in ratios:
        reached = math.isfinite(row["theirs"])
        ratio = row["ratio"] if reached else row["at_least"]
        shown = f"{ratio:7.1f}" if reached else f">{ratio:6.1f}"
        verdict = "" if row["asked"] == "" else "yes" if ratio >= row["asked"] else "no" if reached else "?"
        theirs = f"{row['theirs']:9.3f}" if reached else "not there"
        numbers = f"{row['ours']:8.3f} {theirs} {shown} {row['certified']:9.1e} {row['asked']!s:>6} {verdict:3}"
        print(f"{_start(row)} {row['error']:6.0e}  {row['peer']:17} {numbers} {row['setting']}")


def _start(row: dict) -> str:
    return f"{row['n']:5d} {row['hurst']:4g} {row['lambda_s']:8g} {row['area']:5g}"


def _costs(cases):
    for case, curves in sorted(cases.items()):
        for error in LEVELS:
            alone, _ = fastest(curves, OURS, error)
            for key, points in sorted(curves.items()):
                if key[0] != OURS:
                    continue
                seconds = cost(points, error, between=False)
                row = dict(zip(CASE, case, strict=True)) | {"ranks": key[2], "threads": key[3], "error": error}
                row |= {"transforms": cost(points, error, "transforms", between=False), "seconds": seconds}
                yield row | {"speedup": alone / seconds if math.isfinite(seconds) else math.nan}
