"""Extreme inputs against the solvers: each ends right, or in a clear error; never in NaN, a hang, a warning or a lie.

Every case is solved on one rank and judged from outside: finite fields, pressures ≥ 0 that carry the load, and a bound
on the energy error computed anew with NumPy's transforms in double precision.  Exits with 1 on any wrong verdict.
"""

import argparse
import math
import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from pgfmd import InputError, SolverError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.physics.laws.exponential_law import ExponentialWall
from pgfmd.physics.laws.hard import HardWall
from pgfmd.physics.laws.law import ContactLaw
from pgfmd.physics.problem import ContactProblem
from pgfmd.physics.solids.homogeneous import Homogeneous
from pgfmd.solvers.dispatch import solve_contact
from pgfmd.solvers.options import Solver
from pgfmd.surfaces.self_affine import self_affine

TOLERANCE = 1e-6
LOADS = (1e-100, 1e-50, 1e-20, 1e-12, 1e-8, 1e-5, 1e-3, 0.03, 0.3, 1.0, 3.0, 30.0, 1e4)
"""Over the rms stress of full contact: from far less than a single point bears to far more than full contact needs."""
STEPS = 200  # of the bound for a hard wall
SLOW = 60.0  # seconds for a case of at most 128² points


@dataclass
class Case:
    """One contact; `error` is the exception that is right for it."""

    name: str
    heights: np.ndarray
    pressure: float
    elasticity: Homogeneous | dict = Homogeneous(contact_modulus=1.0)
    wall: ContactLaw = HardWall()
    method: str = "auto"
    error: type[Exception] | None = None
    oblong: float = 1.0  # side of a pixel along x over that along y


def rough(n: int | tuple[int, int] = 64, hurst: float = 0.8, lambda_s: float = 4.0, seed: int = 1) -> np.ndarray:
    """A self-affine surface of rms slope 0.1."""
    shape = (n, n) if isinstance(n, int) else n
    return self_affine(SlabGrid(MPI.COMM_SELF, shape), hurst, lambda_s, 0.1, seed)


def cases() -> Iterator[Case]:
    """All of them; pressures in units of E' = 1."""
    base = rough()
    for power in (-8, -5, -3, -2, -1, 0, 3):
        yield Case(f"load 1e{power} E'g", base, 0.1 * 10.0**power)
        yield Case(f"load 1e{power} E'g, exponential", base, 0.1 * 10.0**power, wall=ExponentialWall(zeta=base.std()))
    yield Case("load 1e-300", base, 1e-300, error=InputError)
    yield Case("no load", base, 0.0)
    yield Case("no load, exponential", base, 0.0, wall=ExponentialWall(zeta=1.0), error=InputError)
    yield Case("offset 1e9", base + 1e9, 0.01)
    for scale in (1e-12, 1e12):
        yield Case(f"heights × {scale:g}", base * scale, 0.01 * scale)
        yield Case(f"heights × {scale:g}, exponential", base * scale, 0.01 * scale, wall=ExponentialWall(zeta=scale))
    for modulus in (1e-12, 1e12):
        yield Case(f"modulus × {modulus:g}", base, 0.01 * modulus, Homogeneous(contact_modulus=modulus))
    for hurst in (0.0, 0.3, 0.5, 1.0):
        yield Case(f"H = {hurst:g}", rough(hurst=hurst, lambda_s=1.0), 0.01)
    for ratio in (1e-4, 1e-3, 1e-2, 0.1, 1, 10, 100):
        for load in (1e-4, 1e-2, 0.1):
            yield Case(f"ζ = {ratio:g} h_rms, p = {load:g}", base, load, wall=ExponentialWall(zeta=ratio * base.std()))
    for load, zeta in ((1e-100, 0.1), (1e-40, 0.3), (1e20, 0.1), (1e60, 0.1), (1e100, 1.0)):
        wall = ExponentialWall(zeta=zeta)
        yield Case(f"p = {load:g}, ζ = {zeta:g}: rounding hides the energy", base, load, wall=wall, error=SolverError)
    for oblong in (3.0, 31.0, 300.0):
        for load in (1e-6, 1e-3):
            noise = np.random.default_rng(5).standard_normal((24, 16))
            yield Case(f"pixels {oblong:g}:1, p = {load:g}", noise, load, oblong=oblong)
    for thickness in (2.0, 8.0):
        plate = Homogeneous(contact_modulus=1.0, thickness=thickness, base="free")
        yield Case(f"free, d = {thickness:g}, active set", base, 0.01, plate, method="active-set")
    yield from slabs(base)
    yield from loads()
    yield from shapes()
    yield from surfaces()
    wave = np.cos(2 * np.pi * np.arange(64) / 64)[:, None] * np.ones(64)
    for method in ("auto", "gfmd"):
        yield Case(f"Westergaard, {method}", wave, 0.02, method=method)
    yield Case("GFMD, exponential", base, 0.01, wall=ExponentialWall(zeta=0.1 * base.std()), method="gfmd")


