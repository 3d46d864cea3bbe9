"""The wall of limited hardness, 0 ≤ p ≤ σ_Y, against a quadratic-programme solver, its limits, and its certificate."""

import math

import numpy as np
import pytest
from conftest import whole
from contacts import elastic, rough_on
from job_texts import rough_job
from mpi4py import MPI
from reference import Contact, Real, Solid, Unable

import pgfmd
from pgfmd.application.job import parse
from pgfmd.application.results import Results
from pgfmd.application.simulate import simulate
from pgfmd.errors import InputError
from pgfmd.grid.domain import OPEN
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.transforms import sink, source
from pgfmd.observables import contact as measuring
from pgfmd.observables.contact_patches import ContactPatches
from pgfmd.observables.rough_surface import RoughSurface
from pgfmd.physics.laws.hard import Hardness, HardWall
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.controls import MeanGap
from pgfmd.solvers.dispatch import solve_contact
from pgfmd.solvers.load_control import LoadControl
from pgfmd.solvers.options import Load, Solver
from pgfmd.surfaces.self_affine import self_affine

pytestmark = pytest.mark.mpi

MODULUS = 8 / 3


def solved(grid, heights, load, hardness, tolerance=1e-20, solid=None, method="auto"):
    """The contact of this rank's heights; a hard wall if the hardness is infinite."""
    law = Hardness(hardness=hardness) if hardness < math.inf else HardWall()
    problem = ContactProblem(grid, heights, solid or elastic(MODULUS), law, load)
    return solve_contact(problem, Solver(tolerance=tolerance, method=method))


def random_contact(seed: int):
    """A random contact of up to 16², from light to full, hardness up to 300 p̄, half-space or slab; its reference."""
    random = np.random.default_rng(seed)
    shape = tuple(int(n) for n in random.choice([8, 12, 16], 2))
    heights = random.standard_normal(shape)
    if random.random() < 0.5:
        waves = np.hypot(np.fft.fftfreq(shape[0])[:, None] * shape[0], np.fft.rfftfreq(shape[1]) * shape[1])
        heights = np.fft.irfft2(np.fft.rfft2(heights) / np.maximum(waves, 1) ** random.uniform(0.5, 2), s=shape)
        heights /= heights.std()
    load = 10 ** random.uniform(-4, 1)
    hardness = load * 10 ** random.uniform(0.0005, 2.5)
    thickness = math.inf if random.random() < 0.6 else 10 ** random.uniform(-0.5, 1.5)
    return heights, load, hardness, thickness, Contact(heights, solid=Solid(1.0, thickness))


@pytest.mark.parametrize("batch", [pytest.param(b, marks=pytest.mark.long if b else ()) for b in range(6)])
def test_random_contacts_by_brute_force(comm, batch):
    """Pressures and gaps to 1e-8 of their largest value, by a dense solver in extended precision; and loosely solved,
    a certificate that is not below the true error, to 1e-15 of rounding."""
    for seed in range(50 * batch, 50 * batch + (50 if comm.size == 1 else 20)):
        heights, load, hardness, thickness, contact = random_contact(seed)
        try:
            exact = contact.hard(load, hardness)
        except Unable:
            continue
        grid, solid = SlabGrid(comm, heights.shape), elastic(1.0, thickness)
        found = solved(grid, heights[grid.rows].copy(), load, hardness, solid=solid)
        expected, unit = exact.x.astype(float).reshape(heights.shape) * load, load * float(contact.pixel)
        assert found.certified_error <= 1e-20
        assert np.abs(whole(grid, found.pressure) - expected).max() <= 1e-8 * expected.max(), seed
        loose = whole(grid, solved(grid, heights[grid.rows].copy(), load, hardness, 1e-5, solid).pressure)
        x, most = exact.x, Real(hardness) / Real(load)
        change, gap = loose.astype(Real).ravel() / Real(load) - x, contact.compliance @ x - contact.heights / unit
        between = (x > 0) & (x < most)
        if between.any():
            gap = np.where(between, 0, gap - gap[between].mean())
            lost = gap @ change + change @ (contact.compliance @ change) / 2
            certified = solved(grid, heights[grid.rows].copy(), load, hardness, 1e-5, solid).certified_error
            assert lost <= (certified + 1e-15) * (x @ (contact.compliance @ x)), seed
            gaps = np.where(between, 0, gap).astype(float).reshape(heights.shape) * unit
            small = 1e-8 * (np.abs(gaps).max() + np.ptp(heights))
            assert np.abs(whole(grid, found.gap) - np.maximum(gaps, 0)).max() <= small, seed
            assert np.abs(whole(grid, found.plastic_depth) - np.maximum(-gaps, 0)).max() <= small, seed
            means = found.mean_gap, found.mean_plastic_depth, found.approach
            approach = heights.max() - heights.mean() - gaps.mean()
            expected = np.maximum(gaps, 0).mean(), np.maximum(-gaps, 0).mean(), approach
            assert means == pytest.approx(expected, rel=0, abs=small), seed


