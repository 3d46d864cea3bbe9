"""Stiffness of half-space and slabs against a direct solution of plane-strain elasticity, and its limits."""

import logging
import math
from decimal import Decimal, localcontext

import numpy as np
import pytest
import reference
from conftest import once
from contacts import elastic, under_hard_wall

import pgfmd
from pgfmd.application.estimate import Plan
from pgfmd.application.job import load, parse
from pgfmd.application.simulate import simulate
from pgfmd.errors import InputError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.physics.solids.graded import Graded
from pgfmd.physics.solids.layered import Layered
from pgfmd.solvers.dispatch import solve_contact
from pgfmd.solvers.options import Solver

DIGITS = 80
BASES = ("bonded", "free", "sliding")


def combinations(z: Decimal, q: Decimal, nu: Decimal) -> tuple[list[Decimal], ...]:
    """U, W, U', W' at height z as linear forms in four coefficients.  Waves u = (−i U(z), W(z)) exp(iqx) with W = (a +
    c z) cosh qz + (b + e z) sinh qz and −U = (b + e z + k c) cosh qz + (a + c z + k e) sinh qz, k = (3 − 4ν)/q, solve
    Navier's equations."""
    ch, sh = ((q * z).exp() + (-q * z).exp()) / 2, ((q * z).exp() - (-q * z).exp()) / 2
    k = (3 - 4 * nu) / q
    w = [ch, sh, z * ch, z * sh]
    dw = [q * sh, q * ch, ch + q * z * sh, sh + q * z * ch]
    u = [-sh, -ch, -k * ch - z * sh, -k * sh - z * ch]
    du = [-q * ch, -q * sh, -k * q * sh - sh - q * z * ch, -k * q * ch - ch - q * z * sh]
    return u, w, du, dw


def direct_stiffness(q: float, thickness: float, base: str, poisson: float) -> float:
    """Pressure per displacement of one wave on a slab of E' = 1: Navier's equations with boundary conditions.  Two
    conditions at the base z = 0; at the top z = d no shear stress and W = 1.  80 digits: nothing cancels."""
    with localcontext() as context:
        context.prec = DIGITS
        q, d, nu = Decimal(q), Decimal(thickness), Decimal(poisson)
        mu = (1 - nu) / 2  # from E' = 2μ/(1 − ν) = 1
        lam = 2 * mu * nu / (1 - 2 * nu)

        def stresses(z: Decimal) -> tuple[list[Decimal], list[Decimal]]:
            """σzz, and σxz but for a factor −i."""
            u, w, du, dw = combinations(z, q, nu)
            normal = [(lam + 2 * mu) * dw[i] + lam * q * u[i] for i in range(4)]
            return normal, [mu * (du[i] - q * w[i]) for i in range(4)]

        u, w, _, _ = combinations(Decimal(0), q, nu)
        normal, shear = stresses(Decimal(0))
        bottom = {"bonded": (u, w), "free": (normal, shear), "sliding": (w, shear)}[base]
        normal, shear = stresses(d)
        rows = [*bottom, shear, combinations(d, q, nu)[1]]
        coefficients = solve([list(row) for row in rows], [Decimal(0)] * 3 + [Decimal(1)])
        return float(sum(a * b for a, b in zip(normal, coefficients, strict=True)))


def solve(matrix: list[list[Decimal]], right: list[Decimal]) -> list[Decimal]:
    """Gauss's elimination with pivots; overwrites both."""
    for i in range(len(right)):
        pivot = max(range(i, len(right)), key=lambda row: abs(matrix[row][i]))
        matrix[i], matrix[pivot], right[i], right[pivot] = matrix[pivot], matrix[i], right[pivot], right[i]
        for row in range(len(right)):
            if row != i:
                factor = matrix[row][i] / matrix[i][i]
                matrix[row] = [a - factor * b for a, b in zip(matrix[row], matrix[i], strict=True)]
                right[row] -= factor * right[i]
    return [right[i] / matrix[i][i] for i in range(len(right))]


def test_the_reference_solves_navier():
    """(1−2ν)∇²u + ∇(∇·u) = 0 for each of the four waves, by differences of step 1e-20."""
    with localcontext() as context:
        context.prec = DIGITS
        q, nu, z, step = Decimal("1.3"), Decimal("0.3"), Decimal("0.8"), Decimal("1e-20")
        below, here, above = (combinations(z + shift * step, q, nu) for shift in (-1, 0, 1))
        for i in range(4):
            u, w, du, dw = (part[i] for part in here)
            u1, w1, u2, w2 = ((above[k][i] - below[k][i]) / (2 * step) for k in range(4))
            assert max(abs(u1 - du), abs(w1 - dw)) < Decimal("1e-35")
            assert abs((1 - 2 * nu) * (u2 - q * q * u) - q * (q * u + dw)) < Decimal("1e-35")
            assert abs((1 - 2 * nu) * (w2 - q * q * w) + q * du + w2) < Decimal("1e-35")


