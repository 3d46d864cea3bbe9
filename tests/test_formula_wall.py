"""A wall whose pressure is a formula of the gap: against the built-in exponential wall, brute force, and its limits."""

import math

import numpy as np
import pytest
from conftest import apart, broad
from contacts import elastic, rough_on
from job_texts import rough_job
from reference import Contact, Real

import pgfmd
from pgfmd.errors import InputError, SolverError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.options import expressions as formula
from pgfmd.physics.laws.derivative import compiled_pair
from pgfmd.physics.laws.exponential_law import ExponentialWall
from pgfmd.physics.laws.formula import FormulaWall
from pgfmd.physics.laws.hard import HardWall
from pgfmd.physics.laws.law import Units
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.dispatch import solve_contact
from pgfmd.solvers.load_control import LoadControl
from pgfmd.solvers.options import Load, Solver

pytestmark = pytest.mark.mpi

DIGITS = 1e-13  # of a point that is found to the last digits of pressure and gap


def solved(grid, heights, law, load, tolerance=1e-12, method="auto"):
    """The contact with a solid of modulus 1."""
    problem = ContactProblem(grid, heights, elastic(1.0), law, load)
    return solve_contact(problem, Solver(tolerance=tolerance, method=method))


@pytest.mark.parametrize("zeta", [0.02, 0.3])
def test_the_exponential_wall_as_a_formula(comm, zeta):
    """By the same dynamics the same pressure and gap to 1e-10, as both find the law's points to the last digits; an
    error that is certified no smaller, and at most 2.2 times as large (twice the excess, where the law is straight)."""
    grid, heights = rough_on(comm, (96, 80), 0.8, 8.0, 0.1, 2)
    law = FormulaWall(pressure=f"0.7 * exp(-gap / {zeta})", gaps=(-30 * zeta, 300 * zeta))
    ours = solved(grid, heights, law, 0.02, method="gfmd")
    known = solved(grid, heights, ExponentialWall(zeta=zeta, sigma_ref=0.7), 0.02, method="gfmd")
    assert apart(grid, ours, known) < 1e-10
    assert grid.reduction.max(np.abs(ours.gap - known.gap)) < 1e-10 * grid.reduction.max(np.abs(known.gap))
    assert ours.mean_gap == pytest.approx(known.mean_gap, rel=1e-10, abs=0)
    assert known.certified_error * (1 - 1e-6) <= ours.certified_error <= 2.2 * known.certified_error
    assert ours.threshold == pytest.approx(known.threshold, rel=1e-10, abs=0)


def test_newton_is_that_of_the_exponential_wall(comm):
    """Given as a formula, an exponential wall has the pressure of the built-in one, to the 1e-8 that a tolerance of
    1e-17 leaves, in as many iterations and at most a tenth more: only the digits of the law's gaps differ."""
    grid, heights = rough_on(comm, (96, 80), 0.8, 8.0, 0.1, 2)
    law = FormulaWall(pressure="0.7 * exp(-gap / 0.3)", gaps=(-9.0, 90.0))
    ours = solved(grid, heights, law, 0.02, 1e-17, "newton")
    known = solved(grid, heights, ExponentialWall(zeta=0.3, sigma_ref=0.7), 0.02, 1e-17, "newton")
    assert apart(grid, ours, known) < 1e-8
    assert ours.iterations <= 1.1 * known.iterations


STIFF = [
    "0.02 * (0.3 / gap)**9", "-0.9 * gap if gap < 0 else 0", "5 * gap**2 if gap < 0 else 0",
    "0.1 / (1 + exp(9 * gap))",
]  # fmt: skip


@pytest.mark.parametrize("text", STIFF)
def test_newton_agrees_with_dynamics(comm, text):
    """Power laws, springs and a saturating law: the pressure of dynamics to 1e-5, with at most half the transforms."""
    grid, heights = rough_on(comm, (64, 64), 0.8, 8.0, 0.1, 2)
    law = FormulaWall(pressure=text, gaps=(0.01, 60.0) if "/ gap" in text else (-2.0, 30.0))
    before = grid.transforms
    ours = solved(grid, heights, law, 0.02, method="newton")
    spent = grid.transforms - before
    known = solved(grid, heights, law, 0.02, method="gfmd")
    assert apart(grid, ours, known) < 1e-5
    assert spent <= (grid.transforms - before - spent) / 2


