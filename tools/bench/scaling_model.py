"""The model of `scaling.py`: seconds of a solve on many ranks, from parts that were measured on few."""

import math
import sys
from pathlib import Path
from typing import NamedTuple

import csv_rows
import numpy as np

from pgfmd.grid.grid_cost import holders

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "plots"))
from plotting import COLOURS, GREY, MARKERS, PAGE, plt  # noqa: E402


class Machine(NamedTuple):
    """cores: of a node; bandwidth: bytes per second of a node; latency: seconds of a message between nodes; step: of a
    message within a node; costs: seconds of a (reduction, exchange of halos) where that was measured for all ranks.
    """

    name: str
    cores: int
    bandwidth: float
    latency: float
    step: float
    costs: tuple[float, float] | None = None


# Two 64-core AMD EPYC 7763 per node, one 200 Gb/s HPE Slingshot-11 port, half of which an all-to-all of all nodes gets.
ASSUMED = Machine("LUMI-C, Slingshot-11", 128, 0.5 * 25e9, 2e-6, 0.5e-6)
SMALLEST = 256  # points per side from which on a grid has a mesh and blocks; smaller ones are taken together
COMPUTED = ("transforms", "contact", "other")
MESSAGES = ("reductions", "halos", "all-to-alls")
PHASES = ("transforms", "contact", "other", "coarse grids", "overhead", "all-to-alls", "latency")
LABELS = {"other": "other loops", "overhead": "per call, whatever the size", "latency": "reductions and halos"}
RANKS = [2**k for k in range(4, 15)]
STRONG, WEAK = (4096, 16384, 65536), 1024  # points per side; points per side of a rank
LARGEST = 131072
COUNTS = Path(__file__).parents[2] / "jobs/benchmark/counts.csv"  # of `benchmark.py counts`
CASES = {"method": "pgfmd", "lambda_s": "16", "tolerance": "1e-08", "ranks": "1"}  # of those that count


class Parts(NamedTuple):
    """What was measured here.

    costs[finest or coarser][phase]: seconds of a level, (whatever its size, per point); small: seconds of all levels
    smaller than `SMALLEST`; counts[level]: of a solve, by kind; bytes: sent per point of the grid; imbalance: contact
    of the fullest slab over the mean, by number of slabs; longer: time of a point in transforms of rows and columns of
    so many points, one rank's share of many, over that on one rank; growth: transforms of a solve of n × n points, over
    their mean on grids up to the largest that was solved here.
    """

    costs: tuple[dict[str, tuple[float, float]], dict[str, tuple[float, float]]]
    small: float
    counts: list[dict[str, float]]
    bytes: float
    imbalance: dict[int, float]
    longer: dict[int, float]
    growth: dict[int, float] = {1: 1.0}  # noqa: RUF012  (never changed)


def growth_of(largest: int) -> dict[int, float]:
    """The growth of transforms to 1e-8 with n, on one rank, from `COUNTS`: λ_s = 16a, all H, areas and seeds there."""
    rows = [row for row in csv_rows.read(COUNTS, needed=True) if row.items() >= CASES.items()]
    of = {n: [float(row["transforms"]) for row in rows if int(row["n"]) == n] for n in {int(row["n"]) for row in rows}}
    here = np.mean([count for n, counts in of.items() if n <= max(largest, min(of)) for count in counts])
    return {n: float(np.mean(counts) / here) for n, counts in of.items()}


def levels_of(n: int) -> list[int]:
    """Points per side of the grids that are treated one by one."""
    return [n >> level for level in range(max(1, int(math.log2(n / SMALLEST)) + 1))]


