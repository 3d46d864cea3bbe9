"""The hard wall against exact solutions, exact invariances, and its own certificate."""

import numpy as np
import pytest
from conftest import broad, whole
from contacts import elastic, rough_on, under_hard_wall
from mpi4py import MPI

from pgfmd import solve, surface
from pgfmd.errors import InputError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.solvers.active_set import contact_from_coarse
from pgfmd.solvers.active_set.active_set import State
from pgfmd.solvers.active_set.contact_from_coarse import solve_hard_wall
from pgfmd.solvers.active_set.primal import PressureSteps
from pgfmd.surfaces.paraboloid import Paraboloid
from pgfmd.surfaces.rigid_surface import coordinates
from pgfmd.surfaces.self_affine import self_affine
from pgfmd.surfaces.sinusoid import sinusoid
from pgfmd.theory import exact, hertz
from pgfmd.theory.lattice_edge import STAIRCASE

pytestmark = pytest.mark.mpi

MODULUS = 8 / 3


def westergaard(comm, n, load=0.5):
    """Errors (L1, L2, L∞ of the pressure, mean gap, energy, half-width in pixels) on n × 4 points.  The crest lies
    midway between two points, so that the edge of contact falls on none."""
    grid = SlabGrid(comm, (n, 4), (1.0, 4 / n))
    x = (coordinates(grid)[0] * np.ones((1, 4)) + 0.5 / n + 0.5) % 1.0 - 0.5
    theory = exact.Westergaard(1.0, 1.0, MODULUS)
    mean = load * theory.full_pressure
    found = solve_hard_wall(under_hard_wall(grid, np.cos(2 * np.pi * x), mean, elastic(MODULUS)), 1e-20)
    expected = theory.pressure(x, mean)
    wrong, sums = np.abs(found.pressure - expected), grid.reduction.sum
    width = sums(found.pressure > 0) / 8 / n
    return np.array(
        [
            sums(wrong) / sums(expected),
            np.sqrt(sums(wrong**2) / sums(expected**2)),
            grid.reduction.max(wrong) / grid.reduction.max(expected),
            abs(found.mean_gap - theory.mean_gap(mean)),
            abs(found.elastic_energy - theory.elastic_energy(mean)) / theory.full_pressure,
            abs(width - theory.half_width(mean)) * n,
        ]
    )


def test_westergaard(comm):
    """At f = .5, n = 1024: L2(p) ≤ 5e-4, mean gap and energy ≤ 1e-6, half-width in a pixel.  Orders from n = 128 on,
    where the edge keeps its place between two points: L1 3/2, L2 1, L∞ 1/2, mean gap 2; to .1, for further terms."""
    coarse, fine = westergaard(comm, 128), westergaard(comm, 1024)
    _, l2, _, gap, energy, width = fine
    assert l2 <= 5e-4 and gap <= 1e-6 and energy <= 1e-6 and width <= 1
    orders = np.log(coarse / fine)[:4] / np.log(8)
    assert np.allclose(orders, [1.5, 1.0, 0.5, 2.0], atol=0.1)


@pytest.mark.parametrize("row", range(len(exact.SINUSOID_2D_TABLE)))
def test_two_dimensional_sinusoid(comm, row):
    """Area, gap, ⟨p²⟩ of the reference table (computed independently) at n = 512: area to 0.003 (0.006 where patches
    are about to merge), gap and ⟨p²⟩ to 2e-4; peak pressure to its printed digits and one pixel's share."""
    table = exact.SINUSOID_2D_TABLE[row]
    grid = SlabGrid(comm, (512, 512), (1.0, 1.0))
    full = exact.Sinusoid2D(1.0, 1.0, MODULUS).full_pressure
    load = table["f"]
    found = solve_hard_wall(under_hard_wall(grid, sinusoid(grid, 1.0, (1, 1)), load * full, elastic(MODULUS)), 1e-9)
    mask = whole(grid, found.pressure) > 0
    edges = sum(np.count_nonzero(mask != np.roll(mask, 1, axis)) for axis in (0, 1))
    area = mask.mean() - STAIRCASE * edges / mask.size  # without the pixel staircase
    assert abs(area - table["area"]) <= (0.006 if load == 0.2 else 0.003)
    assert abs(found.mean_gap - table["gap"]) <= 2e-4
    assert abs(grid.reduction.sum(found.pressure**2) / grid.size / full**2 - table["mean_square"]) <= 2e-4
    assert abs(grid.reduction.max(found.pressure) / full - table["peak_pressure"]) <= 2e-3