@pytest.mark.parametrize("base", BASES)
@pytest.mark.parametrize("poisson", [0.0, 0.25, 0.4999])
def test_slabs_have_the_stiffness_of_plane_strain(base, poisson):
    """(E'/2) q F(qd) for qd from 1e-3 to 50, to 1e-12; ν = 0.4999 and thin slabs included, where terms cancel."""
    thickness = 3.0
    t = np.array([1e-3, 3e-3, 0.01, 0.03, 0.049, 0.051, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 39.0, 41.0, 50.0])
    expected = [direct_stiffness(value / thickness, thickness, base, poisson) for value in t]
    found = elastic(1.0, thickness, base, poisson).stiffness(t / thickness)
    assert found == pytest.approx(expected, rel=1e-12, abs=0)


@pytest.mark.parametrize("base", BASES)
def test_thick_slabs_are_half_spaces(base):
    """Far below the surface nothing is felt; nothing overflows."""
    q = np.geomspace(1e-3, 1e3, 50)
    thick = elastic(2.0, 1e9, base, 0.3).stiffness(q)
    assert np.array_equal(thick, elastic(2.0).stiffness(q))


def test_at_the_paper_s_thickness_only_long_waves_shift():
    """d = λ_l: the longest wave (t = 2π) shifts by 3.3e-4 (bonded), −6.5e-4 (free), 9.5e-5 (sliding)."""
    shifts = [float(elastic(1.0, 1.0, base, 0.25).factor(np.array([2 * np.pi]))[0]) - 1 for base in BASES]
    assert shifts == pytest.approx([3.3e-4, -6.5e-4, 9.5e-5], rel=0.02)


def test_the_mean_mode_of_a_slab_is_uniaxial_strain():
    """dp̄/dū = (λ + 2μ)/d on a rigid base, 0 under a constant stress or for a half-space; compliance of q = 0 is 0."""
    lam = mu = 1.0
    solid = elastic(8 / 3, 4.0, "bonded", 0.25)
    assert solid.mean_stiffness() == pytest.approx((lam + 2 * mu) / 4.0, rel=1e-14, abs=0)
    assert elastic(8 / 3, 4.0, "sliding", 0.25).mean_stiffness() == pytest.approx(solid.mean_stiffness())
    assert elastic(8 / 3, 4.0, "free", 0.25).mean_stiffness() == elastic(8 / 3).mean_stiffness() == 0
    assert solid.compliance(np.zeros(1))[0] == solid.stiffness(np.zeros(1))[0] == 0


@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.49])
@pytest.mark.parametrize("base", BASES)
def test_the_stiffness_of_long_waves_has_a_limit(base, poisson):
    """stiffness(q) for q → 0, by its value at qd = 1e-9; a sliding slab may then widen, so that it is E'/d."""
    solid = elastic(2.0, 3.0, base, poisson)
    limit = solid.mean_stiffness(periodic=False)
    assert float(solid.stiffness(np.array(1e-9 / 3))) == pytest.approx(limit, rel=1e-7, abs=1e-15)
    assert elastic(2.0).mean_stiffness(periodic=False) == 0


@pytest.mark.parametrize("wrong", [
    {"contact_modulus": 0.0}, {"contact_modulus": math.nan}, {"contact_modulus": 1.0, "thickness": 0.0},
    {"contact_modulus": 1.0, "base": "glued"}, {"contact_modulus": 1.0, "poisson": 0.5},
    {"contact_modulus": 1.0, "poisson": -1.0},
])  # fmt: skip
def test_solids_that_cannot_be_are_refused(wrong):
    """Moduli, thickness, base and Poisson's ratio outside their range."""
    with pytest.raises(InputError, match="must"):
        elastic(**wrong)


RATIOS = [1e-6, 1e-3, 0.1, 1.0, 10.0, 1e3, 1e6]
POISSONS = [(0.0, 0.0), (0.25, 0.25), (0.4999, 0.1), (-0.5, 0.4999)]
T = [1e-3, 3e-3, 0.01, 0.03, 0.1, 0.3, 0.7, 1.0, 1.4, 1.6, 3.0, 10.0, 30.0, 49.0, 51.0]