LAWS = {
    "power": ("0.01 * (0.5 / gap)**{n}", lambda g, n: 0.01 * (0.5 / g) ** n, (0.05, 50.0)),
    "spring": ("0.05 * {n} * (9 - gap) if gap < 9 else 0", lambda g, n: 0.05 * n * (9 - g), (-60.0, 20.0)),
    "exponential": ("0.1 * exp(-{n} * gap)", lambda g, n: 0.1 * np.exp(-n * g), (-3.0, 60.0)),
    "short": ("{n} * (0.4 - gap)", lambda g, n: n * (0.4 - g), (0.1, 0.4)),  # most points are out of its reach
}


@pytest.mark.mpi("breadth")
@pytest.mark.parametrize("law", LAWS)
def test_random_contacts_by_brute_force(comm, law):
    """Pressures of a tight solution obey the law where the gap is by a dense matrix in extended precision, to 1e-9 of
    the largest, as those of no other field with that mean do (the energy is convex).  Loosely solved, the error of the
    energy is not more than what is certified: with the dual energy φ as an integral of the gap over the pressure, by
    Gauss' rule between the two pressures of each point, to its 1e-12."""
    text, exact, gaps = LAWS[law]
    nodes, weights = np.polynomial.legendre.leggauss(40)
    for seed in range(4):
        random = np.random.default_rng([seed, len(law)])
        heights, load, n = random.standard_normal((12, 16)), 10 ** random.uniform(-3, 0), int(random.integers(1, 10))
        grid, contact = SlabGrid(comm, heights.shape), Contact(heights)
        wall = FormulaWall(pressure=text.format(n=n), gaps=gaps)
        whole = {}
        for tolerance in (1e-22, 1e-5):
            found = solved(grid, heights[grid.rows], wall, load, tolerance)
            whole[tolerance] = grid.fetch(found.pressure, 0, 12).astype(Real).ravel()
            bound = found.certified_error
            if tolerance < 1e-20:
                mean_gap, gap = found.mean_gap, grid.fetch(found.gap, 0, 12).ravel()
        tight, loose = whole.values()
        compliance = contact.compliance * contact.pixel  # displacements of pressures
        away = compliance @ tight - contact.heights
        away += mean_gap - away.mean()
        assert np.abs(away - gap).max() < 1e-9 * np.abs(gap).max(), seed
        inside = (tight < exact(gaps[0], n)) & (tight > 0)
        assert inside.any()
        assert np.abs(tight - exact(away.astype(float), n))[inside].max() < 1e-9 * tight.max(), seed
        low, high = exact(np.array(gaps), n)
        assert np.all(away[tight > low] < gaps[0] * (1 + 1e-9)) if high < low else True

        def gap_at(p, law=law, n=n):
            p = np.maximum(p.astype(float), 1e-300)
            inverse = {
                "power": lambda: 0.5 * (0.01 / p) ** (1 / n),
                "spring": lambda: 9 - p / 0.05 / n,
                "exponential": lambda: -np.log(p / 0.1) / n,
                "short": lambda: 0.4 - p / n,
            }[law]()
            return np.clip(inverse, *gaps)

        change = loose - tight
        between = tight[:, None] + change[:, None] * (1 + nodes) / 2
        dual = -(gap_at(between) @ weights) * change / 2
        lost = away @ change + change @ (compliance @ change) / 2 + dual.sum()
        assert lost <= (bound + 1e-12) * (tight @ (compliance @ tight)), seed
        assert lost >= -1e-12 * (tight @ (compliance @ tight)), seed


