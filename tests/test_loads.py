"""Loads found from a contact area, a mean gap or a displacement."""

import math

import numpy as np
import pytest
from contacts import elastic, under_hard_wall

from pgfmd.errors import InputError, SolverError, Unreachable
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.physics.laws.exponential_law import ExponentialWall
from pgfmd.physics.laws.hard import HardWall
from pgfmd.physics.problem import Aim, ContactProblem, Imposed, Measured
from pgfmd.solvers.controls import CONTROLS
from pgfmd.solvers.dispatch import solve_contact
from pgfmd.solvers.load_control import LoadControl
from pgfmd.solvers.options import Load, Solver
from pgfmd.surfaces.self_affine import self_affine
from pgfmd.surfaces.sinusoid import sinusoid

pytestmark = pytest.mark.mpi

SOLID = elastic(8 / 3)
GAPS = ("displacement", "mean_gap")


class Counted:
    """`LoadControl` of a surface, how often it solved, and whether from a start."""

    def __init__(self, control, grid, heights, solid=SOLID, wall=None, tolerance=1e-6, **keywords):
        self.solves, self.starts = 0, []

        def solve(problem, start, tolerance):
            self.solves += 1
            self.starts.append(start is not None)
            return solve_contact(problem, Solver(tolerance=tolerance), start)

        problem = ContactProblem(grid, heights, solid, wall or HardWall())
        self.loads = LoadControl(Load(**{control: [0.5]}, **keywords), problem, tolerance, solve)

    def solution(self, target):
        return self.loads.solution(target)


@pytest.mark.parametrize("tolerance", [1e-2, 1e-3])
def test_an_area_takes_one_solution_at_a_loose_tolerance(comm, tolerance):
    """The solver knows areas to .5 % even where it is asked for an energy to 1 % only; no search follows."""
    grid, solves = SlabGrid(comm, (128, 128)), 0
    for seed in (1, 2, 3, 4, 5):
        heights = self_affine(grid, 0.8, 4.0, 0.031, seed)
        for target in (0.02, 0.05, 0.2):
            counted = Counted("contact_area", grid, heights, tolerance=tolerance)
            counted.solution(target)
            solves += counted.solves
    assert solves == 15


@pytest.fixture(scope="module")
def rough(comm):
    grid = SlabGrid(comm, (64, 64))
    return grid, self_affine(grid, 0.8, 4.0, 0.031, 3)


def test_areas_are_met_within_half_a_per_cent_in_few_solutions(rough):
    """|A − target| ≤ 0.5 % or 1 pixel from 1 % to 95 %, in at most 6 solutions on average, the last certified."""
    grid, heights = rough
    counted = Counted("contact_area", grid, heights)
    targets = (0.01, 0.04, 0.08, 0.3, 0.6, 0.95)
    for target in targets:
        found = counted.solution(target)
        area = grid.reduction.sum(found.pressure > 0) / grid.size
        assert abs(area - target) <= max(0.005 * target, 1 / grid.size)
        assert found.certified_error <= 1e-6
    assert counted.solves <= 6 * len(targets)


@pytest.mark.parametrize(("control", "target"), [
    ("contact_area", 0.1), ("contact_area", 0.6), ("contact_area", 0.8),
    ("mean_gap", 0.7), ("mean_gap", 0.01), ("displacement", 0.3),
])  # fmt: skip
def test_under_a_hard_wall_one_solution_meets_a_target(rough, control, target):
    """The solver prescribes the level of contact, or the mean gap: one call, whose load gives the target by itself."""
    grid, heights = rough
    rms = math.sqrt(grid.reduction.dot(heights, heights) / grid.size)
    counted = Counted(control, grid, heights)
    target *= 1 if control == "contact_area" else rms
    found = counted.solution(target)
    assert counted.solves == 1
    problem = under_hard_wall(grid, heights, found.mean_pressure, SOLID)
    again = solve_contact(problem, Solver(tolerance=1e-12))
    area = grid.reduction.sum(again.pressure > 0) / grid.size
    value = {"contact_area": area, "mean_gap": again.mean_gap, "displacement": again.approach}[control]
    assert value == pytest.approx(target, rel=1e-4 if control != "contact_area" else 0.01, abs=0)


