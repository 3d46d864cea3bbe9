"""Discretisation errors of contacts, and the quality of their error bars, on new surfaces.

    python tools/bench/error_bars.py held FILE.csv [--seed 1] [--count 200] [--bars]
    python tools/bench/error_bars.py area FILE.csv [--seed 1] [--across 32] [--finest 128] [--places 1] [--only H AREA]

held: errors and bars of contacts drawn at random: λ_s from 1 to 64 pixels, 128² to 512² points, tolerances 1e-4 …
1e-8, half-spaces and slabs; against the same heights interpolated onto eight times the points each way and solved to
1e-10.  Rows that are in FILE.csv are not computed again; with --bars only their contacts and bars are, not the finer
grids.  Prints for each number the share of bars that hold, and the median of bar over error.

area: the contact area of four surfaces for each Hurst exponent and load, raw and inside the contact line, from λ_s = 4a
to finest · a; rows that are in FILE.csv are not computed again.  With --places k, areas are means over k × k
translations of the grid by multiples of a/k.  Prints the mean errors against the limit of the raw areas, and its
standard error.

The limit is c₀ of c₀ + c₁ a + c₂ a², fitted by least squares to λ_s = 16a and finer grids.  Pixels along an edge are
counted with a random error ∝ a^(3/2) (Kendall 1948, doi:10.1093/qmath/os-19.1.1, for ovals placed at random), and k × k
places count like one grid of spacing a/k; the weights follow.  An exact fit to λ_s = 32a, 64a, 128a has 2.4 times the
random error of 64a.
"""

import argparse
import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import csv_rows
import numpy as np
from scipy.ndimage import fourier_shift
from scipy.special import erfinv

import pgfmd
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables.contact import Contact
from pgfmd.observables.rough_surface import RoughSurface
from pgfmd.parallel.mpi import ALONE
from pgfmd.physics.laws.hard import HardWall
from pgfmd.physics.problem import ContactProblem
from pgfmd.physics.solids.homogeneous import Homogeneous
from pgfmd.solvers.active_set.contact_from_coarse import solve_hard_wall
from pgfmd.solvers.controls import ContactArea
from pgfmd.solvers.options import Load
from pgfmd.surfaces.self_affine import self_affine

TOLERANCE = 1e-11  # at 1e-7 the areas of the finest grids are .3 % off
NUMBERS = ("contact_area_corrected", "contact_perimeter", "mean_gap", "elastic_energy", "mean_square_pressure")


@dataclass(frozen=True)
class Case:
    """A surface under a load, in a cell of side 1.  place: translation of the surface, in pixels."""

    hurst: float
    load: float
    seed: int
    across: int  # λ_s to a side of the cell
    place: tuple[float, float] = (0.0, 0.0)


def solved(case: Case, points: int) -> dict[str, float]:
    """The numbers of one contact on a grid of λ_s = points·a."""
    n, across = points * case.across, case.across
    grid = SlabGrid(ALONE, (n, n), (1.0, 1.0))
    heights = self_affine(grid, case.hurst, 1 / across, 1.0, case.seed)
    if any(case.place):
        heights = np.ascontiguousarray(np.fft.ifft2(fourier_shift(np.fft.fft2(heights), case.place)).real)
    problem = ContactProblem(grid, heights, Homogeneous(contact_modulus=1.0), HardWall(), case.load)
    surface = RoughSurface(problem, [], 2 * math.pi * across)
    return Contact.of(surface, solve_hard_wall(problem, TOLERANCE)).numbers


def cases() -> Iterator[tuple[float, float, float]]:
    """Hurst exponent, approximate contact area, and the load for it."""
    for hurst in (0.3, 0.5, 0.8):
        for area in (0.02, 0.08, 0.3, 0.6):
            yield hurst, area, float(erfinv(0.85 * area)) / math.sqrt(2) if area > 0.1 else area / 2.1


FINER, TIGHT = 8, 1e-10  # grid and tolerance of what `held` compares with
DRAWN = "number n lambda_s hurst area tolerance base thickness poisson".split()
MEASURED = "line roughness pixels edges pressure_error".split()