def test_its_ends(comm):
    """Closer than the first of `gaps` is a hard wall, beyond the second is nothing: p ≥ P(first) at the first, ≤
    P(second) at the second, 0 beyond, and P in between, gaps to 1e-6 of the rms height (pressures are to 1e-6)."""
    grid, heights = rough_on(comm, (64, 64), 0.8, 8.0, 0.1, 4)
    law = FormulaWall(pressure="0.05 - 0.02 * gap", gaps=(0.5, 1.5))
    found = solved(grid, heights, law, 0.03, 1e-16)
    p, g, small = found.pressure, found.gap, 1e-6 * math.sqrt(grid.reduction.sum(heights**2) / grid.size)
    closed, end, beyond, between = p > 0.04, (p > 0) & (p < 0.02), p == 0, (p > 0.02) & (p < 0.04)
    for part in (closed, end, beyond, between):
        assert grid.reduction.sum(part) > 20
    assert np.all(np.abs(g[closed] - 0.5) < small) and np.all(np.abs(g[end] - 1.5) < small)
    assert np.all(g[beyond] > 1.5 - small) and np.all(np.abs(g - (0.05 - p) / 0.02)[between] < small)


def test_a_wall_that_is_weak_before_it_closes_is_hard(comm):
    """With P ≤ 1e-9 p̄ before the gap is 0, pressures are those of the hard wall, to the 1e-5 of dynamics."""
    grid, heights = rough_on(comm, (64, 64), 0.8, 8.0, 0.1, 4)
    ours = solved(grid, heights, FormulaWall(pressure="1e-11 * (1 - gap)", gaps=(0, 1)), 0.01)
    hard = solved(grid, heights, HardWall(), 0.01)
    assert apart(grid, ours, hard) < 1e-5
    assert ours.mean_gap == pytest.approx(hard.mean_gap, rel=1e-5, abs=0)


def test_loads_and_gaps_of_a_formula(comm):
    """A mean gap and a displacement are met, to the tolerance asked for."""
    grid, heights = rough_on(comm, (32, 32), 0.8, 8.0, 0.1, 1)
    law = FormulaWall(pressure="0.1 * (0.5 / gap)**9", gaps=(0.05, 20))
    found = solved(grid, heights, law, 0.05, 1e-10)
    problem = ContactProblem(grid, heights, elastic(1.0), law)
    again = LoadControl(Load(mean_gap=(found.mean_gap,)), problem).solution(found.mean_gap)
    assert again.mean_gap == pytest.approx(found.mean_gap, rel=1e-3, abs=0)
    assert again.mean_pressure == pytest.approx(0.05, rel=1e-2, abs=0)
    with pytest.raises(InputError, match="contact_area"):
        LoadControl(Load(contact_area=(0.1,)), problem).check_targets((0.1,))


def test_a_mean_gap_may_be_negative():
    """A wall that bears little at the gap 0 is penetrated on average: the mean gap is that of the field, below 0."""
    heights = 0.1 * np.random.default_rng(1).standard_normal((8, 8))
    found = pgfmd.solve(heights, 0.5, wall={"kind": "formula", "pressure": "0.1 * exp(-gap)", "gaps": [-3, 9]})
    assert found.mean_gap < -1 and found.mean_gap == pytest.approx(found.gap.mean(), rel=1e-6)


@pytest.mark.parametrize("where", [{"thickness": 2.0, "poisson": 0.4}, {"boundary": "open"}])
@pytest.mark.parametrize("far", [1e2, 1e9, 1e12])
def test_a_displacement_keeps_its_digits_under_a_wall_that_is_felt_far_away(where, far):
    """The load comes back from its displacement, wherever the wall ends: the search counts from there, but without
    taking the difference of logarithms of numbers that are equal to nine digits."""
    heights = 0.3 * np.random.default_rng(1).standard_normal((12, 12))
    wall = {"kind": "formula", "pressure": "0.3 / (1 + gap)**3", "gaps": [-0.9, far]}
    for load in (0.02, 0.4):
        known = pgfmd.solve(heights, load, wall=wall, **where)
        found = pgfmd.solve(heights, displacement=known.displacement, wall=wall, **where)
        assert found.mean_pressure == pytest.approx(load, rel=1e-4)


RANGES = {
    "0.5 / (1 + exp(3 * gap))": ((-10, 12), lambda p: 1 / (3 * (1 - 2 * p)), (1e-12, 0.49, 0.4999999)),
    "0.1 * (0.5 / gap)**9": ((0.05, 20), lambda p: 0.5 * (0.1 / p) ** (1 / 9) / 9, (1e-10, 0.1, 1e5)),
    "2 - gap if gap < 1 else 0.8 / gap": ((0.1, 5), lambda p: p if p > 1 else 0.8 / p * (p < 0.8), (0.5, 0.9, 1.5)),
    "0.05 * (9 - gap) if gap < 9 else 0": ((-60, 20), lambda p: p / 0.05, (1e-9, 0.1, 3.0)),
}