@pytest.mark.parametrize("load", [0.002, 0.02])
def test_a_hardness_that_is_not_reached_is_a_hard_wall(comm, load):
    """σ_Y above the largest pressure changes nothing, to 1e-9 of that (both are certified to 1e-20)."""
    grid, heights = rough_on(comm, (96, 80), 0.8, 4.0, 0.031, 3)
    hard = solved(grid, heights, load, math.inf)
    highest = grid.reduction.max(hard.pressure)
    soft = solved(grid, heights, load, 1.01 * highest)
    assert grid.reduction.max(np.abs(hard.pressure - soft.pressure)) <= 1e-9 * highest
    assert soft.mean_gap == pytest.approx(hard.mean_gap, rel=1e-9, abs=0)


@pytest.mark.parametrize("share", [20.0, 191.0, 193.0, 1e13])
@pytest.mark.parametrize("load", [1e-4, 1e-8, 1e-10, 1e-12])
def test_light_loads_are_carried(comm, load, share):
    """Where the load displaces points by 1e-4 … 1e-12 of the roughness, few points bear it: all of it, to 1e-12, none
    more than σ_Y = share · p̄, with the pressures of the reference to 1e-3 of the largest (energies to 1e-8)."""
    heights = np.random.default_rng(1).standard_normal((12, 16))
    grid = SlabGrid(comm, heights.shape)
    found = solved(grid, heights[grid.rows], load, share * load, 1e-8, elastic(1.0))
    assert grid.reduction.sum(found.pressure) == pytest.approx(load * grid.size, rel=1e-12, abs=0)
    assert grid.reduction.max(found.pressure) <= share * load
    exact = Contact(heights).hard(load, share * load)
    right = ((exact.deviation + 1) * exact.pressure).astype(float).reshape(heights.shape)
    assert np.abs(whole(grid, found.pressure) - right).max() <= 1e-3 * right.max()


@pytest.mark.parametrize("part", [0.5, 0.9, 0.999, 0.99999])
def test_at_a_load_of_the_hardness_all_points_bear_it(comm, part):
    """p̄ → σ_Y: f_c ≥ p̄/σ_Y, and pressures differ from σ_Y by what is missing.  Where that is small their rounding
    weighs the more: some 1e-29 of the energy over its square."""
    grid = SlabGrid(comm, (64, 80))
    heights, hardness = self_affine(grid, 0.5, 1.0, 0.031, 3), 1e-3
    tolerance = max(1e-20, 1e-29 / (1 - part) ** 2)
    found = solved(grid, heights, part * hardness, hardness, tolerance)
    assert found.certified_error <= tolerance
    assert grid.reduction.max(found.pressure) <= hardness
    assert grid.reduction.sum(found.pressure > 0) >= part * grid.size
    missing = (1 - part) * hardness * grid.size
    assert grid.reduction.sum(hardness - found.pressure) == pytest.approx(missing, rel=1e-4, abs=0)