def layered(ratio: float, poisson: tuple[float, float] = (0.25, 0.25), thickness: float = 1.0) -> Layered:
    """A layer of contact modulus 1 whose shear modulus is `ratio` times that of the half-space."""
    base = (1 - poisson[0]) / (1 - poisson[1]) / ratio
    return Layered(
        contact_modulus=1.0, poisson=poisson[0], thickness=thickness, base_modulus=base, base_poisson=poisson[1]
    )


def stresses(wave: tuple[list, ...], poisson: Decimal, modulus: Decimal) -> tuple[list, list]:
    """σzz, and σxz but for a factor −i, of waves (u, w, u', w') of q = 1 in a solid of that contact modulus."""
    u, w, du, dw = wave
    mu = modulus * (1 - poisson) / 2
    lam = 2 * mu * poisson / (1 - 2 * poisson)
    normal = [(lam + 2 * mu) * slope + lam * along for slope, along in zip(dw, u, strict=True)]
    return normal, [mu * (slope - up) for slope, up in zip(du, w, strict=True)]


def direct_factor(t: float, solid: Layered) -> float:
    """F of one wave, q = 1, d = t, from Navier's equations in layer and half-space: four waves in one, the two that
    decay in the other; displacements and stresses are continuous, no shear stress and W = 1 at the top."""
    with localcontext() as context:
        context.prec = DIGITS
        nu, below = Decimal(solid.poisson), Decimal(solid.base_poisson)
        bottom = combinations(Decimal(0), Decimal(1), nu)
        decaying = tuple([four[0] + four[1], four[2] + four[3]] for four in combinations(Decimal(0), Decimal(1), below))
        top = combinations(Decimal(t), Decimal(1), nu)
        layer = [*bottom[:2], *stresses(bottom, nu, Decimal(1))]
        base = [*decaying[:2], *stresses(decaying, below, Decimal(solid.base_modulus))]
        rows = [[*one, *(-value for value in two)] for one, two in zip(layer, base, strict=True)]
        normal, shear = stresses(top, nu, Decimal(1))
        rows += [[*shear, Decimal(0), Decimal(0)], [*top[1], Decimal(0), Decimal(0)]]
        coefficients = solve(rows, [Decimal(0)] * 5 + [Decimal(1)])
        return float(2 * sum(a * b for a, b in zip(normal, coefficients, strict=False)))  # over E' q/2


@pytest.mark.parametrize("poisson", POISSONS)
@pytest.mark.parametrize("ratio", RATIOS)
def test_the_symbol_is_that_of_plane_strain(ratio, poisson):
    """(E'/2) q F(qd) to 1e-13: soft on stiff, stiff on soft, thin, thick, nearly incompressible and auxetic."""
    solid = layered(ratio, poisson)
    assert solid.factor(np.array(T)) == pytest.approx([direct_factor(t, solid) for t in T], rel=1e-13, abs=0)


def test_published_values():
    """1/F(.5) of layers 10 and .1 times as stiff as the half-space, ν = 1/4."""
    found = [1 / float(layered(ratio).factor(np.array(0.5))) for ratio in (10.0, 0.1)]
    assert found == pytest.approx([6.662598255148012, 0.305849009274627], rel=1e-14, abs=0)


@pytest.mark.parametrize("poisson", [-0.5, 0.0, 0.25, 0.4999])
def test_limits_of_the_half_space(poisson):
    """Equal moduli: no layer.  A rigid one: the bonded slab.  A soft one: the slab with a free base.  The first is
    exact to rounding; the others differ by the ratio of the moduli over t³, below 1e-13 of F here."""
    q = np.geomspace(1e-3, 100, 200)
    assert np.abs(layered(1.0, (poisson, poisson)).factor(q) - 1).max() < 1e-15
    for ratio, base in ((1e-26, "bonded"), (1e26, "free")):
        expected = elastic(1.0, 1.0, base, poisson).factor(q)
        assert layered(ratio, (poisson, 0.3)).factor(q) == pytest.approx(expected, rel=1e-13, abs=0)


@pytest.mark.parametrize("ratio", RATIOS)
def test_limits_of_the_wave(ratio):
    """Long waves meet the half-space below, short ones that of the layer; nothing overflows.  Neither stops at rest."""
    solid = layered(ratio, (0.4, 0.1))
    longest, shortest = solid.stiffness(np.array([1e-12 * min(1, 1 / ratio), 1e12]))
    assert longest == pytest.approx(solid.base_modulus / 2 * 1e-12 * min(1, 1 / ratio), rel=1e-5)
    assert shortest == solid.half_space_stiffness(1e12) == 0.5e12
    assert solid.mean_stiffness() == solid.mean_stiffness(periodic=False) == 0
    scaled = solid.in_units(3.0, 0.1)
    assert scaled.stiffness(np.array(0.7)) == pytest.approx(30 * solid.stiffness(np.array(0.7)), rel=1e-14)