def slabs(base: np.ndarray) -> Iterator[Case]:
    """Thickness from a tenth of a pixel to infinity, Poisson's ratio from 0 to nearly ½."""
    for bottom in ("bonded", "free", "sliding"):
        for thickness in (0.1, 1.0, 10.0, 64.0, 1e6, math.inf):
            for poisson in (0.0, 0.4999) if bottom == "bonded" else (0.25,):
                keys = {"contact_modulus": 1.0, "thickness": thickness, "poisson": poisson}
                solid = Homogeneous(base=bottom if thickness < math.inf else "bonded", **keys)
                yield Case(f"{bottom}, d = {thickness:g}, ν = {poisson:g}", base, 0.01, solid)
    for poisson in (0.5, 0.6, -1.0):
        yield Case(f"ν = {poisson:g}", base, 0.01, error=InputError, elasticity={"thickness": 1.0, "poisson": poisson})


def loads() -> Iterator[Case]:
    """LOADS on a paraboloid and a rough surface, on a half-space and on slabs of six thicknesses with three bases."""
    x = np.arange(32) - 16
    surfaces = {"paraboloid": -(x[:, None] ** 2 + x**2) / 60.0, "rough": rough(32)}
    solids = {"half-space": Homogeneous(contact_modulus=1.0)}
    for base in ("bonded", "free", "sliding"):
        for thickness in (0.2, 1.0, 4.0, 16.0, 64.0, 1e4):
            solids[f"{base}, d = {thickness:g}"] = Homogeneous(
                contact_modulus=1.0, thickness=thickness, base=base, poisson=0.3
            )
    for name, heights in surfaces.items():
        for where, solid in solids.items():
            stress = full_stress(heights, solid)
            for load in LOADS:
                yield Case(f"{name}, {where}, p = {load:g} of full", heights, load * stress, solid)


def full_stress(heights: np.ndarray, solid: Homogeneous) -> float:
    """Rms stress of full contact on unit pixels."""
    q = 2 * np.pi * np.hypot(np.fft.fftfreq(heights.shape[0])[:, None], np.fft.rfftfreq(heights.shape[1]))
    return float(np.fft.irfft2(np.fft.rfft2(heights) * solid.stiffness(q), s=heights.shape).std())


def shapes() -> Iterator[Case]:
    """Grids that are tiny, prime, flat or long."""
    for n in (2, 3, 5, 61, 67, 127, (64, 31), (1, 64), (64, 1), (2, 128), (37, 96)):
        generator = np.random.default_rng(3)
        shape = (n, n) if isinstance(n, int) else n
        heights = generator.standard_normal(shape)
        yield Case(f"{shape[0]} × {shape[1]} points, noise", heights, 0.1)
        yield Case(f"{shape[0]} × {shape[1]} points, exponential", heights, 0.1, wall=ExponentialWall(zeta=0.1))


