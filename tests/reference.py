"""A slow, dense reference for contacts of at most some 24 × 24 points, which certifies itself.

It shares no line with pgfmd.  Kernels are sums of cosines in extended precision, over stiffnesses from the closed forms
of a slab in decimal arithmetic; heights are measured from the highest point; systems are factorised in double precision
and refined in extended precision, whose range (1e±4932) holds any units and any load.  So the relative energy error of
an answer is known to some 1e-30, whether a single pixel carries the load or all do.

With A the compliance over that of a single pixel under the mean pressure, b the heights and x = p/p̄ the pressures,
½ x·Ax − b·x is least among Σx = N and 0 ≤ x ≤ X (a hard wall; X: hardness), or ½ x·Ax − b·x + ζ x·ln x among Σx = N
(an exponential wall).
"""

from __future__ import annotations

import decimal
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg
import scipy.special

Real = np.longdouble
PI = 4 * np.arctan(Real(1))
EXACT = Real(1e-20)  # relative energy error below which a solution is exact, as doubles go
CONTROLS = ("pressure", "contact_area", "mean_gap", "displacement")


class Unable(Exception):
    """The reference cannot certify an answer of its own."""


def slab_factor(t, base: str, poisson: float):
    """F(t), t = q d: the slab's stiffness over that of a half-space; Campañá, Müser, Robbins 2008 and PHYSICS 1."""
    if not t < 50:  # F = 1 to 1e-40
        return Real(1)
    places = 60 if t > 1e-8 else 60 + int(-5 * np.log10(t))
    if places > 320:  # the first term of the series, exact to t²
        nu, one = Real(poisson), Real(1)
        return {"bonded": 2 * (1 - nu) ** 2 / (one - 2 * nu) / t, "free": t**3 / 6, "sliding": 2 / t}[base]
    with decimal.localcontext(decimal.Context(prec=places, Emax=10**6, Emin=-(10**6))):
        t, nu = decimal.Decimal(np.format_float_scientific(t, unique=True)), decimal.Decimal(poisson)
        power = (2 * t).exp()
        sinh, cosh = (power - 1 / power) / 2, (power + 1 / power) / 2
        k = 3 - 4 * nu
        if base == "bonded":
            factor = (k * cosh + 2 * t * t + 5 - 4 * nu * (3 - 2 * nu)) / (k * sinh - 2 * t)
        elif base == "free":
            factor = (cosh - 1 - 2 * t * t) / (sinh + 2 * t)
        else:
            factor = (sinh + 2 * t) / (cosh - 1)
        return Real(str(factor))


@dataclass(frozen=True)
class Solid:
    """Contact modulus; for a slab thickness, base and Poisson's ratio; for others F(q), over that of a half-space."""

    modulus: float = 1.0
    thickness: float = math.inf
    base: str = "bonded"
    poisson: float = 0.25
    factor: Callable[[float], float] | None = None

    def stiffness(self, q: np.ndarray) -> np.ndarray:
        """Pressure per displacement of waves of those |q| > 0, in extended precision."""
        half = Real(self.modulus) / 2 * q
        if math.isinf(self.thickness) and self.factor is None:
            return half
        values, where = np.unique(q, return_inverse=True)
        factors = [
            Real(self.factor(float(value))) if self.factor
            else slab_factor(value * Real(self.thickness), self.base, self.poisson) for value in values
        ]  # fmt: skip
        return half * np.array(factors)[where].reshape(q.shape)

    @property
    def mean_compliance(self):
        """Displacement per mean pressure of the far side: d/(λ + 2μ) over a rigid base, 0 else."""
        if math.isinf(self.thickness) or self.base == "free":
            return Real(0)
        nu = Real(self.poisson)
        return Real(self.thickness) * (1 - 2 * nu) / (1 - nu) ** 2 / Real(self.modulus)