def test_a_load_does_not_depend_on_the_loads_before(rough):
    """Up and down a sequence of pressures, warm and cold: pressures agree to 1e-8, contact is the same."""
    grid, heights = rough
    counted = Counted("pressure", grid, heights, tolerance=1e-18)
    for load in (0.004, 0.00402, 0.0041, 0.02, 0.0199, 0.0041, 0.00402, 0.004):
        found = counted.solution(load)
        cold = solve_contact(under_hard_wall(grid, heights, load, SOLID), Solver(tolerance=1e-18))
        apart = found.pressure - cold.pressure
        assert math.sqrt(grid.reduction.dot(apart, apart) / grid.reduction.dot(cold.pressure, cold.pressure)) < 1e-8


@pytest.mark.parametrize(("step", "starts"), [(1.001, True), (1.02, False)])
def test_a_load_starts_from_its_neighbour_where_that_pays(comm, step, starts):
    """Under a hard wall on a half-space loads .1 % apart start from each other, loads 2 % apart do not."""
    grid = SlabGrid(comm, (32, 32))
    counted = Counted("pressure", grid, self_affine(grid, 0.8, 8.0, 0.1, 1))
    for load in (0.01, 0.01 * step):
        counted.solution(load)
    assert counted.starts == [False, starts]


def test_threads_make_no_collective_call(comm, monkeypatch):
    """Threads sum heights in bands; no collective call is made there, as threads of other ranks have other orders."""
    grid = SlabGrid(comm, (32, 8))
    heights = 3.0 + self_affine(grid, 0.8, 8.0, 0.1, 1)
    control = CONTROLS["contact_area"](under_hard_wall(grid, heights, solid=SOLID), Load(contact_area=(0.1,)))
    within, calls, collect, kind = [], [], grid.threads.collect, type(grid.reduction)

    def watched(*arguments):
        within.append(True)
        calls.append(True)
        try:
            return collect(*arguments)
        finally:
            within.pop()

    one = kind._one

    def counted(self, *arguments):
        assert not within
        return one(self, *arguments)

    monkeypatch.setattr(grid.threads, "collect", watched)
    monkeypatch.setattr(kind, "_one", counted)
    rms = control.rms_height
    assert len(calls) == 2  # for the mean and for the rms height
    exact = math.sqrt(grid.reduction.dot(heights - 3, heights - 3) / grid.size)
    assert rms == pytest.approx(exact, rel=1e-12)  # rounding of 256 squares


@pytest.mark.parametrize("target", [0.125, 0.375, 0.55, 0.6875, 0.9375])
def test_where_an_area_jumps_the_load_is_that_of_the_jump(comm, target):
    """At loads 3e-4 below and above the one that is found (the search ends within 1e-4), a wave's area is below and
    above a target that no load gives: rows come into contact two by two, one each side of the crest.  The area that is
    found is that of the nearer side, within a row of the target."""
    grid = SlabGrid(comm, (32, 4))
    heights = sinusoid(grid, 1.0, (1, 0))
    found = Counted("contact_area", grid, heights).solution(target)
    assert abs(grid.reduction.sum(found.pressure > 0) / grid.size - target) <= 1 / 32
    areas = []
    for load in found.mean_pressure * np.array([1 - 3e-4, 1 + 3e-4]):
        near = solve_contact(under_hard_wall(grid, heights, load, SOLID), Solver(tolerance=1e-14))
        areas.append(grid.reduction.sum(near.pressure > 0) / grid.size)
    assert areas[0] < target < areas[1]


