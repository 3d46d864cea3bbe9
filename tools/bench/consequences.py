#!/usr/bin/env python3
"""Counts, bounds and errors of the observables that follow from a contact: stiffness, percolation, leakage, slip.

    .venv/bin/python tools/bench/consequences.py OUTPUT.csv [PART …]

Parts: stiffness, enclosed, percolation, closing, exponent, leakage, exact; all if none is named; peer, which
needs reynoldsflow.  One line per number: part, case, name, value.  Run on one thread; times are CPU time.
"""

import argparse
import csv
import math
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

import pgfmd
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables.network import flow_of, flow_through, slab_graph
from pgfmd.observables.percolation import bottlenecks
from pgfmd.parallel.mpi import world
from pgfmd.physics.laws.hard import HardWall
from pgfmd.physics.problem import ContactProblem
from pgfmd.physics.solids.homogeneous import Homogeneous
from pgfmd.solvers.fixed_contact import increment

Row = tuple[str, str, float]


def rough(n: int, shortest: float, hurst: float, seed: int = 1, least: float = 2.0) -> np.ndarray:
    """Self-affine heights (n, n) of rms slope 1, waves from n/least down to `shortest` points."""
    q = np.hypot(np.fft.fftfreq(n)[:, None], np.fft.rfftfreq(n))
    size = np.where((q >= least / n) & (q <= 1 / shortest), np.maximum(q, 1 / n) ** (-1 - hurst), 0)
    heights = np.fft.irfft2(size * np.exp(2j * np.pi * np.random.default_rng(seed).random(q.shape)), s=(n, n))
    return heights / np.std(np.diff(heights, axis=0))


def stiffness() -> Iterator[Row]:
    """Transform pairs to a width."""
    for n in (256, 1024, 2048, 4096):
        for shortest in (16.0, 2.0):
            heights = rough(n, shortest, 0.8)
            for load in (0.003, 0.03, 0.1, 0.3, 0.8, 1.6) if n < 4096 else (0.003, 0.1, 0.8):
                began = time.process_time()
                contact = pgfmd.solve(heights, load)
                seconds, area = time.process_time() - began, np.mean(contact.pressure > 0)
                for width in (1e-3, 1e-6):
                    began = time.process_time()
                    found = increment(contact.problem, contact.pressure, width)
                    case = f"n={n} lambda_s={shortest:g} f_c={area:.3f} width={width:g}"
                    yield case, "pairs", found.transforms
                    yield case, "width", found.upper / found.lower - 1
                    yield case, "time over contact", (time.process_time() - began) / seconds