@pytest.mark.parametrize("hardness", [0.01, 0.03, 0.08])
@pytest.mark.parametrize("load", [0.0005, 0.004])
def test_rough_surfaces(comm, load, hardness):
    """On 256² with coarse grids, and most points at a bound or few of them: p is between its bounds and carries the
    load; u − h is constant in between, larger where p = 0, smaller where p = σ_Y, as transforms written here again say;
    the certificate is met."""
    grid, heights = rough_on(comm, (256, 256), 0.8, 4.0, 0.031, 2)
    found = solved(grid, heights, load, hardness, 1e-16)
    p = found.pressure
    assert found.certified_error <= 1e-16
    assert 0 <= grid.reduction.min(p) and grid.reduction.max(p) <= hardness
    assert grid.reduction.sum(p) == pytest.approx(load * grid.size, rel=1e-12, abs=0)
    q = np.sqrt(grid.q_squared())
    u = grid.backward(grid.forward(p) * np.divide(2 / MODULUS, q, out=np.zeros_like(q), where=q > 0))
    between, gap = (p > 0) & (p < hardness), u - heights
    level = grid.reduction.sum(gap[between]) / grid.reduction.sum(between)
    small = 1e-6 * math.sqrt(grid.reduction.sum(heights**2) / grid.size)
    assert grid.reduction.max(np.abs(gap - level)[between]) < small
    assert grid.reduction.min(gap[p == 0]) > level - small
    assert grid.reduction.max(gap[p == hardness]) < level + small
    assert np.allclose(found.gap, np.where(p == 0, gap - level, 0), rtol=0, atol=2 * small)
    assert np.allclose(found.plastic_depth, np.where(p == hardness, level - gap, 0), rtol=0, atol=2 * small)


@pytest.mark.parametrize(
    ("seed", "method"), [*((seed, "active-set") for seed in range(12)), (19, "gfmd"), (26, "gfmd")]
)
def test_what_overlaps_bears_the_hardness_to_the_last_digit(comm, seed, method):
    """Energies are of first order in what is missing there: one digit, 1e-16, would be above what is certified.  For
    these loads and hardnesses, one in twelve of all, (σ_Y/p̄) p̄ is not σ_Y in double precision."""
    random = np.random.default_rng(seed)
    heights = random.standard_normal((12, 16))
    load = hardness = 1.0
    while hardness / load * load == hardness:
        load, hardness = random.uniform(0.1, 0.6), random.uniform(1.0, 2.0)
    grid = SlabGrid(comm, heights.shape)
    found = solved(grid, heights[grid.rows], load, hardness, 1e-12, method=method)
    assert grid.reduction.min(found.gap) == 0 < grid.reduction.max(found.plastic_depth)
    near = found.pressure > (1 - 1e-12) * hardness
    assert np.all(found.pressure[near] == hardness) and np.all(near[found.plastic_depth > 0])


def test_more_than_the_hardness_is_refused(comm):
    """A mean pressure of σ_Y or more has no solution."""
    grid, heights = rough_on(comm, (16, 16), 0.8, 4.0, 0.031, 3)
    for load in (0.1, 0.2):
        with pytest.raises(InputError, match="0.1"):
            solved(grid, heights, load, 0.1)


@pytest.mark.parametrize("seed", range(4))
def test_imposed_gaps_are_met_to_their_bound(comm, seed):
    """The mean gap of a loose solution differs from that of a tight one at the same load by no more than its bound."""
    grid, heights = rough_on(comm, (32, 32), 0.8, 4.0, 0.1, seed)
    load = 0.01 * 3**seed
    problem = ContactProblem(grid, heights, elastic(1.0), Hardness(hardness=3 * load), load)
    control = MeanGap(problem, Load(mean_gap=(1.0,), gap_tolerance=1e-6))
    exact = solve_contact(problem, Solver(tolerance=1e-20))
    for tolerance in (1e-3, 1e-6, 1e-9):
        found = solve_contact(problem, Solver(tolerance=tolerance))
        assert abs(found.mean_gap - exact.mean_gap) <= control.bound(found) + 1e-9
        assert abs(found.approach - exact.approach) <= control.bound(found) + 1e-9