class Contact:
    """A periodic surface, heights (nx, ny), over pixels of `spacing`, against a solid; fields here are flat."""

    wraps = True

    def __init__(self, heights: np.ndarray, spacing: tuple[float, float] = (1.0, 1.0), solid: Solid | None = None):
        self.solid = solid or Solid()
        self.shape, self.count = np.shape(heights), np.size(heights)
        self.heights = np.asarray(heights, np.float64).astype(Real).ravel()
        self.heights = self.heights - self.heights.max()
        nx, ny = self.shape
        waves = [2 * PI * np.minimum(np.arange(n), n - np.arange(n)) / (n * Real(a))
                 for n, a in zip(self.shape, spacing, strict=True)]  # fmt: skip
        q = np.hypot(*np.meshgrid(*waves, indexing="ij")).ravel()[1:]
        stiffness = self.solid.stiffness(q)
        self.pixel = np.sum(1 / stiffness) / self.count  # displacement of a pixel under a unit pressure on it alone
        self.stiffness = self._matrix(stiffness * self.pixel)
        self.compliance = self._matrix(1 / (stiffness * self.pixel))
        self.uniform = Real(0) * self.heights  # displacement under the mean pressure, which a periodic cell leaves out

    def displace(self, deviation: np.ndarray) -> np.ndarray:
        """u over the unit of displacement, of p/p̄ − 1 (N,)."""
        return self.compliance @ deviation + self.uniform

    def work(self, deviation: np.ndarray):
        """Σ x u of x = 1 + deviation.  In a periodic cell Σ u is 0, and under heavy loads its rounding would count."""
        u = self.displace(deviation)
        return deviation @ u + (0 if self.wraps else u.sum())

    def _matrix(self, spectrum: np.ndarray) -> np.ndarray:
        """The convolution (N, N) of a spectrum that lacks q = 0."""
        nx, ny = self.shape
        modes = np.concatenate([[Real(0)], spectrum]).reshape(nx, ny)
        cosines = [np.cos(2 * PI * (np.outer(np.arange(n), np.arange(n)) % n) / n) for n in (nx, ny)]
        kernel = cosines[0] @ modes @ cosines[1] / self.count
        i, j = np.divmod(np.arange(self.count), ny)
        return kernel[(i[:, None] - i) % nx, (j[:, None] - j) % ny]

    @property
    def matrices(self) -> tuple[np.ndarray, np.ndarray]:
        """Compliance and stiffness (N, N): displacement per pressure and pressure per displacement, as doubles."""
        return (self.compliance * self.pixel).astype(float), (self.stiffness / self.pixel).astype(float)

    @cached_property
    def rms(self) -> float:
        """Rms height about the mean."""
        return np.sqrt(np.mean((self.heights - self.heights.mean()) ** 2))

    @cached_property
    def full_stress(self):
        """Rms stress of full contact."""
        return np.sqrt(np.mean((self.stiffness @ self.heights) ** 2)) / self.pixel

    def hard(self, pressure: float, hardness: float = math.inf, start: np.ndarray | None = None) -> Solved:
        """The hard wall at a mean pressure > 0; `start`: which points (N,) touch, as a guess.  Raises Unable."""
        unit = Real(pressure) * self.pixel
        if pressure > hardness:
            raise Unable("more than the hardness")
        if hardness >= pressure * self.count:  # one point bears all
            hardness = math.inf
        b = self.heights / unit
        full = self.stiffness @ b  # where all points touch, p = p̄ + Kh; kept apart from p̄, which may be far larger
        if self.wraps and full.min() >= -1 and full.max() <= Real(hardness) / Real(pressure) - 1:
            return Solved(self, Real(pressure), full, np.zeros(self.count, Real), Real(0), Real(0))
        programme = _Programme(self, b, Real(hardness) / Real(pressure))
        x, level, bound = programme.solve(start)
        gap = self.compliance @ x - b - level
        return Solved(self, Real(pressure), x - 1, gap, bound, gap.mean())

    def exponential(self, pressure: float, zeta: float, sigma_ref: float | None = None) -> Solved:
        """σ = σ_ref exp(−gap/ζ), σ_ref the contact modulus if None.  Raises Unable."""
        unit = Real(pressure) * self.pixel
        logarithms, bound = _newton(self, self.heights / unit, Real(zeta) / unit)
        from_mean = np.log(Real(sigma_ref or self.solid.modulus) / Real(pressure)) * (Real(zeta) / unit)
        gap = from_mean - Real(zeta) / unit * logarithms
        solved = Solved(self, Real(pressure), np.expm1(logarithms), gap, bound, gap.mean())
        solved.zeta, solved.logarithms = Real(zeta) / unit, logarithms
        return solved

    def bound_of(self, pressure: np.ndarray, zeta: float | None = None):
        """A rigorous bound on the energy error of a feasible pressure (nx, ny), relative to its ⟨p, Gp⟩, without any
        solution: of second order for a hard wall, the duality gap for an exponential one."""
        mean = np.asarray(pressure, np.float64).astype(Real).mean()
        x, unit = np.asarray(pressure, np.float64).astype(Real).ravel() / mean, mean * self.pixel
        b, deviation = self.heights / unit, x - 1
        gap = self.displace(deviation) - b
        work = self.work(deviation)
        if zeta is None:
            programme = _Programme(self, b, Real(math.inf))
            bound = programme.bound(x, np.average(gap, weights=x))
            return bound
        exponent = -gap / (Real(zeta) / unit)
        wall = exponent - _log_mean_exp(exponent)
        return np.sum(_entropy_distance(x, np.exp(wall), wall)) * Real(zeta) / unit / work

    def at(self, pressure: float, zeta: float | None = None, sigma_ref: float | None = None) -> Solved:
        """Either wall."""
        return self.hard(pressure) if zeta is None else self.exponential(pressure, zeta, sigma_ref)

    def measure(self, control: str, solved: Solved):
        """Contact area (relative), mean gap, or displacement of the far side from first touch (PHYSICS 1)."""
        if control == "contact_area":
            return np.count_nonzero(solved.x > 0) / self.count
        if control == "mean_gap":
            return solved.mean_gap
        if control == "displacement":
            moved = self.displace(solved.deviation).mean() * solved.unit
            below = solved.pressure * self.solid.mean_compliance if self.wraps else 0
            return below + moved - self.heights.mean() - solved.mean_gap
        return solved.pressure

    def find(self, control: str, target: float, zeta=None, sigma_ref=None, width: float = 1e-12) -> list[Solved]:
        """The two sides of a bracket, of that relative width, of the pressures that give the target; one entry if it
        is out of reach: the lightest or the heaviest pressure tried (1e±60 times the stress of full contact)."""
        sign = -1 if control == "mean_gap" else 1
        wanted = sign * Real(target)
        middle = float(np.log(self.full_stress))
        low, high, sides = middle - 140, middle + 140, [None, None]
        for at in (low, high):
            found = self.at(np.exp(Real(at)), zeta, sigma_ref)
            sides[at == high] = found
            reached = sign * self.measure(control, found)
            if (at == low and reached >= wanted) or (at == high and reached < wanted):
                return [found]
        while high - low > width:
            at = (low + high) / 2
            found = self.at(np.exp(Real(at)), zeta, sigma_ref)
            if sign * self.measure(control, found) < wanted:
                low, sides[0] = at, found
            else:
                high, sides[1] = at, found
        return sides