def enclosed() -> Iterator[Row]:
    """How many of 500 small cases the bounds do not enclose; 1e-10 for the rounding of the direct solutions."""
    rng, comm, misses = np.random.default_rng(0), world(), 0
    for _ in range(500):
        nx, ny = (int(n) for n in rng.integers(4, 17, 2))
        pressure = rng.exponential(size=(nx, ny)) * (rng.random((nx, ny)) < rng.uniform(0.05, 0.95))
        pressure[0, 0] = 1
        q = 2 * np.pi * np.hypot(np.fft.fftfreq(nx)[:, None], np.fft.fftfreq(ny))
        kernel = np.fft.ifft2(np.divide(2, q, out=np.zeros_like(q), where=q > 0)).real
        i, j = np.nonzero(pressure)
        matrix = np.ones((len(i) + 1, len(i) + 1))
        matrix[:-1, :-1], matrix[-1, -1] = kernel[(i[:, None] - i) % nx, (j[:, None] - j) % ny], 0
        exact = -1 / np.linalg.solve(matrix, np.r_[np.zeros(len(i)), nx * ny])[-1]
        grid = SlabGrid(comm, (nx, ny))
        problem = ContactProblem(grid, np.zeros((nx, ny)), Homogeneous(contact_modulus=1.0), HardWall(), 1.0)
        found = increment(problem, pressure, 10.0 ** -rng.integers(1, 8))
        misses += len(i) < nx * ny and not found.lower * (1 - 1e-10) <= exact <= found.upper * (1 + 1e-10)
    yield "stiffness, 500 small cases", "not enclosed", misses
    misses = 0
    for _ in range(500):
        shape, axis = tuple(int(n) for n in rng.integers(4, 30, 2)), int(rng.integers(2))
        down, right = np.exp(rng.normal(size=(2, *shape)) * rng.uniform(0, 2))
        grid = SlabGrid(comm, shape)
        found = flow_of(grid, slab_graph(grid, down, right), axis, 10.0 ** -rng.integers(1, 9))
        number = np.arange(math.prod(shape)).reshape(shape)
        ends = [(number.ravel(), np.roll(number, -1, way).ravel()) for way in (0, 1)]
        across = [np.broadcast_to((np.arange(shape[way]) == shape[way] - 1).reshape((-1, 1) if way == 0 else (1, -1)),
                                  shape).ravel() * (way == axis) for way in (0, 1)]  # fmt: skip
        i, j = (np.concatenate([pair[side] for pair in ends]) for side in (0, 1))
        weight, jump = np.r_[down.ravel(), right.ravel()], np.concatenate(across).astype(float)
        place = np.arange(len(i))
        step = sparse.csc_array((np.r_[-np.ones(len(i)), np.ones(len(i))], (np.r_[place, place], np.r_[i, j])))
        matrix = sparse.csc_array(step.T @ (weight[:, None] * step.toarray()))
        u = np.r_[0.0, splu(matrix[1:, 1:]).solve(-(step.T @ (weight * jump))[1:])]
        exact = float(np.sum(weight * (step @ u + jump) ** 2))
        misses += not found.lower * (1 - 1e-10) <= exact <= found.upper * (1 + 1e-10)
    yield "leakage, 500 small networks", "not enclosed", misses


def percolation() -> Iterator[Row]:
    """Labellings of the exact constriction."""
    for n in (512, 1024, 2048, 4096):
        heights = rough(n, 16.0, 0.8) if n < 4096 else None
        # at 4096² a surface stands for the gap: what counts is the number of values
        gap = rough(n, 16.0, 0.8) + 3 if heights is None else pgfmd.solve(heights, 0.1).gap
        mask = gap > 0
        began = time.process_time()
        found = bottlenecks(SlabGrid(world(), (n, n)), gap, mask)
        yield f"n={n}", "labellings, both axes", found[0].labellings
        yield f"n={n}", "seconds", time.process_time() - began


def closing() -> Iterator[Row]:
    """Areas at which the gap ceases to percolate along both axes, and along x, by the longest wave; λ_s = 8a."""
    for n, least in ((2048, 8.0), (2048, 2.0)):
        areas = []
        for seed in range(16):
            heights, seen = rough(n, 8.0, 0.8, 100 + seed, least), dict[float, tuple[bool, bool, float, float]]()
            for along in ((0, 1), (0,)):
                low, high = 0.1, 0.6
                for _ in range(9):
                    load = (low + high) / 2
                    if load not in seen:
                        contact = pgfmd.solve(heights, load)
                        found = contact.observables("percolation")["loads"]
                        flags = (bool(found[f"gap_percolates_{axis}"]) for axis in "xy")
                        seen[load] = *flags, contact.contact_area, contact.contact_area_corrected  # type: ignore[assignment]
                    is_open = any(seen[load][axis] for axis in along)
                    low, high = (load, high) if is_open else (low, load)
                areas.append(seen[load][2:])
                case = f"{n}², longest wave L/{least:g}, seed={100 + seed}, {'both axes' if len(along) > 1 else 'x'}"
                yield case, "closing area, raw", areas[-1][0]
                yield case, "closing area, corrected", areas[-1][1]
        for place, along in enumerate(("both axes", "x")):
            for name, values in zip(("raw", "corrected"), np.array(areas[place::2]).T, strict=True):
                case = f"{n}², lambda_s=8, longest wave L/{least:g}, 16 surfaces, {along}"
                yield case, f"closing area, {name}", values.mean()
                yield case, f"its spread, {name}", values.std(ddof=1)