@pytest.mark.parametrize("gap", [2.0, 0.7, 0.1, 0.01])
def test_mean_gaps_are_met(rough, gap):
    """⟨u − h⟩ to 1e-5 of the rms height, for a hard wall."""
    grid, heights = rough
    rms = math.sqrt(grid.reduction.dot(heights, heights) / grid.size)
    found = Counted("mean_gap", grid, heights, gap_tolerance=5e-6).solution(gap * rms)
    assert found.mean_gap == pytest.approx(gap * rms, abs=1e-5 * rms)
    assert grid.reduction.sum(found.gap) / grid.size == pytest.approx(gap * rms, abs=2e-5 * rms)


def test_mean_gaps_under_an_exponential_wall_may_be_negative(rough):
    """A soft wall lets the surfaces overlap."""
    grid, heights = rough
    found = Counted("mean_gap", grid, heights, wall=ExponentialWall(zeta=0.1, sigma_ref=1.0)).solution(-0.05)
    assert grid.reduction.sum(found.gap) / grid.size == pytest.approx(-0.05, abs=1e-5)


def test_westergaard_s_approach_gives_westergaard_s_load(comm):
    """h = Δ cos: approach Δ(f − f ln f) from first touch needs f = p̄/p*, to the discretisation error at n = 256."""
    grid, f = SlabGrid(comm, (256, 8)), 0.3
    found = Counted("displacement", grid, sinusoid(grid, 1.0, (1, 0))).solution(f - f * math.log(f))
    assert found.mean_pressure / (np.pi * 8 / 3 / 256) == pytest.approx(f, rel=1e-4, abs=0)


def test_the_far_side_of_a_slab_moves_by_its_own_compression_too(rough):
    """On a bonded slab the displacement is h_max − ⟨u⟩ + p̄ d/(λ + 2μ); beyond full contact it goes on."""
    grid, heights = rough
    thickness = 50.0
    slab = elastic(8 / 3, thickness, "bonded", 0.25)  # λ = μ = 1
    summit = grid.reduction.max(heights)
    for target in (0.5 * summit, 3 * summit):
        found = Counted("displacement", grid, heights, slab).solution(target)
        expected = summit - found.mean_gap + found.mean_pressure * thickness / 3
        assert expected == pytest.approx(target, rel=1e-4, abs=0)


def test_out_of_touch_there_is_no_load(rough):
    """Displacements up to 0 and gaps above the summit leave a hard wall unloaded, and apart by what is imposed."""
    grid, heights = rough
    summit, mean = grid.reduction.max(heights), grid.reduction.sum(heights) / grid.size
    apart = {"displacement": (-1.0, summit + 1.0), "mean_gap": (2 * summit, 2 * summit + mean)}  # target, plane
    for control, (target, plane) in apart.items():
        found = Counted(control, grid, heights).solution(target)
        assert found.mean_pressure == 0 and grid.reduction.max(found.pressure) == 0
        assert grid.reduction.max(np.abs(found.gap - (plane - heights))) <= 1e-12 * summit
        assert found.mean_gap == pytest.approx(plane - mean, rel=1e-12, abs=0)
        assert found.approach == pytest.approx(summit - plane, rel=1e-12, abs=0)


@pytest.mark.parametrize(("control", "target", "options", "error", "reason"), [
    ("mean_gap", 0.0, {}, InputError, "contact is full"), ("mean_gap", -1.0, {}, InputError, "contact is full"),
    ("displacement", 1e3, {}, InputError, "contact is full"),
    *((each, 0.3, {"gap_tolerance": 1e-16}, SolverError, "load.gap_tolerance = 1e-16") for each in GAPS),
    *((each, 1e-300, {}, (InputError, SolverError), r"must lie between|load\.mean_gap = 1e-300") for each in GAPS),
])  # fmt: skip
def test_what_no_load_gives_is_refused(rough, control, target, options, error, reason):
    """Closed gaps and approaches beyond full contact do not fix the load on a half-space.  What cannot be certified is
    refused by the key that asks for it; so are a displacement that needs less than 1e-120 E' and a gap that is 0 to
    rounding."""
    with pytest.raises(error, match=reason):
        Counted(control, *rough, **options).solution(target)