class OpenContact(Contact):
    """The same on a patch with open boundaries: a convolution with the kernel of a point load that the grid resolves,
    (1/πE') (erf(αr)/r + what a slab adds) and of the modes (2/E'q) erf(q/2α), α = .3 over the larger spacing.  Of a
    slab on a rigid base that is thin against the torus, or below three spacings, all is of the modes."""

    wraps = False

    def __init__(self, heights: np.ndarray, spacing: tuple[float, float], solid: Solid, torus: tuple[int, int]):
        self.solid, self.shape, self.count = solid, np.shape(heights), np.size(heights)
        self.heights = np.asarray(heights, np.float64).astype(Real).ravel()
        self.heights = self.heights - self.heights.max()
        least = [np.minimum(np.arange(m), m - np.arange(m)) for m in torus]
        waves = [2 * PI * i / (m * Real(a)) for i, m, a in zip(least, torus, spacing, strict=True)]
        q, alpha = np.hypot(*np.meshgrid(*waves, indexing="ij")), 0.3 / max(spacing)
        cosines = [np.cos(2 * PI * (np.outer(np.arange(n), np.arange(m)) % m) / m)
                   for n, m in zip(self.shape, torus, strict=True)]  # fmt: skip
        x, y = (i[:n] * Real(a) for i, n, a in zip(least, self.shape, spacing, strict=True))
        r, cell = np.hypot(x[:, None], y), Real(spacing[0]) * Real(spacing[1])
        thin = solid.thickness <= 0.02 * min(m * a for m, a in zip(torus, spacing, strict=True))
        thin |= solid.thickness < 3 * max(spacing)
        modes, kernel = np.full(q.shape, 2 / (np.sqrt(PI) * alpha)), Real(0)
        if thin:
            modes[q > 0] = Real(solid.modulus) / solid.stiffness(q[q > 0])
            d, nu = Real(solid.thickness), Real(solid.poisson)
            modes[0, 0] = d if solid.base == "sliding" else d * (1 - 2 * nu) / (1 - nu) ** 2
        else:
            np.divide(2 * scipy.special.erf((q / (2 * alpha)).astype(float)), q, out=modes, where=q > 0)
            kernel = np.full(r.shape, 2 * alpha / np.sqrt(PI))
            np.divide(scipy.special.erf((alpha * r).astype(float)), r, where=r > 0, out=kernel)
            kernel = (kernel + self.layer(r.astype(float))) * cell / PI
        kernel = (kernel + cosines[0] @ modes @ cosines[1].T / math.prod(torus)) / Real(solid.modulus)
        self.pixel = kernel[0, 0]
        i, j = np.divmod(np.arange(self.count), self.shape[1])
        self.compliance = (kernel / self.pixel)[np.abs(i[:, None] - i), np.abs(j[:, None] - j)]
        guess = np.linalg.inv(self.compliance.astype(float)).astype(Real)
        guess = 2 * guess - guess @ (self.compliance @ guess)
        self.stiffness, self.uniform = (guess + guess.T) / 2, self.compliance.sum(axis=1)

    def layer(self, r: np.ndarray) -> np.ndarray:
        """∫ (1/F(qd) − 1) J0(qr) dq by Gauss's rule on pieces that J0 crosses at most once."""
        d = self.solid.thickness
        if math.isinf(d):
            return np.zeros(r.shape)
        end = 25 / d  # F is 1 to 1e-19 there
        pieces = max(60, int(end * r.max() / math.pi) + 1)
        points, weights = np.polynomial.legendre.leggauss(12)
        q = ((np.arange(pieces)[:, None] + (points + 1) / 2) * (end / pieces)).ravel()
        values = np.array([float(1 / slab_factor(Real(value * d), self.solid.base, self.solid.poisson)) for value in q])
        values = (values - 1) * np.tile(weights, pieces) * (end / pieces / 2)
        places, where = np.unique(r, return_inverse=True)
        found = np.array([values @ scipy.special.j0(q * place) for place in places])
        return found[where].reshape(r.shape)