def surfaces() -> Iterator[Case]:
    """Heights that no instrument would give."""
    i, j = np.meshgrid(np.arange(64), np.arange(64), indexing="ij")
    zero = np.zeros((64, 64))
    spike, peaks, hole = zero.copy(), zero.copy(), zero.copy()
    spike[5, 7] = peaks[10, 10] = peaks[40, 33] = 1.0
    hole[20, 30] = -1e-3
    denormal = np.random.default_rng(1).standard_normal((64, 64)) * 1e-310
    all_surfaces = {
        "flat": zero, "flat at 1e9": zero + 1e9, "one spike": spike, "two identical peaks": peaks,
        "all but one point": hole,
        "Nyquist": np.cos(np.pi * i), "Nyquist in both": np.cos(np.pi * i) * np.cos(np.pi * j),
        "white noise": np.random.default_rng(2).standard_normal((64, 64)),
        "step": np.where(i < 32, 1.0, 0.0), "checkerboard": ((i + j) % 2).astype(float), "denormals": denormal,
        "float32": rough().astype(np.float32), "huge": rough() * 1e200, "range of 1e300": rough() * 1e300,
    }  # fmt: skip
    for name, heights in all_surfaces.items():
        size = float(np.abs(heights - heights.mean()).max()) or 1.0
        for load in (1e-6, 0.02, 1.0):
            refused = InputError if name in ("denormals", "huge", "range of 1e300") else None
            yield Case(f"{name}, p = {load:g} h", heights, load * size, error=refused)
            if not refused:
                wall = ExponentialWall(zeta=0.05 * size)
                yield Case(f"{name}, p = {load:g} h, exponential", heights, load * size, wall=wall)
    for value in (np.nan, np.inf):
        broken = rough()
        broken[3, 4] = value
        yield Case(f"{value} in the heights", broken, 0.01, error=InputError)


def judge(case: Case, tolerance: float) -> tuple[str, str, int, bool]:
    """Solve a case: (verdict, certified error, iterations, whether the verdict is right)."""
    began = time.perf_counter()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            with np.errstate(all="warn", under="ignore"):
                verdict, error, iterations = attempt(case, tolerance)
    except (InputError, SolverError) as failure:
        right = case.error is not None and isinstance(failure, case.error)
        return f"{type(failure).__name__}: {str(failure)[:90]}", "", 0, right
    except Exception as failure:  # whatever it is, it is the solver's fault
        return f"{type(failure).__name__}: {str(failure)[:90]}", "", 0, False
    seconds = time.perf_counter() - began
    if seconds > SLOW:
        verdict = f"slow: {seconds:.0f} s"
    return verdict, f"{error:.1e}", iterations, verdict == "right" and case.error is None


def attempt(case: Case, tolerance: float) -> tuple[str, float, int]:
    """(verdict, certified error, iterations) of a case."""
    elasticity = Homogeneous(**case.elasticity) if isinstance(case.elasticity, dict) else case.elasticity
    nx, ny = case.heights.shape
    grid = SlabGrid(MPI.COMM_SELF, (nx, ny), (nx * case.oblong, float(ny)))
    heights = np.ascontiguousarray(case.heights, dtype=np.float64)
    if not np.isfinite(heights).all():
        raise InputError("heights: all must be finite")
    found = solve_contact(
        ContactProblem(grid, heights, elasticity, case.wall, case.pressure),
        Solver(method=case.method, tolerance=tolerance),
    )
    return verify(found, heights, grid, elasticity, case, tolerance), found.certified_error, found.iterations


def verify(found, heights: np.ndarray, grid: SlabGrid, elasticity: Homogeneous, case: Case, tolerance: float) -> str:
    """ "right", or what is wrong."""
    pressure, load = found.pressure, case.pressure
    if not (np.isfinite(pressure).all() and np.isfinite(found.gap).all() and math.isfinite(found.mean_gap)):
        return "not finite"
    if pressure.min() < 0 or abs(pressure.mean() - load) > 1e-9 * load:
        return "load not carried"
    if case.wall.kind == "hard" and (found.gap.min() < 0 or np.any(found.gap[pressure > 0] != 0)):
        return "gap in contact"
    bound, work = bound_of(pressure, heights, grid, elasticity, case)
    if not found.certified_error <= tolerance:
        return "tolerance not reached"
    rounding = 1e-13 * load * np.ptp(heights) if case.wall.kind == "exponential" else 0.0
    if load > 0 and bound > 2 * tolerance * work + rounding:
        return f"error is {bound / work:.1e}"
    return "right"