def test_a_guess_has_no_unit_of_length(comm):
    """The pressure guessed for a mean gap is the same if all lengths are ten times as long."""

    def guess(scale: float) -> float:
        grid = SlabGrid(comm, (32, 32), (32.0 * scale, 32.0 * scale))
        problem = under_hard_wall(grid, self_affine(grid, 0.8, 8.0 * scale, 0.1, 1), 0.01, SOLID)
        control = CONTROLS["mean_gap"](problem, Load(mean_gap=[1.0]))
        return control.guess(control.rms_height)

    assert guess(10.0) == pytest.approx(guess(1.0), rel=1e-9)


def test_controls_that_make_no_sense_are_refused(rough):
    """Areas under an exponential wall, and a flat surface."""
    grid, heights = rough
    with pytest.raises(InputError, match="touches everywhere"):
        Counted("contact_area", grid, heights, wall=ExponentialWall(zeta=1.0))
    with pytest.raises(InputError, match="flat"):
        Counted("mean_gap", grid, 0 * heights).solution(0.5)


@pytest.mark.parametrize("scale", [1e-60, 1e-6, 1e-3, 0.3, 0.97])
def test_the_load_at_an_approach_is_right_to_the_tolerance(rough, scale):
    """A displacement and the mean gap that belongs to it give one load, to the tolerance that both were given.  d ln
    p̄/d ln(approach) lies between 1 (few points touch) and some 5 (nearly full contact, where the tolerance is relative
    to the gap that is left): loads agree to 10 tolerances."""
    grid, heights = rough
    summit = grid.reduction.max(heights) - grid.reduction.sum(heights) / grid.size
    one = Counted("displacement", grid, heights, gap_tolerance=1e-3).solution(scale * summit)
    assert one.approach == pytest.approx(scale * summit, rel=1e-3, abs=0)
    if scale < 1e-6:
        return  # the mean gap is that of first contact, to a double's rounding
    two = Counted("mean_gap", grid, heights, gap_tolerance=1e-3).solution(one.mean_gap)
    assert two.mean_pressure == pytest.approx(one.mean_pressure, rel=1e-2, abs=0)


def test_the_search_counts(rough):
    """Transforms, iterations and seconds of a target are those of all its solutions: here several."""
    grid, heights = rough
    solutions = []

    def solve(problem, start, tolerance):
        solutions.append(solve_contact(problem, Solver(tolerance=tolerance), start))
        return solutions[-1]

    problem = ContactProblem(grid, heights, SOLID, ExponentialWall(zeta=0.1, sigma_ref=1.0))
    found = LoadControl(Load(mean_gap=[0.3]), problem, 1e-6, solve).solution(0.3)
    assert len(solutions) > 1
    assert found.transforms == pytest.approx(sum(each.transforms for each in solutions))
    assert found.iterations == sum(each.iterations for each in solutions)


@pytest.mark.parametrize("control", ["pressure", "mean_gap"])
def test_a_failure_names_the_key_that_asked_for_the_tolerance(rough, control):
    """It names solver.tolerance and the load where rounding forbids them, not a tolerance of the search's own."""
    counted = Counted(control, *rough, tolerance=1e-40)
    with pytest.raises(SolverError, match=f"load.{control} = 0.3: solver.tolerance = 1e-40: .*(rounding|digits)"):
        counted.solution(0.3)
    if control == "mean_gap":

        def fail(*_):
            raise SolverError("no")

        counted = Counted(control, *rough, tolerance=1e-8)
        counted.loads.solver = fail
        with pytest.raises(SolverError, match="load.mean_gap = 0.3: not even a certified error of 1e-05 .* way: no"):
            counted.solution(0.3)