def held(path: Path, seed: int, count: int, anew: bool) -> None:
    """Computes missing rows of the table, and prints how good the bars are.

    seed: of all draws; contact k of one seed is the same whatever the count.  anew: bars of the other rows too
    """
    columns = [*DRAWN, *MEASURED, *(f"{name}{what}" for name in NUMBERS for what in ("", "_error", "_true"))]
    known = {int(row["number"]): row for row in csv_rows.read(path)}
    target = path.with_suffix(".part") if anew else path
    if anew:
        target.unlink(missing_ok=True)
    for number in sorted({*range(count), *known}):
        if anew or number not in known:
            csv_rows.append(target, columns, [_drawn(seed, number, known.get(number))], digits=8)
    target.replace(path)
    rows = [row for row in csv_rows.read(path) if int(row["number"]) < count]
    kinds = {
        "all": rows,
        "line": [row for row in rows if float(row["line"])],
        "staircase": [row for row in rows if not float(row["line"])],
        "half-space": [row for row in rows if not row["base"]],
        "slab < 1 pixel": [row for row in rows if float(row["thickness"]) < 1],
        "slab ≥ 1 pixel": [row for row in rows if row["base"] and float(row["thickness"]) >= 1],
        "tolerance > 1e-6": [row for row in rows if float(row["tolerance"]) > 1e-6],
        "λ_s < 3 pixels": [row for row in rows if float(row["lambda_s"]) < 3],
        "λ_s > 16 pixels": [row for row in rows if float(row["lambda_s"]) > 16],
    }
    print("number                  contacts          cases   nan  held  bar/error (median)")
    for name in NUMBERS:
        for kind, some in kinds.items() if name == NUMBERS[0] else [("all", rows)]:
            found = ([float(row[name + what]) for row in some] for what in ("", "_error", "_true"))
            value, bar, true = map(np.array, found)
            known = np.isfinite(bar)
            error, bar = np.abs(value - true)[known], bar[known]
            ratio = np.median(bar / np.maximum(error, 1e-300))
            share = np.mean(error <= bar)
            print(f"{name:23s} {kind:17s} {len(some):5d} {np.sum(~known):5d} {share:5.3f}  {ratio:8.2f}")


def _drawn(seed: int, number: int, known: dict[str, str] | None) -> dict[str, float | str]:
    """A row of the table: one contact, its bars, and its numbers on a finer grid, those of a known row if there is one.
    """
    rng = np.random.default_rng([seed, number])

    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(math.log(low), math.log(high))))

    n, lambda_s = int(rng.choice([128, 256, 512], p=[0.6, 0.3, 0.1])), between(1, 64)
    hurst, area, tolerance = float(rng.uniform(0.3, 0.9)), between(0.01, 0.7), between(1e-8, 1e-4)
    base = str(rng.choice(["", "bonded", "sliding"], p=[0.5, 0.25, 0.25]))
    thickness = between(0.02, 64) if base else math.inf
    poisson = float(rng.uniform(0.0, 0.45))
    grid = SlabGrid(ALONE, (n, n))
    heights = self_affine(grid, hurst, lambda_s, 0.1, int(rng.integers(2**31)))
    solid = Homogeneous(contact_modulus=1.0, thickness=thickness, base=base or "bonded", poisson=poisson)
    control = ContactArea(ContactProblem(grid, heights, solid, HardWall()), Load(contact_area=(area,)))
    load = math.exp(control.guess(area))
    options = {"thickness": thickness, "base": base or None, "poisson": poisson}
    contact = pgfmd.solve(heights, load, tolerance=tolerance, **options)
    bars = contact.observables("discretisation")["discretisation"]
    found = contact.area
    row: dict[str, float | str] = dict(zip(DRAWN + MEASURED, (
        number, n, lambda_s, hurst, area, tolerance, base, thickness, poisson, contact.numbers["contact_line"],
        contact.surface.roughness, found.pixels, found.edges, contact.pressure_error,
    ), strict=True))  # fmt: skip
    numbers = _numbers(contact)
    true = known and {name: float(known[f"{name}_true"]) for name in NUMBERS}
    true = true or _numbers(pgfmd.solve(heights, load, tolerance=TIGHT, refine=FINER, **options))
    for name in NUMBERS:
        row |= {name: numbers[name], f"{name}_error": float(bars[f"{name}_error"]), f"{name}_true": true[name]}
    return row


def _numbers(contact: Contact) -> dict[str, float]:
    return contact.numbers | {"mean_square_pressure": float(np.mean(contact.pressure**2))}


COLUMNS = "hurst area seed across points places contact_area contact_area_corrected".split()
FIRST = 16  # λ_s/a of the coarsest grid of the fit, which has three grids at least
Rows = dict[tuple[float, ...], tuple[float, float]]  # (raw, inside the line) by the other columns