@dataclass
class Solved:
    """p/p̄ − 1 (N,), gap and mean gap over the unit of displacement p̄ × pixel, and `bound`, a rigorous one on the
    energy error relative to twice the elastic energy; properties are in physical units."""

    contact: Contact
    pressure: float  # the mean
    deviation: np.ndarray
    scaled_gap: np.ndarray
    bound: float
    scaled_mean_gap: float
    zeta: float | None = None  # over the unit of displacement
    logarithms: np.ndarray | None = None  # ln x

    @property
    def x(self) -> np.ndarray:
        """p/p̄ (N,)"""
        return 1 + self.deviation

    @property
    def scaled_work(self):
        """Σ x · Ax, twice the elastic energy."""
        return self.contact.work(self.deviation)

    @property
    def unit(self):
        """Of displacement."""
        return self.pressure * self.contact.pixel

    @property
    def gap(self) -> np.ndarray:
        """(N,)"""
        return self.scaled_gap * self.unit

    @property
    def mean_gap(self):
        """⟨u − h⟩"""
        return self.scaled_mean_gap * self.unit

    @property
    def work(self):
        """⟨p u⟩ per unit area, in a periodic cell without q = 0: twice the elastic energy."""
        return self.scaled_work / self.contact.count * self.pressure * self.unit

    def error_of(self, pressure: np.ndarray):
        """Energy error of another feasible pressure (nx, ny), relative to ⟨p*, Gp*⟩: J(p) − J(p*) without
        cancellation, by Bregman's distance.  Under an exponential wall it is first scaled to bear the load beyond the
        rounding of its sum, which that distance would count."""
        other = np.asarray(pressure, np.float64).astype(Real).ravel()
        other /= self.pressure if self.zeta is None else other.mean()
        d = other - 1 - self.deviation
        if self.zeta is not None:  # far from the wall the logarithm knows more digits
            d = np.where(self.x < 0.5, other - np.exp(self.logarithms), d)
        error = d @ (self.contact.compliance @ d) / 2
        if self.zeta is None:
            error += d @ self.scaled_gap
        else:
            error += self.zeta * np.sum(_entropy_distance(other, np.exp(self.logarithms), self.logarithms))
            residual = self.contact.displace(self.deviation) + self.zeta * self.logarithms
            residual -= self.contact.heights / self.unit
            error += d @ (residual - np.average(residual, weights=np.exp(self.logarithms)))
        work = self.scaled_work
        return error / work if work > 0 else Real(0)


