"""The numbers behind the contact line between pixels.

    python tools/bench/contact_line.py constant  # area per pixel edge: `theory.lattice_edge.STAIRCASE`
    python tools/bench/contact_line.py limit  # `observables.contact_area.LARGEST_RATIO`, on exact waves (minutes)
"""

import argparse
import dataclasses
import math
import sys

import numpy as np

from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables.contact_area import LARGEST_RATIO, contact_line
from pgfmd.parallel.mpi import ALONE
from pgfmd.physics.laws.hard import HardWall
from pgfmd.physics.problem import ContactProblem
from pgfmd.physics.solids.homogeneous import Homogeneous
from pgfmd.solvers.active_set.contact_from_coarse import solve_hard_wall
from pgfmd.surfaces.rigid_surface import coordinates
from pgfmd.theory.lattice_edge import STAIRCASE

ZONES, POINTS = 30, 100  # of the sum over Brillouin zones, and of the quadrature in a quarter of each


def mean_shift(zones: int = ZONES, points: int = POINTS) -> float:
    """δ averaged over directions, in pixels: (1/2π²) ∫ log(|q|/|fold q|) d²q/|q|³ outside the first zone.

    Beyond the square of `zones` zones each way, log |fold q| is replaced by its mean over a zone.
    """
    k = (np.arange(-points, points) + 0.5) / points * np.pi
    squared = k[:, None] ** 2 + k**2
    total = 0.0
    for a in range(1, zones + 1):
        for b in range(a + 1):
            q = np.hypot(k[:, None] + 2 * np.pi * a, k + 2 * np.pi * b)
            total += (4 if b in (0, a) else 8) * np.sum(np.log(q / np.sqrt(squared)) / q**3)
    angle = (np.arange(20_000) + 0.5) / 20_000 * 2 * np.pi
    edge = 2 * np.pi * (zones + 0.5) / np.maximum(np.abs(np.cos(angle)), np.abs(np.sin(angle)))
    beyond = 2 * np.pi * np.mean((np.log(edge) + 1 - np.mean(np.log(squared)) / 2) / edge)
    return (total * (np.pi / points) ** 2 + beyond) / (2 * np.pi**2)


def constant() -> None:
    """Print ⟨δ⟩/⟨|cos θ| + |sin θ|⟩ at rising accuracy."""
    for zones, points in ((10, 50), (20, 100), (ZONES, POINTS)):
        print(f"{zones:3d} zones, {points:4d} points: {mean_shift(zones, points) * np.pi / 4:.6f}")
    print(f"in the code: {STAIRCASE}")


def limit() -> None:
    """Print the rms error, in pixels, of the edges of exact waves for several bounds: all waves whose contacts and
    openings are at least one pixel wide.
    """
    bounds, rng = (2.0, 3.0, 5.0, 10.0, 30.0), np.random.default_rng(1)
    errors: dict[tuple[float, float], list[list[float]]] = {}
    solid = Homogeneous(contact_modulus=1.0)
    for direction in ((1, 0), (7, 1), (4, 1), (5, 2), (2, 1), (3, 2), (4, 3), (1, 1)):
        for wavelength in (4, 6, 8, 12, 24):
            waves = max(1, round(40 / (wavelength * math.hypot(*direction))))
            n = round(wavelength * waves * math.hypot(*direction))
            grid, number = SlabGrid(ALONE, (n, n)), waves * math.hypot(*direction) / n
            x, y = coordinates(grid)
            for fraction in (0.03, 0.1, 0.25, 0.5, 0.75, 0.9, 0.97):
                width = 2 / math.pi * math.asin(math.sqrt(fraction)) / number
                if min(width, 1 / number - width) < 1:
                    continue
                for offset in rng.random(4):
                    heights = np.cos(2 * np.pi * (waves * (direction[0] * x + direction[1] * y) / n + offset))
                    problem = ContactProblem(grid, heights, solid, HardWall(), fraction * math.pi * number)
                    found = solve_hard_wall(problem, 1e-12)
                    exact = n * n * 2 / math.pi * math.asin(math.sqrt(fraction)) - np.count_nonzero(found.pressure)
                    line = contact_line(grid, found.pressure, found.gap, problem.solid)
                    areas = [dataclasses.replace(line, bound=bound).total()[0] for bound in bounds]
                    misses = (np.array(areas) - exact) / (2 * n * n * number)
                    errors.setdefault((wavelength, fraction), []).append(misses)
    print("wavelength  f     " + "".join(f"{bound:8g}" for bound in bounds))
    for (wavelength, fraction), found in sorted(errors.items()):
        rms = np.sqrt(np.mean(np.square(found), axis=0))
        print(f"{wavelength:10d}  {fraction:4.2f}  " + "".join(f"{value:8.4f}" for value in rms))
    every = np.sqrt(np.mean(np.square(np.concatenate(list(errors.values()))), axis=0))
    print("all               " + "".join(f"{value:8.4f}" for value in every), f"\nin the code: {LARGEST_RATIO:g}")


def main(arguments: list[str] | None = None) -> int:
    """The command line."""
    commands = {"constant": constant, "limit": limit}
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=commands)
    commands[parser.parse_args(arguments).what]()
    return 0


if __name__ == "__main__":
    sys.exit(main())