def area(path: Path, first: Case, finest: int, places: int, only: tuple[float, float] | None) -> None:
    """Computes missing rows of the table, prints the mean errors of its areas.  first: its seed and `across` count."""
    grids = [4 << power for power in range(int(math.log2(finest)) - 1)]
    rows, seeds = _rows(path), range(first.seed, first.seed + 4)
    chosen = [(hurst, aim, load) for hurst, aim, load in cases() if only in (None, (hurst, aim))]
    for hurst, aim, load in chosen:
        for seed in seeds:
            for points in grids:
                if (hurst, aim, seed, first.across, points, places) not in rows:
                    areas = _areas(replace(first, hurst=hurst, load=load, seed=seed), points, places)
                    row = (hurst, aim, seed, first.across, points, places, *areas)
                    csv_rows.append(path, COLUMNS, [dict(zip(COLUMNS, row, strict=True))], digits=10)
    rows = _rows(path)
    print("  H   area   " + "".join(f"{f'raw {points}a':>10s}" for points in grids)
          + "".join(f"{f'line {points}a':>10s}" for points in grids) + "   limit ±   (per cent)")  # fmt: skip
    for hurst, aim, _ in chosen:
        errors: list[np.ndarray] = []
        for seed in seeds:
            key = (hurst, aim, seed, first.across)
            found = np.array([rows[*key, points, 1] for points in grids])
            errors.append(found.T.ravel() / _limit(rows, key) - 1)
        mean, spread = 100 * np.mean(errors, axis=0), 100 * np.std(errors, axis=0, ddof=1)[-1] / math.sqrt(len(seeds))
        print(f"{hurst:4.1f}  {aim:5.2f}  " + "".join(f"{value:10.3f}" for value in (*mean, spread)))


def _areas(case: Case, points: int, places: int) -> np.ndarray:
    """Raw area and that inside the line, means over `places` × `places` places of the grid."""
    steps = np.arange(places) / places
    found = [solved(replace(case, place=(float(i), float(j))), points) for i in steps for j in steps]
    return np.mean([[row[name] for name in COLUMNS[6:]] for row in found], axis=0)


def limit(path: Path, key: tuple[float, ...]) -> float:
    """The limit of the contact area of one surface (H, area, seed, across) of a table."""
    return _limit(_rows(path), key)


def _limit(rows: Rows, key: tuple[float, ...]) -> float:
    """c₀ of one surface; of each grid, the row with the most places."""
    best = {row[4]: max(other[5] for other in rows if other[:5] == row[:5]) for row in rows if row[:4] == key}
    points = np.array([at for at in sorted(best) if at >= min(FIRST, sorted(best)[-3])])
    raw = np.array([rows[*key, at, best[at]][0] for at in points])
    weight = np.array([at * best[at] for at in points]) ** 1.5
    return float(np.linalg.lstsq(weight[:, None] * points[:, None] ** -np.arange(3.0), weight * raw)[0][0])


def _rows(path: Path) -> Rows:
    table = [tuple(float(row[name]) for name in COLUMNS) for row in csv_rows.read(path)]
    return {row[:6]: (row[6], row[7]) for row in table}


def main(arguments: list[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="what", required=True)
    command = commands.add_parser("held")
    command.add_argument("path", type=Path, metavar="FILE.csv")
    command.add_argument("--seed", type=int, default=1, help="of all draws")
    command.add_argument("--count", type=int, default=200, help="contacts")
    command.add_argument("--bars", action="store_true", help="of all contacts anew, not their finer grids")
    command = commands.add_parser("area")
    command.add_argument("path", type=Path, metavar="FILE.csv")
    command.add_argument("--places", type=int, default=1, help="of the grid, each way, that areas are means of")
    command.add_argument("--only", type=float, nargs=2, metavar=("H", "AREA"), help="of these cases")
    command.add_argument("--seed", type=int, default=1, help="of the first surface")
    command.add_argument("--across", type=int, default=32, help="λ_s to a side of the cell")
    command.add_argument("--finest", type=int, default=128, help="λ_s/a of the finest grid")
    options = parser.parse_args(arguments)
    if options.what == "held":
        held(options.path, options.seed, options.count, options.bars)
    else:
        first = Case(math.nan, math.nan, options.seed, options.across)
        area(options.path, first, options.finest, options.places, options.only and tuple(options.only))
    return 0


if __name__ == "__main__":
    sys.exit(main())