@pytest.mark.mpi("breadth")
@pytest.mark.parametrize("thickness", [np.inf, 2.0])
@pytest.mark.parametrize("load", [1e-100, 1e-30, 1e-9, 1e-5])
def test_light_loads_on_several_grids(comm, load, thickness):
    """Through a coarser grid too, the load is carried to 1e-12, and the lightest by the summits alone."""
    grid = SlabGrid(comm, (40, 36))
    x, y = np.meshgrid(np.arange(40)[grid.rows], np.arange(36), indexing="ij")
    summits = 1.0 * ((x == 3) & (y == 4) | (x == 20) & (y == 21))
    for heights in (self_affine(grid, 0.8, 4.0, 0.1, 1), summits):
        found = solve_hard_wall(under_hard_wall(grid, heights, load, elastic(1.0, thickness)), 1e-10)
        assert 0 < found.certified_error <= 1e-10
        assert grid.reduction.sum(found.pressure) == pytest.approx(load * grid.size, rel=1e-12, abs=0)
        if load <= 1e-30:
            assert np.array_equal(found.pressure > 0, heights == grid.reduction.max(heights))


def test_periodic_hertz(comm):
    """Radius and peak pressure at a_H/L = 0.1 on 512² to 1e-4 (the theory's own terms beyond are 1e-5)."""
    grid = SlabGrid(comm, (512, 512), (1.0, 1.0))
    radius, load = 1.0, 4 * MODULUS * 0.1**3 / 3
    heights = Paraboloid(radius=radius).heights(grid)
    found = solve_hard_wall(under_hard_wall(grid, heights, load, elastic(MODULUS)), 1e-11)
    expected = hertz.periodic_contact(load, radius, 1.0, contact_modulus=MODULUS)
    x, y = coordinates(grid)
    second = grid.reduction.sum(((x - 0.5) ** 2 + (y - 0.5) ** 2) * found.pressure) / grid.reduction.sum(found.pressure)
    assert np.sqrt(2.5 * second) == pytest.approx(expected.radius, rel=1e-4, abs=0)
    assert grid.reduction.max(found.pressure) == pytest.approx(expected.peak_pressure, rel=1e-4, abs=0)


def test_full_contact_is_exact(comm):
    """Above the largest tension, p = p̄ + F⁻¹[(E'q/2) h̃], to 1e-10.  Just below it there is a gap, and a certificate."""
    grid, heights = rough_on(comm, (96, 80), 0.8, 8.0, 0.031, 1)
    response = grid.backward(grid.forward(heights) * MODULUS / 2 * np.sqrt(grid.q_squared()))
    mean = -1.01 * grid.reduction.min(response)
    found = solve_hard_wall(under_hard_wall(grid, heights, mean, elastic(MODULUS)), 1e-6)
    assert grid.reduction.max(np.abs(found.pressure - mean - response)) < 1e-10 * mean
    assert (found.iterations, found.mean_gap) == (0, 0.0)
    assert 0 < found.certified_error < 1e-28  # what the digits of a double may amount to
    below = solve_hard_wall(under_hard_wall(grid, heights, 0.97 / 1.01 * mean, elastic(MODULUS)), 1e-10)
    assert 0 < grid.reduction.sum(below.gap > 0) < 100 and below.certified_error <= 1e-10