@pytest.mark.parametrize("part", [0.2, 0.7, 0.97])
def test_imposed_areas_and_gaps_are_found_below_the_hardness(comm, part):
    """The area, the mean gap and the displacement of a load are met, though the stress of full contact, with which the
    search begins, is ten times what the wall bears: no load on the way is above that."""
    grid = SlabGrid(comm, (32, 32))
    law, heights = Hardness(hardness=0.05), self_affine(grid, 0.8, 8.0, 0.5, 1)
    problem = ContactProblem(grid, heights, elastic(MODULUS), law, part * law.hardness)
    found = solve_contact(problem, Solver(tolerance=1e-10))
    area = grid.reduction.sum(found.pressure > 0) / grid.size
    again = LoadControl(Load(contact_area=(area,)), problem).solution(area)
    pixel = 1 / grid.size
    assert abs(grid.reduction.sum(again.pressure > 0) / grid.size - area) <= max(0.005 * area, pixel) * (1 + 1e-9)
    if found.mean_gap > 0:
        again = LoadControl(Load(mean_gap=(found.mean_gap,)), problem).solution(found.mean_gap)
        assert abs(again.mean_gap - found.mean_gap) <= 1e-4 * found.mean_gap
    again = LoadControl(Load(displacement=(found.approach,)), problem).solution(found.approach)
    assert abs(again.approach - found.approach) <= 1e-4 * found.approach


@pytest.mark.parametrize("target", [0.6, 0.05, 1e-3])
def test_an_imposed_mean_gap_is_that_of_what_is_open(comm, target):
    """The mean of the gap, which is nowhere negative, is the one asked for, to 1e-4 of it, though the wall has yielded
    by more than that; and the solid's surface, Gp from a transform, is where gap, heights and plastic depth say."""
    grid, law = SlabGrid(comm, (32, 32)), Hardness(hardness=0.05)
    heights = self_affine(grid, 0.8, 8.0, 0.2, 1)
    problem = ContactProblem(grid, heights, elastic(1.0), law)
    found = LoadControl(Load(mean_gap=(target,)), problem, 1e-12).solution(target)
    assert found.mean_gap == pytest.approx(target, rel=1e-4, abs=0)
    assert grid.reduction.min(found.gap) == 0 < grid.reduction.max(found.plastic_depth)
    assert grid.reduction.sum(found.gap) / grid.size == pytest.approx(target, rel=1e-3, abs=0)
    assert grid.reduction.sum(found.plastic_depth) / grid.size == pytest.approx(found.mean_plastic_depth, rel=1e-12)
    assert np.all(found.gap[found.plastic_depth > 0] == 0) and np.all(found.pressure[found.plastic_depth > 0] == 0.05)
    q = np.sqrt(grid.q_squared())
    moved = grid.backward(grid.forward(found.pressure) * np.divide(2.0, q, out=np.zeros_like(q), where=q > 0))
    apart = found.gap + heights - found.plastic_depth - moved
    assert grid.reduction.max(apart) - grid.reduction.min(apart) < 1e-5


def test_a_surface_keeps_the_shape_to_which_it_has_yielded(comm):
    """The heights less the plastic depth touch as before under the same load, without yielding again, also where no
    hardness limits the pressure; under a lower load more of them touches than of the virgin surface."""
    grid, load = SlabGrid(comm, (48, 48)), 0.01
    heights = self_affine(grid, 0.8, 8.0, 0.2, 1)
    virgin = solved(grid, heights, load, 0.05, 1e-16)
    assert grid.reduction.max(virgin.plastic_depth) > 0.1
    shape = heights - virgin.plastic_depth
    for hardness in (0.05 * (1 + 1e-9), math.inf):
        again = solved(grid, shape, load, hardness, 1e-16)
        assert grid.reduction.max(np.abs(again.pressure - virgin.pressure)) < 1e-6 * 0.05
        assert grid.reduction.max(again.plastic_depth) < 1e-6
    areas = [grid.reduction.sum(solved(grid, of, load / 5, 0.05).pressure > 0) for of in (shape, heights)]
    assert areas[0] > 1.2 * areas[1]


