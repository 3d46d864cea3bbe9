"""The sections of a job as frozen, validated dataclasses: the reference of the TOML file.  No MPI here.

The fields of a class are the keys of its TOML table; the comment beside a key is its meaning.  All numbers are in one
consistent set of units, chosen by the user; only the wavelengths of a self-affine surface are counted in grid spacings
(the smaller one, where the two differ).
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass

from pgfmd.errors import InputError
from pgfmd.options.rules import Section, choice, flag, integer, key, many, number, pair, show, text, wrong

POSITIVE = number(above=0)


@dataclass(frozen=True, kw_only=True)
class Grid(Section):
    """The periodic cell: `shape` (nx, ny) points, `lengths` (lx, ly)."""

    where = "grid"
    n: tuple[int, int] = key(pair(integer(1)), needed=True)  # points [nx, ny]; one number: both
    length: tuple[float, float] | None = key(pair(POSITIVE))  # cell [lx, ly]; or
    spacing: tuple[float, float] | None = key(pair(POSITIVE))  # grid spacing [ax, ay]; 1 if neither is given

    def check(self):
        if max(self.n) < 2:
            raise wrong(self, "n", "at least one direction must have 2 points")
        if self.length and self.spacing:
            raise wrong(self, "spacing", f"give either length or spacing, not both (length = {show(self.length)})")
        if not all(0 < value < math.inf for value in (*self.lengths, *self.steps, math.prod(self.lengths))):
            raise wrong(self, "length" if self.length else "spacing", "cell or spacing is out of range of a float64")

    @property
    def shape(self) -> tuple[int, int]:
        """Points (nx, ny)."""
        return self.n

    @property
    def lengths(self) -> tuple[float, float]:
        """Cell (lx, ly)."""
        if self.length:
            return self.length
        steps = self.spacing or (1.0, 1.0)
        return self.n[0] * steps[0], self.n[1] * steps[1]

    @property
    def steps(self) -> tuple[float, float]:
        """Grid spacings (ax, ay)."""
        return self.spacing or (self.lengths[0] / self.n[0], self.lengths[1] / self.n[1])


ROUGH, FILE, SINUSOID, PARABOLOID = "self-affine", "file", "sinusoid", "paraboloid"


@dataclass(frozen=True, kw_only=True)
class Surface(Section):
    """Heights of the rigid surface, peaks positive."""

    where = "surface"
    kind: str = key(choice(ROUGH, FILE, SINUSOID, PARABOLOID), needed=True)
    hurst: float | None = key(number(low=0, high=1), only=(ROUGH,), needed=True)  # C_h ∝ q^(−2(1+H))
    # Shortest wavelength in grid spacings.  1 or less: every mode of the grid, the corners |q| ≤ √2 π/a included.
    lambda_s: float | None = key(POSITIVE, only=(ROUGH,), needed=True)
    lambda_l: float | None = key(number(above=0, infinite=True), only=(ROUGH,))  # longest self-affine one; the cell
    # Roll-off: the spectrum is constant from lambda_l up to lambda_r (≥ lambda_l, at most the cell); none if not given.
    lambda_r: float | None = key(number(above=0, infinite=True), only=(ROUGH,))
    rms_slope: float | None = key(number(low=0), only=(ROUGH,), needed=True)  # √⟨|∇h|²⟩, exact, spectral
    seed: int | None = key(integer(0), 1, only=(ROUGH,))
    # .npy, HDF5 (file.h5:dataset), or any format that SurfaceTopography reads; relative to the TOML's folder.  The cell
    # is that of [grid]; what a file says of its size must agree, and of its unit is converted to output.length_unit.
    path: str | None = key(text(), only=(FILE,), needed=True)
    dataset: str | None = key(text(), only=(FILE,))  # the same as the part of the path after the colon
    detrend: str | None = key(choice("none", "mean", "plane"), "none", only=(FILE,))
    # What the periodic cell repeats: the heights; the heights and their mirror images, in a cell twice as long either
    # way; the heights, led to their mean over the outer tenth of each side.
    periodic: str | None = key(choice("as-is", "mirror", "taper"), "as-is", only=(FILE,))
    height_scale: float | None = key(number(), 1.0, only=(FILE,))  # factor on the heights; negative turns them over
    amplitude: float | None = key(number(), only=(SINUSOID,), needed=True)  # Δ of Δ cos(qx) or Δ cos(qx) cos(qy)
    waves: int | None = key(integer(1), 1, only=(SINUSOID,))  # wavelengths in the cell
    two_dimensional: bool | None = key(flag(), False, only=(SINUSOID,))
    radius: float | None = key(POSITIVE, only=(PARABOLOID,), needed=True)  # R of −r²/(2R), apex in the cell's centre

    def check(self):
        if self.kind == FILE and self.height_scale == 0:
            raise wrong(self, "height_scale", "must not be zero")
        if self.kind != ROUGH:
            return
        longest = math.inf if self.lambda_l is None else self.lambda_l
        if self.lambda_s > longest:
            raise wrong(self, "lambda_s", f"must not exceed lambda_l = {show(longest)}")
        if self.lambda_r is not None and self.lambda_r < longest:
            least = "the cell" if self.lambda_l is None else show(longest)
            raise wrong(self, "lambda_r", f"must not be below lambda_l = {least}")

    @property
    def source(self) -> tuple[str, str | None]:
        """The heights file and the dataset in it (None: not said), from path, "path:dataset" or dataset."""
        path, colon, dataset = self.path.rpartition(":")
        if self.dataset or not colon or os.path.isfile(self.path):
            return self.path, self.dataset
        return path, dataset or None


@dataclass(frozen=True, kw_only=True)
class Solid(Section):
    """The elastic solid: half-space or slab.

    Give one of (lame_lambda, lame_mu), (young, poisson), contact_modulus alone or with poisson; the others follow from
    it.  Nothing given: λ = μ = 1.  Redundant values must agree.
    `contact_modulus` is always known; the others are None if contact_modulus was given without poisson.
    """

    where = "solid"
    lame_lambda: float | None = key(number())
    lame_mu: float | None = key(POSITIVE)
    young: float | None = key(POSITIVE)
    poisson: float | None = key(number(above=-1, below=0.5))
    contact_modulus: float | None = key(POSITIVE)  # E' = E/(1 − ν²)
    thickness: float = key(number(above=0, infinite=True), math.inf)
    base: str = key(choice("bonded", "free", "sliding"), "bonded")  # of a slab: bonded to, or sliding on, a rigid plane

    def check(self):
        given = {name: getattr(self, name) for name in MODULI if getattr(self, name) is not None}
        known = _moduli(given or {"lame_lambda": 1.0, "lame_mu": 1.0})
        if known is None:
            raise InputError(
                "solid: give lame_lambda and lame_mu, or young and poisson, or contact_modulus "
                f"(with poisson); given: {', '.join(given)}"
            )
        for name, value in known.items():
            if value is not None and not (math.isfinite(value) and (value > 0 or name in ("lame_lambda", "poisson"))):
                raise InputError(f"solid: {show(given)} gives {name} = {value:g}, which no stable solid has")
            if name in given and not math.isclose(given[name], value, rel_tol=1e-9, abs_tol=1e-9 * abs(value)):
                raise wrong(self, name, f"the other moduli give {value:g}")
            object.__setattr__(self, name, given.get(name, value))
        if math.isfinite(self.thickness) and self.poisson is None and self.base != "free":
            raise wrong(self, "thickness", f"a slab with a {self.base} base needs poisson as well")


MODULI = ("lame_lambda", "lame_mu", "young", "poisson", "contact_modulus")


def _moduli(given: dict[str, float]) -> dict[str, float | None] | None:
    """All five moduli from a pair that fixes them; None if nothing does."""
    if {"lame_lambda", "lame_mu"} <= given.keys():
        lam, mu = given["lame_lambda"], given["lame_mu"]
        if 3 * lam <= -2 * mu:
            raise InputError(f"solid.lame_lambda = {lam:g}: must exceed −2/3 lame_mu = {-2 * mu / 3:g}")
        poisson = lam / (2 * (lam + mu))
        young = 2 * mu * (1 + poisson)
    elif {"young", "poisson"} <= given.keys():
        young, poisson = given["young"], given["poisson"]
    elif {"contact_modulus", "poisson"} <= given.keys():
        poisson = given["poisson"]
        young = given["contact_modulus"] * (1 - poisson**2)
    elif given.keys() == {"contact_modulus"}:
        return {name: given.get(name) for name in MODULI}
    else:
        return None
    mu = young / (2 * (1 + poisson))
    return {
        "lame_lambda": 2 * mu * poisson / (1 - 2 * poisson) if poisson < 0.5 else math.inf,
        "lame_mu": mu,
        "young": young,
        "poisson": poisson,
        "contact_modulus": young / (1 - poisson**2),
    }


@dataclass(frozen=True, kw_only=True)
class Wall(Section):
    """The law between the gap and the pressure."""

    where = "wall"
    kind: str = key(choice("hard", "exponential"), "hard")
    zeta: float | None = key(POSITIVE, only=("exponential",), needed=True)  # σ = sigma_ref exp(−gap/ζ)
    sigma_ref: float | None = key(POSITIVE, only=("exponential",))  # the contact modulus if not given


@dataclass(frozen=True, kw_only=True)
class Load(Section):
    """What is imposed, one solution per entry, in the order given: exactly one of the four lists."""

    where = "load"
    pressure: tuple[float, ...] | None = key(many(number(low=0), least=1))  # mean pressure
    contact_area: tuple[float, ...] | None = key(many(number(above=0, below=1), least=1))  # relative contact area
    mean_gap: tuple[float, ...] | None = key(many(number(), least=1))  # mean of displacement minus height
    # Approach of the solid's far side (half-space: of its mean plane) from where the flat solid touches the summit.
    displacement: tuple[float, ...] | None = key(many(number(), least=1))
    area_tolerance: float = key(number(above=0, below=1), 0.005)  # relative, for contact_area

    def check(self):
        given = [name for name in CONTROLS if getattr(self, name) is not None]
        if len(given) != 1:
            found = f"found {' and '.join(given)}" if given else "found none"
            raise InputError(f"load: give exactly one of {', '.join(CONTROLS)}; {found}")

    @property
    def control(self) -> str:
        """The name of what is imposed."""
        return next(name for name in CONTROLS if getattr(self, name) is not None)

    @property
    def targets(self) -> tuple[float, ...]:
        """The values imposed."""
        return getattr(self, self.control)


CONTROLS = ("pressure", "contact_area", "mean_gap", "displacement")


@dataclass(frozen=True, kw_only=True)
class Solver(Section):
    """How the contact is found, and how well: the certified relative energy error D/(2 E_el) at which it stops."""

    where = "solver"
    method: str = key(choice("auto", "active-set", "newton", "gfmd"), "auto")
    tolerance: float = key(number(above=0, below=1), 1e-6)
    max_iterations: int = key(integer(1), 10000)


@dataclass(frozen=True, kw_only=True)
class Histogram(Section):
    """Options of the pressure and gap histograms."""

    where = "output.histogram"
    bins: int = key(integer(1, 10**7), 200)


@dataclass(frozen=True, kw_only=True)
class Spectra(Section):
    """Options of the radially averaged spectra."""

    where = "output.spectra"
    spacing: str = key(choice("log", "linear"), "log")
    bins: int = key(integer(1, 10**6), 20)  # per decade of |q| (log), or bins up to the largest |q| (linear)


@dataclass(frozen=True, kw_only=True)
class Correlations(Section):
    """Options of the autocorrelation functions."""

    where = "output.acf"
    spacing: str = key(choice("log", "linear"), "log")
    bins: int = key(integer(1, 10**6), 20)  # per decade of |r| (log), or bins up to the largest |r| (linear)


@dataclass(frozen=True, kw_only=True)
class Patches(Section):
    """Options of the contact patches."""

    where = "output.patches"
    connectivity: int = key(choice(8, 4), 8)


@dataclass(frozen=True, kw_only=True)
class Lowpass(Section):
    """Options of f(q), the contact area of the surface low-passed at q, at the same load."""

    where = "output.lowpass"
    q: tuple[float, ...] = key(many(POSITIVE), ())  # radians per length; empty: octaves from the cell to lambda_s


FIELDS = ("height", "pressure", "gap", "displacement", "labels")
OBSERVABLES = ("histogram", "spectra", "acf", "patches", "bearing", "lowpass")


@dataclass(frozen=True, kw_only=True)
class Output(Section):
    """What is written.  What is not asked for is not computed; option tables act on observables that are."""

    where = "output"
    fields: tuple[str, ...] = key(many(choice(*FIELDS), distinct=True), ())
    observables: tuple[str, ...] = key(many(choice(*OBSERVABLES), distinct=True), ())
    precision: str = key(choice("float64", "float32"), "float64")  # of the fields in the file
    # Names that label the results.  Nothing is converted, but the heights of a file that says its own unit.
    length_unit: str = key(text(), "length")
    pressure_unit: str = key(text(), "pressure")
    histogram: Histogram = key(Histogram)
    spectra: Spectra = key(Spectra)
    acf: Correlations = key(Correlations)
    patches: Patches = key(Patches)
    lowpass: Lowpass = key(Lowpass)


@dataclass(frozen=True, kw_only=True)
class Run(Section):
    """Long runs on machines that stop jobs; seconds."""

    where = "run"
    checkpoint_interval: float = key(number(low=0, infinite=True), 1800.0)  # 0: each outer step; inf: each load
    time_limit: float = key(number(above=0, infinite=True), math.inf)  # of the run; it stops before it, to be restarted