@pytest.mark.parametrize("text", RANGES)
def test_the_range_is_that_at_a_pressure(text):
    """−p/(dp/dgap), in any units, by hand; 0 in a jump and where the wall is closed.  It is constant between the nodes
    of the table, which are 1/256 of the gaps apart at most: to 15 %, as on the plateau it grows by exp(3 · 22/256)."""
    gaps, exact, pressures = RANGES[text]
    law = FormulaWall(pressure=text, gaps=gaps)
    for p in pressures:
        units = Units(0.7, p, law.gap(p, None))
        assert law.range_at(p) == pytest.approx(exact(p), rel=0.15, abs=1e-9)
        assert law.in_units(units).range_at(1.0) == pytest.approx(law.range_at(p) / 0.7, rel=1e-9, abs=1e-9)
    assert law.range_at(1e9) == 0


@pytest.mark.mpi("breadth")
@pytest.mark.parametrize(
    ("control", "high"), broad([(control, high) for high in (8.0, 8.9) for control in ("mean_gap", "displacement")], 2)
)
def test_gaps_beyond_its_ends_are_refused(comm, control, high):
    """Between its smallest gap, where contact is full, and first touch at its largest, where the formula becomes 0;
    with `--all` a tenth below that one, where Newton's method takes hundreds of steps."""
    grid, heights = rough_on(comm, (16, 16), 0.8, 8.0, 0.1, 1)
    summit = grid.reduction.max(heights) - grid.reduction.sum(heights) / grid.size
    law = FormulaWall(pressure="0.05 * (9 - gap) if gap < 9 else 0", gaps=(2, 20))
    problem = ContactProblem(grid, heights, elastic(1.0), law)
    for gap, message in ((2.0, "contact is full"), (9.001 + summit, "the wall ends and bears no load")):
        target = gap if control == "mean_gap" else summit - gap
        with pytest.raises(InputError, match=message):
            LoadControl(Load(**{control: (target,)}), problem).solution(target)
    for gap in (2.001, 2 + summit, high + summit):  # at the second, the approach that counts is 0
        target = gap if control == "mean_gap" else summit - gap
        found = LoadControl(Load(**{control: (target,)}), problem).solution(target)
        assert found.mean_gap == pytest.approx(gap, rel=1e-5, abs=0)


@pytest.mark.parametrize("text", ["(0.3 / gap)**7", "exp(-gap)", "2 - gap if gap < 1 else 0.8 / gap", "erfc(gap)"])
@pytest.mark.parametrize("compliance", [1e-3, 1.0, 1e3])
def test_points_of_the_graph(text, compliance):
    """Points obey α p − g = t and lie on the graph, to the last digits of the gap, or between both sides of a jump."""
    random = np.random.default_rng(5)
    gaps = (0.1, 2.0)
    law = FormulaWall(pressure=text, gaps=gaps)
    units = Units(0.7, 0.3, law.gap(0.3, None))
    scaled, of = law.in_units(units), formula.function(text, "gap")
    target, pressure = random.uniform(-9, 3 + compliance, (3, 200)), np.empty((3, 200))
    total, slope = scaled.respond(target, pressure, compliance, 0.5)
    more = np.empty_like(pressure)
    up, _ = scaled.respond(target, more, compliance, 0.5 + 1e-6)
    assert total == pytest.approx(pressure.sum(), rel=1e-13)
    assert slope == pytest.approx((up - total) / 1e-6, rel=1e-3)
    for t, p in zip(target.flat, pressure.flat, strict=True):
        gap = (compliance * p - t - 0.5) * units.height + units.offset
        close = DIGITS * (1 + compliance * p)
        above = math.inf if gap - close <= gaps[0] else of(gap - close) if gap - close <= gaps[1] else 0.0
        below = 0.0 if gap + close >= gaps[1] else of(gap + close) if gap + close >= gaps[0] else of(gaps[0])
        assert below * (1 - DIGITS) <= p * units.pressure <= above * (1 + DIGITS)