def test_zero_load_and_flat_surface(comm):
    """No load: no pressure, the surfaces touch at the summit.  A flat surface: uniform pressure, no gap."""
    grid = SlabGrid(comm, (32, 24))
    heights = self_affine(grid, 0.8, 4.0, 1.0, 1) + 5.0
    found = solve_hard_wall(under_hard_wall(grid, heights, 0.0))
    assert not found.pressure.any()
    assert np.allclose(found.gap, grid.reduction.max(heights) - heights, atol=1e-12)
    assert found.mean_gap == pytest.approx(grid.reduction.max(heights) - 5.0, rel=1e-12, abs=0)
    flat = solve_hard_wall(under_hard_wall(grid, np.full(grid.local_shape, 3.0), 0.2))
    assert np.allclose(flat.pressure, 0.2, rtol=1e-14, atol=0)
    assert flat.mean_gap == 0


@pytest.mark.parametrize("shape", [(64, 64), (45, 64), (63, 50), (37, 41)])
@pytest.mark.parametrize("load", [0.003, 0.1, 0.8])
def test_solution_obeys_the_contact_conditions(comm, shape, load):
    """p ≥ 0, gap ≥ 0, p·gap = 0, mean p = p̄, and u = Gp up to a constant wherever points touch: for any grid."""
    grid = SlabGrid(comm, shape)
    heights = self_affine(grid, 0.5, 2.0, 1.0, 5)
    found = solve_hard_wall(under_hard_wall(grid, heights, load), 1e-20)
    assert grid.reduction.min(found.pressure) >= 0
    assert grid.reduction.min(found.gap) >= 0
    assert not (found.pressure * found.gap).any()
    assert grid.reduction.sum(found.pressure) / grid.size == pytest.approx(load, rel=1e-13, abs=0)
    q = np.sqrt(grid.q_squared())
    u = grid.backward(grid.forward(found.pressure) * np.divide(2, q, out=np.zeros_like(q), where=q > 0))
    gap = u - heights
    touching = found.pressure > 0
    spread = grid.reduction.max(gap[touching]) - grid.reduction.min(gap[touching])
    rms = np.sqrt(grid.reduction.sum(heights**2) / grid.size)
    assert spread < 1e-8 * rms
    assert grid.reduction.min(gap) > grid.reduction.min(gap[touching]) - 1e-8 * rms
    assert found.max_violation < 1e-8


@pytest.mark.mpi("breadth")
@pytest.mark.parametrize("load", [0.0005, 0.05, 0.4, 1.5])
@pytest.mark.parametrize("lambda_s", [1.0, 8.0])
def test_certificate_is_a_sharp_bound(comm, lambda_s, load):
    """J(p) − J(p*) ≤ the certificate ≤ 2.5 times that (measured at most 1.5 here, 2.0 at 256²), from single pixels to
    nearly full contact, with p* certified to 1e-20; the pressure error is estimated within a factor: between .05 and 2
    of it is true.  Loads in units of the stress of full contact."""
    grid, heights = rough_on(comm, (96, 80), 0.5, lambda_s, 0.031, 1)
    q = np.sqrt(grid.q_squared())
    stress = grid.backward(grid.forward(heights) * MODULUS / 2 * q)
    load *= np.sqrt(grid.reduction.sum(stress**2) / grid.size)
    problem = under_hard_wall(grid, heights, load, elastic(MODULUS))
    exactly = solve_hard_wall(problem, 1e-20)
    compliance = np.divide(2 / MODULUS, q, out=np.zeros_like(q), where=q > 0)
    for tolerance in (1e-2, 1e-5, 1e-8, 1e-12):
        found = solve_hard_wall(problem, tolerance)
        wrong = found.pressure - exactly.pressure
        lost = grid.reduction.sum(wrong * grid.backward(grid.forward(wrong) * compliance)) / 2
        lost += grid.reduction.sum(wrong * exactly.gap)  # where p* = 0
        true = lost / grid.size / (2 * exactly.elastic_energy)
        assert found.certified_error <= tolerance
        assert true <= found.certified_error
        if true > 1e-18:  # else the tolerance was met by far, and rounding is what is certified
            assert found.certified_error < 2.5 * max(true, 0.01 * tolerance)
            far = np.sqrt(grid.reduction.sum(wrong**2) / grid.reduction.sum(exactly.pressure**2))
            assert 0.05 < far / found.pressure_error < 2