def bound_of(pressure, heights, grid, elasticity, case) -> tuple[float, float]:
    """A bound of the energy error, of second order, and ⟨p, Gp⟩ per point from NumPy's transforms.

    Hard wall: `least_square`.  Exponential wall: the least of several bounds.  One is
    the duality gap.  The others are ½⟨ε, Kε⟩ with ε = g + ζ ln p − λ where p is above some value and 0 elsewhere, plus
    the loss ζ (s − p + p ln(p/s)) against s = exp((λ − g)/ζ) at those other points.
    """
    qy = 2 * np.pi / grid.lengths[1] * np.arange(grid.shape[1] // 2 + 1)
    q = np.hypot(grid.qx[0][:, None], qy[None, :])
    unit = float(pressure.mean()) or 1.0
    ratio = pressure / unit
    displacement = np.fft.irfft2(np.fft.rfft2(ratio) * elasticity.compliance(q), s=grid.shape) * unit
    gap = displacement - (heights - heights.max())  # where the highest points alone touch, the others need no digits
    work = float(np.mean(ratio * displacement)) * unit

    def half_square(field: np.ndarray) -> float:
        stiff = np.fft.irfft2(np.fft.rfft2(field) * elasticity.stiffness(q), s=grid.shape)
        return float(np.mean(field * stiff)) / 2

    if case.wall.kind == "hard":
        away = gap - float(np.mean(ratio * gap))
        return least_square(pressure > 0, away, elasticity.stiffness(q)), work
    zeta = case.wall.zeta
    logarithm = np.log(ratio, where=ratio > 0, out=np.zeros_like(ratio))
    level = float(np.mean(ratio * (gap + zeta * logarithm)))
    highest = float(np.max(-gap))  # so that nothing overflows
    free = level + highest + zeta * math.log(np.mean(np.exp((-gap - highest) / zeta)))  # duality gap
    bounds = [free * unit]
    wall = np.minimum((level - gap) / zeta, 700.0)
    lost = np.exp(wall) - ratio + ratio * (logarithm - wall)
    for large in (ratio > smallest for smallest in (0.1, 1e-3, 1e-6, 1e-12, 1e-30)):
        field = np.where(large, gap - level + zeta * logarithm, 0)
        bounds.append(half_square(field) + zeta * unit * float(np.mean(np.where(large, 0, lost))))
    return min(bounds), work


def least_square(contact: np.ndarray, away: np.ndarray, stiffness: np.ndarray) -> float:
    """The least ½⟨ε, Kε⟩ per point of all ε that are `away` in contact and at most that elsewhere, or a little more: by
    `STEPS` projected gradient steps with momentum (Beck and Teboulle 2009, doi:10.1137/080716542).
    """
    field = momentum = np.where(contact, away, np.minimum(away, 0.0))
    least, weight = np.inf, 1.0
    for _ in range(STEPS):
        slope = np.fft.irfft2(np.fft.rfft2(momentum) * stiffness, s=away.shape)
        new = np.where(contact, away, np.minimum(momentum - slope / stiffness.max(), away))
        next_weight = (1 + math.sqrt(1 + 4 * weight**2)) / 2
        field, momentum, weight = new, new + (weight - 1) / next_weight * (new - field), next_weight
        answer = np.fft.irfft2(np.fft.rfft2(field) * stiffness, s=away.shape)
        least = min(least, float(np.mean(field * answer)) / 2)
    return least


def main(arguments: list[str] | None = None) -> int:
    """Print the table; 0 if every verdict is right."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tolerance", type=float, default=TOLERANCE, help="certified relative energy error to ask for")
    parser.add_argument("--only", default="", help="cases whose name contains this")
    options = parser.parse_args(arguments)
    print(f"{'case':44} {'error':>8} {'iter':>5}  verdict")
    wrong = count = 0
    for case in cases():
        if options.only not in case.name:
            continue
        verdict, error, iterations, right = judge(case, options.tolerance)
        count, wrong = count + 1, wrong + (not right)
        print(f"{case.name:44} {error:>8} {iterations:5d}  {'' if right else 'WRONG: '}{verdict}", flush=True)
    print(f"{count} cases, {wrong} wrong")
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