WRONG = {
    "gap": "goes from",
    "1 / gap": "is inf at gap 0",
    "log(gap + 1)": "goes from 0",
    "sqrt(0.5 - gap)": "is nan at gap",
    "0.5 - gap": "must be finite and not negative",
    "(0.5 - gap)**0.5": "is nan at gap",
    "exp(-gap) + 1e30": "must decrease",
    "0 * gap": "is 0 at gap 0",
    "exp(1000 - gap)": "is inf at gap 0",
    "__import__('os').system('true')": "must be a formula of gap",
    "gap.real": "must be a formula of gap",
    "exp": "must be a formula of gap",
    "exp(gap, 2)": "must be a formula of gap",
    "max(*gap)": "must be a formula of gap",
    "gap if True else 1": "must be a formula of gap",
    "x": "must be a formula of gap",
    "9**9**9**9 - gap": "is inf at gap 0",
    "1e300 * 10**400 - gap": "is inf at gap 0",
    str(10**400) + " - gap": "must be a formula of gap",
    "1 +": "must be a formula of gap",
    "1) + (2": "must be a formula of gap",
    "(" * 300 + "gap" + ")" * 300: "must be a formula of gap",
    "gap**" + "-" * 990 + "1": "must be a formula of gap",  # signs nested deeper than Python's stack
    "gap**" + "-" * 1200 + "1": "must be a formula of gap",
    3: "must be a formula of gap",
}


@pytest.mark.parametrize("text", WRONG, ids=lambda text: str(text)[:20])
def test_what_is_no_wall_is_refused_in_one_line(text):
    """Also where Python would raise an error or leave the real numbers; and none of it is run that is no formula."""
    with pytest.raises(InputError, match=WRONG[text]) as error:
        FormulaWall(pressure=text, gaps=(0, 1))
    assert str(error.value).startswith("wall.pressure = ") and "\n" not in str(error.value)


def test_a_comment_ends_a_formula():
    """It is no part of it, also if it has a bracket."""
    assert formula.function("2 / (1 + gap)  # )", "gap")(0.5) == pytest.approx(4 / 3, rel=1e-15, abs=0)


@pytest.mark.parametrize(
    ("text", "expected"), [("gap**-9", -9), ("gap**9", 9), ("gap**+(-(2))", 2), ("gap**1001", 1001.0)]
)
def test_whole_exponents_stay_whole(text, expected):
    """Signed or not, as compiled code then multiplies; all other numbers are real."""
    constants = [c for c in formula.function(f"2 * {text}", "gap").__code__.co_consts if isinstance(c, (int, float))]
    assert [abs(c) for c in constants] == [2.0, abs(expected)]
    assert [type(c) for c in constants] == [float, type(expected)]


@pytest.mark.parametrize("gaps", [(1, 0), (1, 1), 2.0, None, (0, math.inf), (0, math.nan)])
def test_gaps_are_two_numbers(gaps):
    """The smaller first, both finite."""
    with pytest.raises(InputError, match=r"wall\.gaps"):
        FormulaWall(pressure="exp(-gap)", gaps=gaps)


def test_the_table_is_dense():
    """Pressures fall by a tenth at most between nodes, but in a jump, whose nodes touch; ranges are those by hand."""
    law = FormulaWall(pressure="exp(-40 * gap) if gap < 0.7 else 1e-20 * (2 - gap)", gaps=(0.0, 1.5))
    graph = law.graph
    steep = graph.pressures[:-1] > 1.1 * graph.pressures[1:]
    assert np.count_nonzero(steep) == 1 and np.diff(graph.gaps)[steep] < 1e-15
    for p in 1e-20 * np.array([0.5, 0.8, 1.29]):
        assert law.range_at(p) == pytest.approx(p / 1e-20, rel=1e-7)  # 2 − g beyond the jump
    for p in (0.9, 1e-6, math.exp(-27)):
        assert law.range_at(p) == pytest.approx(1 / 40, rel=1e-7)  # before it
    assert all(law.range_at(p) == 0 for p in (2.0, 1e-21, 1e-16))