@pytest.mark.parametrize("solid", [elastic(2.0), elastic(2.0, 2.0), elastic(2.0, 0.3, "free")])
def test_rounding_is_counted(solid):
    """The K norm of what single precision gets wrong, against double, is below the bound that certificates contain, for
    white, smooth and sparse pressures and single pixels; and not 8 times smaller where transforms take many steps."""
    random = np.random.default_rng(5)
    for shape in ((1, 1), (2, 3), (8, 8), (7, 31), (64, 64), (61, 67), (1, 64), (128, 2), (127, 127), (256, 256),
                  (1021, 64)):  # fmt: skip
        grid = SlabGrid(MPI.COMM_SELF, shape)
        q = np.sqrt(grid.q_squared())
        white, pixel = random.random(shape), np.zeros(shape)
        pixel[-1, 0] = grid.size
        smooth = grid.backward(grid.forward(white) / np.maximum(q, 2 * np.pi / max(grid.lengths)) ** 2)
        problem = under_hard_wall(grid, np.zeros(shape), 1.0, solid)
        for pressure in (white, np.abs(smooth), np.where(random.random(shape) < 0.1, white, 0), pixel):
            if not pressure.any():
                continue
            solver, gaps = PressureSteps(problem), []
            for precision in (np.float64, np.float32):
                state = State(pressure, np.empty(shape))
                solver.compute_gap(state, precision)
                solver.measure(state)
                gaps.append(state.gap)
            wrong = grid.forward(gaps[1] - gaps[0])
            lost = np.sum(grid.hermitian_weight * solid.stiffness(q) * np.abs(wrong) ** 2) / grid.size / 2
            assert lost <= solver.rounding_bound(state, np.float32)
            assert grid.size < 5000 or lost > solver.rounding_bound(state, np.float32) / 64


@pytest.mark.parametrize("tolerance", [1e-4, 1e-8, 1e-12, 1e-20])
def test_tolerance_is_met(comm, tolerance):
    """The certified error is at most the tolerance, down to 1e-20: no stagnation in single precision."""
    grid = SlabGrid(comm, (128, 128))
    problem = under_hard_wall(grid, self_affine(grid, 0.3, 1.0, 0.031, 1), 0.003, elastic(MODULUS))
    assert solve_hard_wall(problem, tolerance).certified_error <= tolerance


def solved(comm, heights, load, start=None):
    """Pressure of a whole surface, to 1e-20 on the ranks of comm, so that pressures agree to 1e-9; and the solution."""
    grid = SlabGrid(comm, heights.shape)
    found = solve_hard_wall(under_hard_wall(grid, heights[grid.rows].copy(), load), 1e-20, start=start)
    return whole(grid, found.pressure), found


@pytest.mark.mpi("breadth")
def test_work_does_not_grow_with_the_grid(comm):
    """Rough down to the pixel, four times as many points a side: no more than a quarter more transforms per point."""
    counts = []
    for n in (512, 2048):
        grid, heights = rough_on(comm, (n, n), 0.3, 1.0, 0.031, 1)
        counts.append(solve_hard_wall(under_hard_wall(grid, heights, 0.0044, elastic(2.0)), 1e-4).transforms)
    assert counts[1] < 1.25 * counts[0]


@pytest.fixture(scope="module")
def rough():
    """One rough 64 × 64 surface."""
    return self_affine(SlabGrid(MPI.COMM_SELF, (64, 64)), 0.5, 4.0, 1.0, 9)