def _log_mean_exp(values: np.ndarray):
    """ln⟨exp(values)⟩, to rounding of what lies within them."""
    highest = values.max()
    return highest + np.log1p(np.mean(np.expm1(values - highest)))


def _entropy_distance(other: np.ndarray, x: np.ndarray, logarithms: np.ndarray) -> np.ndarray:
    """x φ(δ), φ = (1 + δ) ln(1 + δ) − δ, δ = other/x − 1."""
    with np.errstate(all="ignore"):
        delta = (other - x) / x
        plain = np.where(other > 0, other * (np.log(other) - logarithms), 0) - other + x
        series = x * delta**2 * (Real(1) / 2 - delta / 6 + delta**2 / 12 - delta**3 / 20 + delta**4 / 30)
        return np.where(np.abs(delta) < 1e-4, series, plain)


class _Programme:
    """½ x·Ax − b·x least over Σx = N, 0 ≤ x ≤ most: an active set of points at 0, between, and at `most`."""

    def __init__(self, contact: Contact, b: np.ndarray, most):
        self.A, self.K, self.b, self.most = contact.compliance, contact.stiffness, b, most
        self.double, self.count = contact.compliance.astype(np.float64), contact.count

    def solve(self, start: np.ndarray | None):
        """(x, level, bound of the relative energy error).  Guesses sets; if they cycle, takes one point at a time."""
        where = np.ones(self.count, int) if start is None else start.astype(int)  # 0, 1 and 2: at 0, between, at most
        seen = set()
        while where.tobytes() not in seen and len(seen) < 60 and np.any(where == 1):
            seen.add(where.tobytes())
            x, level = self.equilibrium(where)
            bound = self.bound(*self.feasible(x))
            if bound <= EXACT:
                break
            pull = x - (self.A @ x - self.b - level)
            where = (pull > 0).astype(int) + (pull > self.most)
        else:
            x = self.one_by_one()
        x, level = self.feasible(x)
        bound = self.bound(x, level)
        if not bound <= EXACT:
            raise Unable(f"hard wall to {float(bound):.1e} only")
        return x, level, bound

    def equilibrium(self, where: np.ndarray):
        """x and the level such that Ax − b = level between the limits; refined in extended precision."""
        free = np.flatnonzero(where == 1)
        n = len(free)
        x = np.where(where == 2, self.most, Real(0)) if np.any(where == 2) else np.zeros(self.count, Real)
        system = np.zeros((n + 1, n + 1))
        system[:n, :n], system[n, :n], system[:n, n] = self.double[np.ix_(free, free)], 1, -1
        factors = scipy.linalg.lu_factor(system, check_finite=False)
        level, part = -self.b[free].max(), self.A[np.ix_(free, free)]
        fixed = self.A[free] @ x - self.b[free]
        for _ in range(12):
            wrong = np.append(level - part @ x[free] - fixed, self.count - x.sum())
            scale = np.abs(wrong).max()
            if scale == 0:
                break
            change = scipy.linalg.lu_solve(factors, (wrong / scale).astype(np.float64), check_finite=False) * scale
            x[free] += change[:n]
            level += change[n]
            if np.abs(change[:n]).max() <= 1e-19 * np.abs(x).max():
                break
        return x, level

    def feasible(self, x: np.ndarray):
        """x within its limits, of the right sum, and the mean level where it touches."""
        x = np.clip(x, 0, self.most)
        room = (x > 0) & (x < self.most) if np.any(x >= self.most) else x > 0
        if room.any():
            fixed = x[~room].sum()
            x[room] *= (self.count - fixed) / x[room].sum()
        else:
            room = x > 0
        gap = self.A @ x - self.b
        return x, np.average(gap[room], weights=x[room])

    def bound(self, x: np.ndarray, level):
        """½ ε·Kε / x·Ax, ε = gap − level between the limits, what of it has the wrong sign at them (NUMERICS 2).  inf
        if x does not carry the load, or is beyond its limits."""
        if abs(x.sum() - self.count) > 1e-15 * self.count or x.min() < 0 or x.max() > self.most * (1 + Real(1e-15)):
            return Real(math.inf)
        rest = self.A @ x - self.b - level
        rest = np.where(x <= 0, np.minimum(rest, 0), np.where(x >= self.most, np.maximum(rest, 0), rest))
        work = x @ (self.A @ x)
        return rest @ (self.K @ rest) / 2 / work if work > 0 else Real(0)

    def one_by_one(self) -> np.ndarray:
        """The textbook active set: steps to the first limit that is met; releases the point that gains most."""
        x, left = np.zeros(self.count, Real), Real(self.count)
        where = np.zeros(self.count, int)
        for point in np.argsort(-self.b):  # the highest points carry what they can
            x[point] = min(left, self.most)
            where[point], left = 1, left - x[point]
            if left <= 0:
                break
        for _ in range(20 * self.count):
            goal, level = self.equilibrium(where)
            free = where == 1
            low, high = free & (goal < 0), free & (goal > self.most)
            steps = np.full(self.count, np.inf, Real)
            steps[low], steps[high] = x[low] / (x - goal)[low], (self.most - x[high]) / (goal - x)[high]
            point = int(np.argmin(steps))
            if steps[point] < 1:
                x = x + max(steps[point], Real(0)) * (goal - x)
                where[point] = 2 if high[point] else 0
                x[point] = self.most if high[point] else 0
                if np.any(where == 1):
                    continue
            else:
                x = goal
            rest = self.A @ x - self.b - level
            gain = np.where(where == 0, -rest, np.where(where == 2, rest, 0))
            point = int(np.argmax(gain))
            if gain[point] <= 1e-16 * np.abs(self.A @ x).max():
                return x
            where[point] = 1
        raise Unable("hard wall: too many exchanges")