@pytest.mark.mpi
@pytest.mark.parametrize("transform", ["blocked", "mpi4py-fft"])
@pytest.mark.parametrize("ratio", [0.1, 30.0])
def test_a_contact_is_that_of_brute_force(comm, ratio, transform):
    """Pressures on 9 × 8 points against the quadratic program with the direct symbol: to the root of the tolerance."""
    if transform == "mpi4py-fft":
        pytest.importorskip("mpi4py_fft")
    heights, solid = np.random.default_rng(7).standard_normal((9, 8)), layered(ratio, (0.3, 0.2), thickness=2.0)
    grid = SlabGrid(comm, heights.shape, transform=transform)
    problem = under_hard_wall(grid, heights[grid.rows].copy(), 0.1, solid)
    found = solve_contact(problem, Solver(tolerance=1e-20))
    direct = reference.Solid(factor=lambda q: direct_factor(q * solid.thickness, solid))
    exact = reference.Contact(heights, solid=direct).hard(0.1)
    exact = 0.1 * exact.x.astype(float).reshape(heights.shape)
    assert np.abs(found.pressure - exact[grid.rows]).max() < 1e-8 * np.abs(exact).max()


def test_a_job_needs_poisson():
    """The moduli of the layer must fix Poisson's ratio; the rest of the job reads as ever."""
    text = (
        'grid.n = 8\nsurface = {kind = "sinusoid", amplitude = 1.0}\nload.pressure = 0.1\n'
        '[solid]\nkind = "layered"\nthickness = 2.0\nbase_modulus = 3.0\nbase_poisson = 0.2\n'
    )
    assert parse(text + "young = 1.0\npoisson = 0.3\n").solid.contact_modulus == pytest.approx(1 / 0.91, rel=1e-15)
    with pytest.raises(InputError, match=r"solid.contact_modulus = 1.0: .* needs poisson"):
        parse(text + "contact_modulus = 1.0\n")


JOB = """
grid.n = [12, 10]
surface = {kind = "self-affine", hurst = 0.8, lambda_s = 4.0, rms_slope = 0.1}
load.pressure = 0.01
solid = {kind = "table", path = "factor.csv", contact_modulus = 2.0}
"""


def tabulated(comm, path, q: np.ndarray, factor: np.ndarray) -> Graded:
    """The table, written by rank 0, as a solid of contact modulus 2."""
    once(comm, np.savetxt, path, np.column_stack([q, factor]), delimiter=",", fmt="%.17g", header="q, F")
    return Graded(path=str(path), contact_modulus=2.0)


@pytest.mark.mpi
@pytest.mark.parametrize("transform", ["blocked", "mpi4py-fft"])
@pytest.mark.parametrize("base", ["bonded", "free"])
def test_a_slab_by_its_values_at_the_grid_s_waves(comm, shared_tmp_path, base, transform):
    """With an entry for each |q| of the grid the stiffness is that of the slab to 1e-12, and so is the contact, to the
    root of its tolerance; on a rank's modes alike, though rank 0 alone reads the file."""
    if transform == "mpi4py-fft":
        pytest.importorskip("mpi4py_fft")
    grid, slab = SlabGrid(comm, (24, 20), (24.0, 30.0), transform=transform), elastic(2.0, 4.0, base, 0.3)
    waves = SlabGrid(comm, grid.shape, grid.lengths)
    q = np.unique(np.concatenate(comm.allgather(np.sqrt(waves.q_squared()).ravel())))[1:]
    graded = tabulated(comm, shared_tmp_path / "factor.csv", q, slab.factor(q))
    graded.prepare(grid)
    if comm.rank == 0:
        (shared_tmp_path / "factor.csv").unlink()  # no rank reads it again
    assert graded.stiffness(q) == pytest.approx(slab.stiffness(q), rel=1e-12, abs=0)
    heights = np.random.default_rng(3).standard_normal(grid.shape)[grid.rows].copy()
    found, expected = (
        solve_contact(under_hard_wall(grid, heights, 0.1, solid), Solver(tolerance=1e-20))
        for solid in (graded, slab)
    )
    assert np.abs(found.pressure - expected.pressure).max() < 1e-9 * grid.reduction.max(expected.pressure)
    assert found.mean_gap == pytest.approx(expected.mean_gap, rel=1e-9)