NEAR = np.geomspace(0.2, 0.02, 6)  # 1 − p̄/p̄_c of the fit, fixed before the first run; p̄_c to 1e-4 of itself


def exponent() -> Iterator[Row]:
    """d ln(flow)/d ln(1 − p̄/p̄_c) near closure, along the axis that closes last: fits over `NEAR` of 8 surfaces (H = .8,
    longest wave L/2), λ_s = 32a at 512² and, for the error by the grid, the same with half the points.

    Result: the mean at 512²; its error: the spread over √8, and the change of the mean from 256² to 512², added.
    """
    means = []
    for n in (256, 512):
        slopes = []
        for seed in range(8):
            q = np.r_[0:128, -128:0]
            modes = np.fft.fft2(rough(256, 16.0, 0.8, 200 + seed)) * (n / 256) ** 2
            whole = np.zeros((n, n), complex)
            whole[np.ix_(q, q)] = modes
            heights = np.fft.ifft2(whole).real
            closed = pgfmd.solve(heights, percolation="gap", percolation_accuracy=1e-4, spacing=256 / n)
            critical = sum(closed.details[f"closing_pressure_{end}"] for end in ("lower", "upper")) / 2
            flows = []
            for share in NEAR:
                contact = pgfmd.solve(heights, (1 - share) * critical, spacing=256 / n, tolerance=1e-11)
                found = contact.observables(leakage={"width": 1e-4})["loads"]
                flows.append([float(found[f"leakage_{axis}"]) for axis in "xy"])
            logs = np.log([flow[int(np.argmax(flows[-1]))] for flow in flows])
            slopes.append([np.polyfit(np.log(NEAR), logs, 1)[0], *np.diff(logs) / np.diff(np.log(NEAR))])
            yield f"{n}², seed={200 + seed}", "exponent", slopes[-1][0]
        means.append(np.mean(slopes, axis=0))
        for share, local in zip(np.sqrt(NEAR[1:] * NEAR[:-1]), means[-1][1:], strict=True):
            yield f"{n}², 1 - p/p_c = {share:.3f}", "local exponent, mean", local
        yield f"{n}²", "exponent, mean", means[-1][0]
        yield f"{n}²", "its spread", np.std([each[0] for each in slopes], ddof=1)
    error = np.std([each[0] for each in slopes], ddof=1) / 8**0.5 + abs(means[1][0] - means[0][0])
    yield "512²", "its error", error


def leakage() -> Iterator[Row]:
    """Iterations to a width, and time and memory over those of the contact."""
    grids = {n: SlabGrid(world(), (n, n)) for n in (512, 1024, 2048)}
    for n, seeds in ((512, 3), (1024, 1), (2048, 1)):
        for shortest, hurst, loads in (
            (8.0, 0.8, (0.02, 0.1, 0.2, 0.25, 0.3)),
            (8.0, 0.3, (0.02, 0.1, 0.2, 0.25)),
            (2.0, 0.3, (0.02, 0.1, 0.15, 0.2)),
        ):
            for seed in range(1, seeds + 1):
                heights = rough(n, shortest, hurst, seed)
                for load in loads if n < 2048 else loads[1:4:2]:
                    began = time.process_time()
                    contact = pgfmd.solve(heights, load)
                    seconds, area = time.process_time() - began, np.mean(contact.pressure > 0)
                    for width in (1e-3, 1e-6, 1e-8) if n < 2048 else (1e-3,):
                        began = time.process_time()
                        found = flow_through(grids[n], contact.gap, contact.pressure <= 0, 0, width)
                        case = f"n={n} lambda_s={shortest:g} H={hurst} seed={seed} f_c={area:.3f} width={width:g}"
                        if found.upper > 0:
                            yield case, "iterations", found.iterations
                            yield case, "width", 1 - found.lower / found.upper
                            yield case, "time over contact", (time.process_time() - began) / seconds