def _newton(contact: Contact, b: np.ndarray, zeta):
    """(ln x, bound of the relative energy error) of the exponential wall: the least ½ v·Kv + N ζ ln⟨exp((b − v)/ζ)⟩ by
    damped Newton steps, from a large ζ down."""
    K, count, b = contact.stiffness, contact.count, b - contact.uniform
    double, mean = K.astype(np.float64), np.float64(1) / count
    held = mean if contact.wraps else 0.0  # of the mean displacement, which nothing else holds in a periodic cell
    # The unknown s is the displacement v or, under a heavy load and a short wall, the gap v − b: whichever is small.
    heavy = max(np.ptp(b), zeta) < 1
    b = b - b.mean() if heavy else b
    shift = b if heavy else 0 * b  # v − s
    full = K @ shift

    def answer(s, zeta):
        """ln x of the wall to the gap v − b, and the objective."""
        exponent = -(s if heavy else s - b) / zeta
        highest = exponent.max()
        exponent = exponent - highest
        total = np.log1p(np.mean(np.expm1(exponent)))
        work = (shift + s) @ (full + K @ s) / 2 + (0 if contact.wraps else np.sum(shift + s))
        return exponent - total, work + count * zeta * (highest + total)

    s = -shift
    ladder = [zeta]
    while ladder[-1] < np.ptp(b):
        ladder.append(ladder[-1] * 4)
        if len(ladder) > 60:
            raise Unable("exponential wall: the range is too short")
    for rung in reversed(ladder):
        last, least = rung is ladder[0], np.inf
        logarithms, value = answer(s, rung)
        for _ in range(200):
            x = np.exp(logarithms)
            slope = full + K @ s - np.expm1(logarithms)
            weight = (x / rung).astype(np.float64)
            if not np.isfinite(weight).all():
                raise Unable("exponential wall: the range is too short")
            matrix = double + np.diag(weight) - np.outer(weight, x.astype(np.float64)) * mean + held
            scale = np.abs(slope).max()
            if scale == 0:
                break
            try:
                factor = scipy.linalg.cho_factor(matrix + 1e-15 * np.diag(np.diag(matrix)), check_finite=False)
            except scipy.linalg.LinAlgError:
                raise Unable("exponential wall: the system is singular") from None
            step = -scipy.linalg.cho_solve(factor, (slope / scale).astype(np.float64), check_finite=False) * scale
            step -= step.mean() if contact.wraps else 0
            decrement = -(slope @ step)
            length = Real(1)
            for _ in range(40):
                new, after = answer(s + length * step, rung)
                if after <= value - length * decrement / 10 or decrement <= 1e-13 * abs(value):
                    break
                length /= 2
            s, logarithms, value = s + length * step, new, after
            if decrement <= (0 if last else 1e-2 * count * rung):
                break
            if decrement >= 0.5 * least and decrement <= 1e-20 * np.abs((shift + s) @ (full + K @ s)):
                break
            least = min(least, decrement)
    logarithms = answer(s, zeta)[0]
    deviation = np.expm1(logarithms)
    displacement = contact.compliance @ deviation
    theirs = answer(displacement - shift, zeta)[0]  # the wall's answer to the displacement that x makes
    t = logarithms - theirs
    series = t * t * (Real(1) / 2 + t / 3 + t * t / 8 + t**3 / 30)
    apart = np.sum(np.exp(theirs) * np.where(np.abs(t) < 1e-4, series, (t - 1) * np.exp(t) + 1)) * zeta
    work = contact.work(deviation)
    bound = apart / work if work > 0 else Real(0)
    if not bound <= 1e-18:
        raise Unable(f"exponential wall to {float(bound):.1e} only")
    return logarithms, bound