FORMULAS = (
    "(0.3 / gap)**7", "exp(-gap) + 2 * exp(-gap)**2", "gap**-2.5", "1 / gap**3 - 1e-9 * gap", "erfc(gap) + 2**-gap",
    "min(2 - gap, 0.8 / gap, 5)", "max(1 - gap, 0) + abs(gap - 3)", "sqrt(9 - gap) - atan(gap) + pi",
    "-log1p(gap) - log(gap) + 9", "1 / sinh(gap) + 1 / cosh(gap) - tanh(gap) - expm1(gap) + 1e3 - erf(gap)",
    "2 - gap if gap < 1 else 0.8 / gap if 1 <= gap < 2 else (gap > 2) * 0.1 / gap", "9 - +gap - (-(gap))**+(3) / -9",
)  # fmt: skip


@pytest.mark.parametrize("text", FORMULAS)
def test_the_derivative(text):
    """The compiled value is Python's to 1e-13, and the derivative its central difference to 1e-7."""
    of, gaps, scales = formula.function(text, "gap"), np.linspace(0.205, 2.815, 51), (0.7, 0.3, 0.1)
    x = (gaps - 0.1) / 0.7
    value, slope = np.empty((2, len(x)))
    compiled_pair(text)(x, scales, value, slope)
    exact, near = (np.array([of(g + away) for g in gaps]) for away in (0.0, 1e-5))
    before = np.array([of(g - 1e-5) for g in gaps])
    assert np.abs(value * 0.3 / exact - 1).max() < 1e-13
    assert np.abs(slope * 0.3 / 0.7 - (near - before) / 2e-5).max() < 1e-7 * np.abs(near - before).max() / 2e-5


def test_from_a_job_file_and_from_python(tmp_path, comm):
    """The same contact, at the loads of a job and by `pgfmd.solve`: pressures to the last digits."""
    path, wall = comm.bcast(tmp_path), {"kind": "formula", "pressure": "0.1 * (0.5 / gap)**9", "gaps": [0.05, 20]}
    if comm.rank == 0:
        parts = {"load": {"pressure": [0.02, 0.05]}, "output": {"fields": ["pressure"]}, "wall": wall}
        (path / "own.toml").write_text(rough_job(64, {"lambda_s": 8.0}, solid={"contact_modulus": 1.0}, **parts))
    comm.barrier()
    results = pgfmd.run(path / "own.toml", path / "own", comm=comm)
    heights = pgfmd.surface(path / "own.toml", comm)
    for load, contact in zip(results, pgfmd.solve(heights, [0.02, 0.05], wall=wall, comm=comm), strict=True):
        rows = contact.problem.grid.rows
        assert np.abs(load.field("pressure")[rows] - contact.pressure).max() < 1e-12 * contact.pressure.max()
        assert results.job["wall"]["pressure"] == wall["pressure"]
    comm.barrier()


def test_newton_serves_open_boundaries():
    """On a patch an exponential wall given as a formula has the pressure of the built-in one."""
    rough = {"kind": "self-affine", "hurst": 0.8, "lambda_s": 8.0, "rms_slope": 0.1}
    heights = pgfmd.surface({"grid": {"n": 32}, "surface": rough})
    built_in = pgfmd.solve(heights, 0.02, zeta=0.3, boundary="open", tolerance=1e-12)
    wall = {"kind": "formula", "pressure": "exp(-gap / 0.3)", "gaps": [-3.0, 30.0]}
    found = pgfmd.solve(heights, 0.02, wall=wall, boundary="open", tolerance=1e-12)
    assert found.certified_error < 1e-12
    np.testing.assert_allclose(found.pressure, built_in.pressure, atol=1e-5 * built_in.pressure.max())


@pytest.mark.parametrize("pressure", [".1 / gap**9", "exp(-gap / .01)"])
@pytest.mark.parametrize("load", [1e-100, 1e-30, 1e30])
@pytest.mark.filterwarnings("error")
def test_a_load_far_from_the_wall_s_is_one_line(pressure, load):
    """Iterations that overflow or underflow make no warning, on one thread or two; one line says why it ends."""
    wall = {"kind": "formula", "pressure": pressure, "gaps": [0.02, 40.0]}
    heights = np.random.default_rng(0).standard_normal((16, 16))
    for threads in (1, 2):
        with pytest.raises(SolverError, match="^load.pressure = "):
            pgfmd.solve(heights, load, contact_modulus=1.0, wall=wall, threads=threads)