def peer() -> Iterator[Row]:
    """The same flow by reynoldsflow 0.1.3, which has the same faces: relative difference, CPU time over ours."""
    from reynoldsflow import transport

    for n, close in ((64, 1e-12), (512, 1e-12), (1024, 1e-10), (2048, 1e-9)):  # the first compiles
        for load in (0.1, 0.2):
            contact, grid = pgfmd.solve(rough(n, 8.0, 0.8), load), SlabGrid(world(), (n, n))
            mask = contact.pressure <= 0
            gap = np.where(mask, contact.gap, 0.0)
            began = time.process_time()
            found = flow_through(grid, gap, mask, 0, 1e-8)
            if found.upper == 0:  # no path, where the other returns None
                continue
            ours, began = time.process_time() - began, time.process_time()
            filtered, _, flux = transport.solve_fluid_problem(gap, rtol=close, boundary_mode="periodic")
            other = transport.compute_total_flux(filtered, flux, n, boundary_mode="periodic")[0]
            yield f"n={n} load={load}", "difference", float(other) / found.upper - 1
            yield f"n={n} load={load}", "time over ours", (time.process_time() - began) / ours


def exact() -> Iterator[Row]:
    """Cattaneo and Mindlin at a = 48 pixels; Hertz's von Mises stress."""
    n, a = 1024, 48.0
    x = np.arange(n) - n / 2 - 0.3
    radius2, curvature = x[:, None] ** 2 + x**2, 8000.0
    solid, load = Homogeneous(contact_modulus=1.0, poisson=0.0), 4 * a**3 / (3 * curvature) / n**2
    sphere = pgfmd.solve(-radius2 / (2 * curvature), load, solid=solid, tolerance=1e-10)
    for share in (0.25, 0.5, 0.75, 0.9):
        low = pgfmd.solve(-radius2 / (2 * curvature), (1 - share) * load, solid=solid, tolerance=1e-12)
        ratio = math.sqrt(low.contact_area_corrected / sphere.contact_area_corrected) / (1 - share) ** (1 / 3)
        yield f"sphere, Q/muP={share}", "c/a over the exact one, less 1", ratio - 1
        c = a * (1 - share) ** (1 / 3)
        hertz = [each / math.pi / curvature * 2 * np.sqrt(np.maximum(1 - radius2 / each**2, 0)) for each in (a, c)]
        expected, traction = hertz[0] - hertz[1], sphere.pressure - low.pressure
        yield f"sphere, Q/muP={share}", "L2 error of the traction", float(
            np.linalg.norm(traction - expected) / np.linalg.norm(expected)
        )
    body = pgfmd.solve(
        -radius2 / (2 * curvature), load, solid=Homogeneous(contact_modulus=1.0, poisson=0.3), tolerance=1e-10
    )
    found = body.observables(subsurface={"depths": [0.4 * a, 0.48 * a, 0.56 * a]})["loads"]
    yield "sphere, nu=.3", "largest von Mises stress over p0", found["von_mises_max"] * math.pi * curvature / (2 * a)
    yield "sphere, nu=.3", "its depth over a", found["von_mises_depth"] / a


PARTS = {part.__name__: part for part in (stiffness, enclosed, percolation, closing, exponent, leakage, exact, peer)}


def main() -> None:
    """Writes the rows of the parts as they come."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path)
    parser.add_argument("parts", nargs="*", default=list(PARTS)[:-1], metavar="PART", help=", ".join(PARTS))
    asked = parser.parse_args()
    if unknown := [name for name in asked.parts if name not in PARTS]:
        parser.error(f"{unknown[0]}: no such part; there are {', '.join(PARTS)}")
    with asked.output.open("w", newline="") as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(("part", "case", "name", "value"))
        for name in asked.parts:
            for case, what, value in PARTS[name]():
                out.writerow((name, case, what, f"{float(value):.4g}"))
                file.flush()


if __name__ == "__main__":
    main()