@pytest.mark.parametrize("scale", [1e-12, 0.37, 1e12])
def test_heights_and_load_scale_together(comm, rough, scale):
    """(h, p̄) → (s h, s p̄) leaves the contact set and scales the pressure."""
    before, after = solved(comm, rough, 0.1)[0], solved(comm, scale * rough, scale * 0.1)[0]
    assert np.array_equal(before > 0, after > 0)
    assert np.abs(before - after / scale).max() < 1e-8 * before.max()


def test_energy_follows_the_gap(comm, rough):
    """dE/dp̄ = −p̄ dḡ/dp̄, by central differences of 1e-4 p̄ (their error is 1e-8; contact changes a pixel at a time)."""
    _, low = solved(comm, rough, 0.1 * (1 - 1e-4))
    _, high = solved(comm, rough, 0.1 * (1 + 1e-4))
    work = -0.1 * (high.mean_gap - low.mean_gap)
    assert high.elastic_energy - low.elastic_energy == pytest.approx(work, rel=1e-5, abs=0)


@pytest.mark.parametrize("lambda_s", [1.0, 8.0])
def test_pressures_or_gaps_as_unknowns(comm, monkeypatch, lambda_s):
    """Half in contact, solved for the pressures of these points or for the gaps of the others: the same answer.  The
    mean gap errs by the square root of the energy error, here 1e-10."""
    grid, heights = rough_on(comm, (96, 80), 0.5, lambda_s, 0.031, 1)
    found = []
    for mostly in (0.0, 2.0):
        monkeypatch.setattr(contact_from_coarse, "gaps_from", lambda points, area=mostly: area)
        found.append(
            contact_from_coarse.solve_hard_wall(
                under_hard_wall(grid, heights, 0.0085 * MODULUS, elastic(MODULUS)), 1e-20
            )
        )
    by_gaps, by_pressures = (solution.pressure for solution in found)
    assert 0.35 < grid.reduction.sum(by_gaps > 0) / grid.size < 0.65
    difference = grid.reduction.sum((by_gaps - by_pressures) ** 2) / grid.reduction.sum(by_gaps**2)
    assert np.sqrt(difference) < 1e-6
    assert found[0].mean_gap == pytest.approx(found[1].mean_gap, rel=1e-9, abs=0)


@pytest.mark.parametrize("digits", [3.0, 7.81, 8.0275, 8.185, 8.2825])
def test_offset_of_the_heights_does_not_matter(comm, rough, digits):
    """It changes what rounding leaves of them: seven digits at 1e8 roughnesses, where ⟨h²⟩ − ⟨h⟩² may be negative."""
    before, after = solved(comm, rough, 0.1)[0], solved(comm, rough + 10**digits * np.std(rough), 0.1)[0]
    assert np.abs(before - after).max() < (1e-8 if digits < 4 else 1e-3) * before.max()


def test_a_warm_start_gives_the_same_answer(comm, rough):
    """Starting from a neighbouring load's pressure or from the cascade ends at the same contact."""
    cold, _ = solved(comm, rough, 0.1)
    _, neighbour = solved(comm, rough, 0.13)
    warm, _ = solved(comm, rough, 0.1, start=neighbour.pressure)
    assert np.abs(cold - warm).max() < 1e-8 * cold.max()


def test_slab_or_whole_array(comm, rough):
    """`pgfmd.solve` of the whole surface on one rank, or of each rank's rows on all: the same, solved to 1e-22."""
    grid = SlabGrid(comm, rough.shape)
    alone = solve(rough, 0.1, tolerance=1e-22)
    mine = solve(rough[grid.rows].copy(), 0.1, tolerance=1e-22, comm=comm)
    assert np.abs(alone.pressure[grid.rows] - mine.pressure).max() < 1e-10 * alone.pressure.max()


def test_a_height_that_is_no_number_is_refused_by_all(comm, rough):
    """NaN on one rank: InputError on every rank."""
    heights = rough[SlabGrid(comm, rough.shape).rows].copy()
    if comm.rank == comm.size - 1:
        heights[0, 3] = np.nan
    with pytest.raises(InputError):
        solve(heights, 0.1, comm=comm)