def parts_of(rows: list[dict]) -> Parts:
    """The parts, from runs of one rank on several grids, and of one on several ranks that sent messages."""
    one = [row for row in rows if row.get("solve") and row["ranks"] == 1 and row["threads"] == 1]
    sent = [row for row in rows if row.get("exchanged") and row["ranks"] > 1]
    masks = [row for row in rows if "imbalance" in row]
    if not one or not sent:
        raise SystemExit("scaling: needs runs of `measure` on one rank, and one with --exchanged on several")
    most = max(sent, key=lambda row: (row["n"], -abs(row["ranks"] - 4)))
    costs: tuple[dict, dict] = ({}, {})
    for phase in COMPUTED:
        watched = (phase, *MESSAGES) if phase == "other" else (phase,)  # one rank sends none, but calls them
        for which, line in enumerate(costs):
            line[phase] = _line([
                ((row["n"] >> level) ** 2, sum(row.get(f"seconds {level} {name}", 0.0) for name in watched))
                for row in one for level in range(len(levels_of(row["n"]))) if bool(level) == bool(which)
            ])  # fmt: skip
    small = [
        sum(row[name] for name in row if name.startswith("seconds ") and _level(name) >= len(levels_of(row["n"])))
        for row in one
    ]
    depth = 1 + max(_level(name) for name in most if name.startswith("count "))
    counts = [
        {kind: most.get(f"count {level} {kind}", 0) for kind in MESSAGES}
        for level in range(depth)
    ]
    largest = max(masks, key=lambda row: row["imbalance"])
    imbalance = {1: 1.0} | {int(name): value for name, value in largest.items() if name.isdigit()}
    pairs = {(row["emulated"], row["ranks"]): row["pair"] for row in rows if "emulated" in row}
    alone = [pair for (_, ranks), pair in pairs.items() if ranks == 1]
    longer = {SMALLEST: 1.0} | {n: max(1.0, pair / min(alone)) for (n, ranks), pair in pairs.items() if ranks > 1}
    sent_all = most["bytes"] * most["ranks"] / (most["ranks"] - 1)  # if all went to other ranks
    counts = [each for each in counts if any(each.values())]
    bytes_, growth = sent_all * most["ranks"] / most["n"] ** 2, growth_of(max(row["n"] for row in one))
    return Parts(costs, float(np.median(small)), counts, bytes_, imbalance, longer, growth)


def _level(name: str) -> int:
    return int(name.split()[1])


def _line(seen: list[tuple[float, float]]) -> tuple[float, float]:
    """a, b ≥ 0 of a + b x, with the least sum of squares of relative deviations."""
    x, y = np.array([pair for pair in seen if pair[1] > 0]).T
    weights = 1 / y
    a, b = np.linalg.lstsq(np.stack([weights, x * weights], axis=1), np.ones_like(x), rcond=None)[0]
    if a < 0:
        a, b = 0.0, float(np.sum(x / y) / np.sum((x / y) ** 2))
    if b < 0:
        a, b = float(np.sum(1 / y) / np.sum(1 / y**2)), 0.0
    return float(a), float(b)