@pytest.mark.parametrize("poisson", [0.25, 0.49])
@pytest.mark.parametrize("thickness", [2.0, 20.0, 200.0])
@pytest.mark.parametrize("base", ["bonded", "free", "sliding"])
def test_a_slab_by_four_thousand_values(comm, tmp_path, base, thickness, poisson):
    """Between entries at equal ratios the cubic differs by 3e-10 from the slab, on all waves of a 512² grid; with a
    quarter of the entries by 4³ times that, as a third power."""
    slab, ends = elastic(2.0, thickness, base, poisson), (2 * np.pi / 512, np.sqrt(2) * np.pi)
    waves = np.linspace(*ends, 50_000)
    for count, close in ((4000, 1e-9), (1000, 6.4e-8)):
        q = np.geomspace(*ends, count)
        graded = tabulated(comm, tmp_path / "factor.csv", q, slab.factor(q))
        assert np.abs(graded.factor(waves) / slab.factor(waves) - 1).max() < close


def test_beyond_its_ends_it_is_a_half_space(comm, tmp_path, caplog):
    """F is that of the end, and the log says so if the grid has such waves; between entries it is monotone."""
    solid = tabulated(comm, tmp_path / "factor.csv", np.array([0.1, 0.2, 0.9, 1.0]), np.array([5.0, 5.0, 0.5, 0.1]))
    assert solid.factor(np.array([1e-9, 0.1, 0.15, 1.0, 1e9])) == pytest.approx([5, 5, 5, 0.1, 0.1], rel=1e-14)
    assert (np.diff(solid.factor(np.linspace(0.2, 1.0, 500))) < 0).all()
    assert solid.stiffness(1e9) == pytest.approx(solid.half_space_stiffness(1e9), rel=1e-14)
    assert solid.surface_modulus == pytest.approx(0.2, rel=1e-15) and solid.mean_stiffness() == 0
    assert solid.in_units(2.0, 0.5).stiffness(0.3) == pytest.approx(4 * solid.stiffness(0.3), rel=1e-14)
    with caplog.at_level(logging.INFO, "pgfmd"):
        solid.prepare(SlabGrid(comm, (32, 32)))
        assert "q = 0.19635 to 4.44288; below 0.1 F is 5, above 1 it is 0.1" in caplog.text
        caplog.clear()
        solid.prepare(SlabGrid(comm, (10, 10), (60.0, 60.0)))
        assert not caplog.text


@pytest.mark.mpi
@pytest.mark.parametrize(("lines", "words"), [
    ("1, 1\n2, 0\n", "all q and F(q) must be > 0"), ("1, 1\n2, -1\n", "> 0"), ("0, 1\n2, 1\n", "> 0"),
    ("2, 1\n1, 1\n", "larger than the one before"), ("1, 1\n1, 1\n", "larger"), ("1, nan\n2, 1\n", "finite"),
    ("1, 1\n", "at least two lines"), ("1 2 3\n1 2 3\n", "two columns"), ("words\n", "two columns"), (None, "read"),
])  # fmt: skip
def test_a_table_that_is_none_is_refused(comm, shared_tmp_path, lines, words):
    """One line that names the file, on all ranks."""
    path, rows = shared_tmp_path / "factor.csv", np.zeros((8, 8))[SlabGrid(comm, (8, 8)).rows].copy()
    if comm.rank == 0 and lines is not None:
        path.write_text(lines)
    comm.Barrier()
    with pytest.raises(InputError, match="factor.csv") as caught:
        pgfmd.solve(rows, 0.1, comm=comm, solid={"kind": "table", "path": str(path), "contact_modulus": 1.0})
    assert words in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.mpi
def test_a_job_s_table_is_found_checked_and_compared(comm, shared_tmp_path):
    """Its path counts from the job's folder; `check` describes it; a restart refuses a table that has changed."""
    folder = shared_tmp_path / "jobs"
    if comm.rank == 0:
        folder.mkdir()
        (folder / "job.toml").write_text(JOB)
    comm.Barrier()
    if comm.rank == 0:
        with pytest.raises(InputError, match=r"solid.path: no such file: .*jobs/factor.csv"):
            load(folder / "job.toml")
    tabulated(comm, folder / "factor.csv", np.array([0.5, 5.0]), np.array([2.0, 1.0]))
    job = load(folder / "job.toml")
    assert "solid      table: table of 2 entries, q from 0.5 to 5, F from 2 to 1" in Plan(job).report(1)
    simulate(job, comm, shared_tmp_path / "out")
    simulate(job, comm, shared_tmp_path / "out", restart=True)
    tabulated(comm, folder / "factor.csv", np.array([0.5, 5.0]), np.array([2.0, 1.1]))
    with pytest.raises(InputError, match=r"the content of .*factor.csv has changed"):
        simulate(job, comm, shared_tmp_path / "out", restart=True)