def test_heights_are_kept(comm, rough):
    """The heights come back untouched."""
    grid = SlabGrid(comm, rough.shape)
    heights = rough[grid.rows].copy()
    solve_hard_wall(under_hard_wall(grid, heights, 0.1), 1e-10)
    assert np.array_equal(heights, rough[grid.rows])


@pytest.mark.parametrize("seed", range(2))
def test_one_step_sees_how_the_set_of_unknowns_changes(comm, seed):
    """One step with the mesh's response divides ⟨r, Mr⟩ by 1000, of the 10⁴ asked for.  A linear solve that divides the
    residual by 7 could do no better than 49, since the set of unknowns is that of another load."""
    grid, heights = rough_on(comm, (256, 256), 0.8, 8.0, 0.031, seed)
    start, problem = (under_hard_wall(grid, heights, p, elastic(MODULUS)) for p in (0.004, 0.0044))
    found = solve_hard_wall(start, 1e-12)
    state, solver = State(1.1 * found.pressure, found.gap.copy()), PressureSteps(problem)
    system = solver.linearise(state, np.float32)
    before = system.square
    solver.improve(state, system, 1 / 7, 1e-4)
    assert solver.linearise(state, np.float32).square < 1e-3 * before
    solver.free()


@pytest.mark.parametrize(
    ("n", "wavelength", "hurst", "pressure", "most"),
    broad([
        (1024, 16.0, 0.8, 0.01, 3.0),
        (2048, 2.0, 0.8, 0.03, 4.9),
        (2048, 16.0, 0.8, 0.045, 4.0),
        (2048, 16.0, 0.8, 0.01, 3.2),
        (2048, 16.0, 0.3, 0.01, 4.0),
    ], 3),
)
def test_transforms_do_not_grow_with_the_scales(n, wavelength, hurst, pressure, most):
    """A certified 1e-8 within so many transform pairs, for 64 to 1024 wavelengths across the cell, with pressures and
    with gaps as unknowns (some of these took 5 to 10 when coarse residuals counted as gaps)."""
    if MPI.COMM_WORLD.size > 1:
        pytest.skip("the counts are those of one rank")
    rough = {"kind": "self-affine", "hurst": hurst, "lambda_s": wavelength, "rms_slope": 0.1}
    heights = surface({"grid": {"n": n}, "surface": rough, "solid": {"contact_modulus": 1.0}})
    contact = solve(heights, pressure, contact_modulus=1.0)
    assert contact.certified_error <= 1e-8
    assert contact.transforms <= most


@pytest.mark.parametrize(("shape", "sides", "most"), [((8192, 128), (1, 1), 9), ((512, 512), (1, 4), 5)])
@pytest.mark.parametrize("pressure", [0.01, 0.15])
def test_strips_and_oblong_pixels_take_few_transforms(shape, sides, most, pressure):
    """A certified 1e-8 within so many pairs, where grids and mesh coarsen by length (36 and 8 to 10 before)."""
    if MPI.COMM_WORLD.size > 1:
        pytest.skip("the counts are those of one rank")
    waves = [2 * np.pi * np.fft.fftfreq(n, side) for n, side in zip(shape, sides, strict=True)]
    q, noise = np.hypot(waves[0][:, None], waves[1]), np.random.default_rng(1).standard_normal(shape)
    rough = np.where((q > 0) & (q <= 2 * np.pi / 16 / max(sides)), np.maximum(q, 1e-30) ** -1.8, 0)
    heights = np.fft.ifft2(np.fft.fft2(noise) * rough).real
    slopes = np.gradient(heights, *sides)
    contact = solve(heights / np.hypot(*slopes).std(), pressure, spacing=sides)
    assert 0.01 < contact.contact_area < 0.6 and contact.certified_error <= 1e-8
    assert contact.transforms <= most