@pytest.mark.parametrize(
    ("control", "loading"),
    [("pressure", (0.002, 0.01, 0.01)), ("contact_area", (0.1, 0.2)), ("mean_gap", (0.5, 0.1)),
     ("displacement", (0.1, 0.5))],
)  # fmt: skip
def test_loads_that_decrease_are_refused(comm, control, loading):
    """A list that unloads would return virgin states: one line names the key and the remedy, in jobs and in Python.
    Lists that load are taken, and so are lists of any order under a hard wall."""
    grid, law = SlabGrid(comm, (16, 16)), Hardness(hardness=0.05)
    problem = ContactProblem(grid, self_affine(grid, 0.8, 8.0, 0.1, 1), elastic(1.0), law)
    LoadControl(Load(**{control: loading}), problem)
    LoadControl(Load(**{control: loading[::-1]}), problem.with_law(HardWall()))
    back = loading[::-1]
    message = rf"load\.{control} = \[.*\]: must not .* from entry to entry .*plastic_depth$"
    with pytest.raises(InputError, match=message):
        LoadControl(Load(**{control: back}), problem)
    with pytest.raises(InputError, match=message):
        pgfmd.solve(problem.heights, comm=comm, wall=law, **{control: back})
    with pytest.raises(InputError, match=message):
        parse(rough_job(16, wall={"kind": "hardness", "hardness": 0.05}, load={control: list(back)}))


def test_displacements_beyond_full_yielding_are_refused(comm):
    """p̄ → σ_Y at the range of heights, of a slab plus its compression: a displacement just below is met, none above."""
    grid, law = SlabGrid(comm, (16, 16)), Hardness(hardness=0.05)
    heights = self_affine(grid, 0.8, 8.0, 0.1, 1)
    size = grid.reduction.max(heights) - grid.reduction.min(heights)
    for solid in (elastic(1.0), elastic(1.0, 5.0, "bonded", 0.25)):
        control = LoadControl(Load(displacement=(1.0,)), ContactProblem(grid, heights, solid, law))
        limit = size + (law.hardness / solid.mean_stiffness() if solid.mean_stiffness() else 0)
        found = control.solution(0.9 * limit)
        assert control.displacement(found) == pytest.approx(0.9 * limit, rel=1e-4, abs=0)
        assert 0.5 * law.hardness < found.mean_pressure < law.hardness
        with pytest.raises(InputError, match=rf"must be below {limit:g}, where all points yield"):
            control.solution(1.001 * limit)


@pytest.mark.parametrize("seed", range(4))
def test_a_mean_gap_is_not_negative(seed):
    """Nearly full contact, by yielding or by an imposed area: the mean of gaps ≥ 0 is ≥ 0, whatever its error."""
    heights = 0.3 * np.random.default_rng(seed).standard_normal((8, 8))
    yielding = pgfmd.solve(heights, 1.0, wall=Hardness(hardness=1.2))
    for found in (yielding, pgfmd.solve(heights, contact_area=0.99999)):
        assert found.mean_gap >= 0 and found.gap.min() >= 0
        assert found.mean_gap == pytest.approx(found.gap.mean(), rel=1e-4, abs=1e-6)