@pytest.mark.parametrize("tolerance", [1e-15, 1e-300])
def test_an_area_tolerance_of_nothing_means_a_pixel(rough, tolerance):
    """Areas are met to a pixel at best, whatever is asked for: 64² points have none finer."""
    grid, heights = rough
    found = Counted("contact_area", grid, heights, area_tolerance=tolerance).solution(0.1)
    assert abs(grid.reduction.sum(found.pressure > 0) / grid.size - 0.1) <= 1 / grid.size


@pytest.mark.parametrize(("target", "said"), [(1e-300, True), (1e-6, True), (0.3, False)])
def test_an_area_below_a_pixel_is_not_met_without_a_word(rough, caplog, target, said):
    """A target of a fraction of a pixel is answered by one pixel, many times as much: the log says so."""
    with caplog.at_level("INFO", "pgfmd"):
        found = Counted("contact_area", *rough).solution(target)
    assert rough[0].reduction.sum(found.pressure > 0) >= 1
    here = said and rough[0].comm.rank == 0
    assert ("met to one pixel, which is more than load.area_tolerance" in caplog.text) == here


def test_areas_below_first_contact_are_not_reachable(comm):
    """A plateau touches as a whole, and so do the crests of a wave: smaller areas are refused without a solution."""
    grid = SlabGrid(comm, (32, 32))
    x = np.arange(grid.rows.start, grid.rows.stop)[:, None] * np.ones((1, 32))
    for heights, least in (((x < 8) * 1.0, 0.25), (np.cos(2 * np.pi * x / 32), 1 / 32)):
        counted = Counted("contact_area", grid, heights + 1e3)
        with pytest.raises(Unreachable, match=f"{least:g} touches first"):
            counted.solution(least / 4)
        assert counted.solves == 0
        found = counted.solution(1.5 * least if least < 0.1 else 0.3)
        assert grid.reduction.sum(found.pressure > 0) / grid.size >= least


def test_heights_far_from_zero_keep_their_mean_gap(comm):
    """Heights of 7e9 rms heights above 0, and the same without that constant, which is subtracted without rounding: at
    a mean gap that is met to 1e-7 the mean pressures agree, though the mean of the heights is known to 1e-6 only."""
    grid = SlabGrid(comm, (14, 13))
    heights = (np.random.default_rng(4).standard_normal(grid.shape) + 7.3e9)[grid.rows]
    found = []
    for surface in (heights, heights - 7.3e9):
        problem = under_hard_wall(grid, surface)
        control = LoadControl(Load(mean_gap=(0.3,), gap_tolerance=1e-7), problem, 1e-14)
        found.append(control.solution(0.3))
        assert found[-1].mean_gap == pytest.approx(0.3, rel=1e-7, abs=0)
    assert found[1].mean_pressure == pytest.approx(found[0].mean_pressure, rel=1e-6, abs=0)


def test_a_flat_surface_is_flat_whatever_its_height(comm):
    """Heights of 1.689… everywhere, whose mean rounds to another number, are no roughness of 2e-16."""
    grid = SlabGrid(comm, (4, 3))
    problem = ContactProblem(
        grid, np.full(grid.local_shape, 1.6893293747974671), elastic(1.0), ExponentialWall(zeta=1.0)
    )
    with pytest.raises(InputError, match="flat"):
        LoadControl(Load(displacement=(1.0,)), problem).check_targets([1.0])


@pytest.mark.parametrize("target", [0.3, 0.55, 0.7])
def test_a_search_does_not_go_to_and_fro(target):
    """Where the area changes more than Persson's theory says, steps back and forth shrink: thirty meet any load.  The
    area here is erf(p̄⁴): with steps as that theory has them p̄ would go from one load to another and back."""
    size, load = 10**8, 0.4
    aim = Aim(Imposed(1e-3, area=target), {size: 0.5}, pressure=load)
    for _ in range(30):
        at = Measured(0.0, aim.pressure, 1.0, round(size * math.erf(aim.pressure**4)), size)
        if not aim.moves(at, 0.0):
            break
    assert aim.target.missed(at) <= 1