def model(n: int, ranks: int, known: Parts, machine: Machine = ASSUMED) -> dict[str, float]:
    """Seconds of the phases of one solve (certified error 1e-6) of n × n points on `ranks` ranks.

    The levels follow one another, each on as many ranks as `holders` says.  A rank's points and its contact take the
    time that they took here on one rank, on the finest grid times the growth of transforms; the fullest slab is waited
    for.  Where a node has fewer cores than ranks, these take turns.  All-to-alls send one message to each other node
    and share its port; reductions take 2 log₂ P messages one after the other, halos two.
    """
    phases, growth = dict.fromkeys(PHASES, 0.0), _at(known.growth, n)
    nodes = -(-ranks // machine.cores) if machine.costs is None else 1
    for level, side in enumerate(levels_of(n)):
        count = ranks if level == 0 else holders((side, side), ranks)
        share = -(-side // count) * side
        turns = max(1.0, count / machine.cores) if nodes == 1 else 1.0
        for phase, (fixed, each) in known.costs[level > 0].items():
            most = _at(known.imbalance, count) if phase == "contact" else 1.0
            if phase == "transforms" and count > 1:
                most = _at(known.longer, side)
            # Ranks with less contact wait for the fullest slab, unless their core has other ranks to run.
            time = each * share * max(turns, most) * (1 if level else growth)
            phases["coarse grids" if level else phase] += time
            phases["overhead"] += fixed * turns
        counts = known.counts[min(level, len(known.counts) - 1)]
        if count == 1:
            continue
        if machine.costs is not None:
            phases["latency"] += sum(
                counts[kind] * cost for kind, cost in zip(("reductions", "halos"), machine.costs, strict=True)
            )
            phases["all-to-alls"] += counts["all-to-alls"] * machine.costs[0]
            continue
        here = min(count, nodes)
        wait = machine.latency if here > 1 else machine.step
        phases["latency"] += counts["reductions"] * 2 * (
            math.log2(here) * machine.latency + math.log2(min(count, machine.cores)) * machine.step
        ) + counts["halos"] * 2 * wait
        phases["all-to-alls"] += counts["all-to-alls"] * ((here - 1) * machine.latency + machine.step)
    phases["overhead"] += known.small
    if machine.costs is None:
        on_node = min(ranks, machine.cores)
        port = machine.bandwidth / on_node
        phases["all-to-alls"] += known.bytes * growth * n * n / ranks * (1 - on_node / ranks) / port
    return phases


def _at(known: dict[int, float], number: int) -> float:
    """What was measured for that number, or between two others; beyond them, the first or the last."""
    numbers = sorted(known)
    return float(np.interp(math.log2(number), np.log2(numbers), [known[each] for each in numbers]))


def draw(rows: list[dict], folder: Path) -> None:
    """The model and the runs, as CSV files, a picture, and text."""
    folder.mkdir(parents=True, exist_ok=True)
    checked = compare(rows)
    csv_rows.write(folder / "scaling-runs.csv", checked)
    for row in checked:
        print(f"{row['n']:6}² {row['ranks']:5} ranks here: {row['run']:.3g} s, model {row['model']:.3g} s; the busiest "
              f"computes {row['computed']:.3g} s, model {row['model computed']:.3g} s")  # fmt: skip
    draw_model(parts_of(rows), folder)


def draw_model(known: Parts, folder: Path) -> None:
    """The model of a solve on `ASSUMED`, and its constants, as CSV files, a picture, and words."""
    table = [_row(n, ranks, known) for n in (*STRONG, LARGEST) for ranks in RANKS if ranks <= n // 2]
    weak = [_row(round(WEAK * math.sqrt(ranks)), ranks, known) for ranks in RANKS[::2]]
    csv_rows.write(folder / "scaling-model.csv", table + [row | {"weak": 1} for row in weak if row["n"] <= LARGEST])
    csv_rows.write(folder / "scaling-parts.csv", _constants(known))
    figure, axes = plt.subplots(1, 3, figsize=(PAGE, 2.6))
    for dashes, n in zip(("-", "--", "-.", ":"), (*STRONG, LARGEST), strict=True):
        mine = [row for row in table if row["n"] == n]
        axes[0].loglog([row["ranks"] for row in mine], [row["total"] for row in mine], "k", ls=dashes, label=f"{n}²")
    axes[0].set(xlabel="ranks", ylabel="seconds per solve, modelled", title="total, by grid")
    for axis, mine, title in (
        (axes[1], [row for row in table if row["n"] == STRONG[2]], f"phases, {STRONG[2]}² points"),
        (axes[2], weak, f"phases, {WEAK}² points per rank"),
    ):
        ranks = [row["ranks"] for row in mine]
        for colour, marker, name in zip((*COLOURS[:-1], GREY), MARKERS, PHASES, strict=True):
            values = [max(row[name], 1e-6) for row in mine]
            axis.loglog(ranks, values, color=colour, marker=marker, ms=2.5, label=LABELS.get(name, name))
        axis.loglog(ranks, [row["total"] for row in mine], "k", lw=1.8, label="total")
        axis.set(xlabel="ranks", title=title, ylim=(1e-3, None))
    axes[0].legend()
    figure.suptitle(f"Model: parts measured on one machine; messages as assumed of {ASSUMED.name}", fontsize="medium")
    figure.legend(*axes[2].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    figure.savefig(folder / "scaling.png")
    for row in table + weak:
        worst = max(PHASES, key=row.__getitem__)
        print(f"{row['n']:6}² {row['ranks']:5} ranks: {row['total']:8.3g} s; {worst} {row[worst] / row['total']:.0%}")


def _row(n: int, ranks: int, known: Parts) -> dict:
    phases = model(n, ranks, known)
    return {"n": n, "ranks": ranks} | phases | {"total": sum(phases.values())}


def compare(rows: list[dict]) -> list[dict]:
    """Runs of several ranks on this machine beside the model of it, in which ranks take turns on its cores: seconds of
    the run, which other programs on the machine prolong, and processor seconds of what the busiest rank computed.
    """
    found, known = [], parts_of(rows)
    for row in rows:
        if not row.get("solve") or row["ranks"] == 1:
            continue
        costs = row["cost of reductions"], row["cost of halos"]
        here = Machine("this machine", row["cores"], math.inf, 0.0, 0.0, costs)
        phases = model(row["n"], row["ranks"], known, here)
        alone = model(row["n"], row["ranks"], known, here._replace(cores=row["ranks"]))
        computed = sum(value for name, value in alone.items() if name not in ("all-to-alls", "latency"))
        found.append({
            "n": row["n"], "ranks": row["ranks"], "exchanged": row["exchanged"], "run": row["solve"],
            "model": sum(phases.values()), "computed": row["computed"], "model computed": computed,
        })  # fmt: skip
    return found


def _constants(known: Parts) -> list[dict]:
    """Every constant of the model, and where it is from."""
    here, assumed, meant = "measured here", f"assumed: {ASSUMED.name}", "assumed: nothing is lost"
    emulated = "measured here: one rank's share, messages left out"
    table = []
    for name, costs in zip(("finest grid", "coarser grid"), known.costs, strict=True):
        for phase, (fixed, each) in costs.items():
            table.append({"constant": f"{phase}, {name}", "value": fixed, "unit": "s per solve", "from": here})
            table.append({"constant": f"{phase}, {name}", "value": each, "unit": "s per point", "from": here})
    table.append({"constant": f"grids below {SMALLEST}²", "value": known.small, "unit": "s", "from": here})
    table.append({"constant": "bytes in all-to-alls", "value": known.bytes, "unit": "per point", "from": here})
    for level, counts in enumerate(known.counts):
        table += [{"constant": f"{kind}, level {level}", "value": value, "unit": "per solve", "from": here}
                  for kind, value in counts.items()]  # fmt: skip
    table += [{"constant": f"contact of the fullest of {slabs} slabs", "value": value, "unit": "of the mean",
               "from": here if slabs > 1 else meant} for slabs, value in known.imbalance.items()]  # fmt: skip
    table += [{"constant": f"transforms of {n}² on many ranks", "value": value, "unit": "of one rank's, per point",
               "from": emulated if n != SMALLEST else meant} for n, value in known.longer.items()]  # fmt: skip
    table += [{"constant": f"transforms of a solve at {n}²", "value": value, "unit": "of those up to the largest here",
               "from": "jobs/benchmark/counts.csv"} for n, value in sorted(known.growth.items())]  # fmt: skip
    for name, what, unit in (
        ("cores", "cores", "per node"),
        ("bandwidth", "bandwidth of an all-to-all", "B/s per node"),
        ("latency", "message between nodes", "s"),
        ("step", "message within a node", "s"),
    ):
        table.append({"constant": what, "value": getattr(ASSUMED, name), "unit": unit, "from": assumed})
    return table