@pytest.mark.parametrize("thickness", [math.inf, 4.0])
def test_an_open_patch_yields_as_a_whole_beyond_its_range_of_heights(comm, thickness):
    """Under σ_Y everywhere an open patch is also displaced: the displacements of loads up to .98 σ_Y are met.  The
    first to be refused is that at which the last point touches, where u − h is largest."""
    grid, options = SlabGrid(comm, (9, 12)), {"boundary": "open", "comm": comm, "wall": Hardness(hardness=0.4)}
    options["solid"] = elastic(1.0, thickness, "bonded", 0.25)
    heights = 0.3 * np.random.default_rng(2).standard_normal((9, 12))
    rows = heights[grid.rows]
    for part in (0.3, 0.8, 0.98):
        found = pgfmd.solve(rows, part * 0.4, tolerance=1e-11, **options)
        again = pgfmd.solve(rows, displacement=found.displacement, **options)
        assert again.mean_pressure == pytest.approx(found.mean_pressure, rel=3e-3)
    patch = SlabGrid(MPI.COMM_SELF, (9, 12), domain=OPEN)
    moved = patch.new_field()
    response = options["solid"].apply_compliance(patch, np.float64, 1 / patch.modes)
    patch.convolve(source(np.full((9, 12), 0.4)), response, sink(moved))
    limit = np.max(moved - heights) + heights.max()
    assert limit > 1.5 * np.ptp(heights)
    with pytest.raises(InputError, match=rf"must be below {limit:g}, where all points yield"):
        pgfmd.solve(rows, displacement=limit * (1 + 1e-9), **options)
    assert pgfmd.solve(rows, displacement=0.999 * limit, **options).mean_pressure > 0.95 * 0.4


def test_a_run_keeps_the_plastic_depth(comm, shared_tmp_path):
    """Displacement is gap + height − plastic depth, less its mean; a restart may add higher loads, not lower ones."""
    folder = shared_tmp_path / "run"

    def job(*loads):
        output = {"fields": ["height", "gap", "plastic_depth", "displacement"], "observables": ["gap_spectrum"],
                  "gap_spectrum": {"all_modes": True}}  # fmt: skip
        wall = {"kind": "hardness", "hardness": 0.05}
        return parse(rough_job(16, solid={"contact_modulus": 1.0}, wall=wall, load={"pressure": loads}, output=output))

    simulate(job(0.01), comm, folder)
    simulate(job(0.01, 0.03), comm, folder, restart=True)
    with pytest.raises(InputError, match="must not fall"):
        simulate(job(0.01, 0.03, 0.02), comm, folder, restart=True)
    results = Results(folder)
    for load in results:
        gap, depth = load.field("gap"), load.field("plastic_depth")
        assert gap.min() == 0 and depth.max() > 0 and not np.any(gap * depth)
        assert load.numbers["mean_plastic_depth"] == pytest.approx(depth.mean(), rel=1e-12, abs=0)
        assert load.numbers["mean_gap"] == pytest.approx(gap.mean(), rel=1e-4, abs=0)
        displacement = gap + load.field("height") - depth
        assert np.abs(load.field("displacement") - (displacement - displacement.mean())).max() < 1e-14
        spectrum = load["gap_spectrum"]
        assert np.nansum(spectrum["count"] * spectrum["value"]) == pytest.approx(gap.var(), rel=1e-11, abs=0)
    assert results.loads["mean_plastic_depth"][0] < results.loads["mean_plastic_depth"][1]
    comm.Barrier()


@pytest.mark.parametrize("part", [0.1, 0.2, 0.5, 0.9])
def test_no_area_bears_more_than_the_hardness(comm, part):
    """σ_Y times the corrected area is at least the load, of the whole and of each patch; pixels count more."""
    grid = SlabGrid(comm, (64, 64))
    heights, law = self_affine(grid, 0.8, 8.0, 0.1, 3), Hardness(hardness=0.01)
    problem = ContactProblem(grid, heights, elastic(1.0), law, part * law.hardness)
    surface = RoughSurface(problem, [ContactPatches()])
    contact = measuring.Contact.of(surface, solve_contact(problem))
    assert contact.line is not None
    assert part <= contact.area.corrected < contact.area.fraction
    patches = contact.measure()["patches"]
    if comm.rank == 0:
        assert np.all(patches["area_corrected"] >= patches["load"] / law.hardness)
