"""Open boundaries: a patch of an infinite surface, against exact solutions, brute force and its own certificate."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import reference
from conftest import broad
from contacts import elastic, under_hard_wall
from mpi4py import MPI

import pgfmd
from pgfmd.application.job import load
from pgfmd.errors import InputError
from pgfmd.grid.domain import OPEN, Open
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.transfer import Interpolation, SubGrid, restrict_locally
from pgfmd.grid.transforms import sink, source
from pgfmd.observables.patch_table import label_patches
from pgfmd.physics.laws.hard import HardWall
from pgfmd.physics.problem import ContactProblem
from pgfmd.physics.solids import open_kernel
from pgfmd.physics.solids.homogeneous import Homogeneous
from pgfmd.physics.solids.layered import Layered
from pgfmd.solvers.active_set import cropping
from pgfmd.solvers.active_set.active_set import Relaxation, State
from pgfmd.solvers.active_set.contact_from_coarse import ActiveSetIteration
from pgfmd.solvers.controls import MeanGap
from pgfmd.solvers.dispatch import solve_contact
from pgfmd.solvers.options import Load, Solver
from pgfmd.surfaces.self_affine import self_affine

MODULUS = 1.7


def grid_of(shape, spacing=(1.0, 1.0), comm=MPI.COMM_SELF):
    """An open grid."""
    return SlabGrid(comm, shape, tuple(n * a for n, a in zip(shape, spacing, strict=True)), domain=OPEN)


def response(grid, pressure):
    """Gp, by transforms."""
    out = grid.new_field()
    grid.convolve(source(pressure), elastic(MODULUS).apply_compliance(grid, np.float64, 1 / grid.modes), sink(out))
    return out


def paraboloid(n, radius, centre=(0.0, 0.0)):
    """−r²/2R about a point near the middle, largest at 0."""
    x, y = (np.arange(n) - n / 2 - c for c in centre)
    return -(x[:, None] ** 2 + y**2) / (2 * radius)


def rough(n, seed=3, slope=0.1):
    """A rough sphere that touches within the patch."""
    return self_affine(SlabGrid(MPI.COMM_SELF, (n, n)), 0.8, 8.0, slope, seed) * 0.5 + paraboloid(n, 8 * n)


def solved(heights, force, tolerance=1e-10, **options):
    """The contact under a total force, spacing 1."""
    return pgfmd.solve(heights, force=force, boundary="open", contact_modulus=MODULUS, tolerance=tolerance, **options)


def matrix(grid):
    """G of all points of a small grid, column by column."""
    columns = []
    for k in range(grid.size):
        unit = np.zeros(grid.size)
        unit[k] = 1
        columns.append(response(grid, unit.reshape(grid.shape)).ravel())
    return np.array(columns)


def test_a_loaded_pixel_displaces_itself_and_others_as_on_a_half_space():
    """u(0) = 4 ln(1 + √2) p a/πE' to 1e-4, and p a²/πE'r elsewhere: to 2.4e-4 away from the axes, on which the modes
    that the grid lacks leave √2/(π²i) of it at distance i."""
    grid, pressure = grid_of((96, 64)), np.zeros((96, 64))
    pressure[20, 30] = 1.0
    u = response(grid, pressure) * math.pi * MODULUS
    assert abs(u[20, 30] / (4 * math.log(1 + math.sqrt(2))) - 1) < 1e-4
    x, y = np.arange(96)[:, None] - 20, np.arange(64) - 30
    wrong = u * np.hypot(x, y) - 1
    assert np.abs(wrong[(np.abs(x) >= 4) & (np.abs(y) >= 4)]).max() < 2.5e-4
    assert np.abs(np.abs(wrong[26:36, 30]) * np.arange(6, 16) - math.sqrt(2) / math.pi**2).max() < 3e-3


@pytest.mark.mpi
def test_the_response_does_not_depend_on_the_ranks():
    """G of a random pressure on uneven slabs is that on one rank."""
    pressure = np.random.default_rng(1).random((37, 20))
    grid = grid_of(pressure.shape, (1.0, 1.5), MPI.COMM_WORLD)
    with grid.freed():
        found = grid.fetch(response(grid, pressure[grid.rows]), 0, 37)
    assert np.abs(found - response(grid_of(pressure.shape, (1.0, 1.5)), pressure)).max() < 1e-12 * found.max()


def test_hertz():
    """Approach a²/R to 1e-5 in the mean of twenty random centres, and the pressure's L2 error ∝ pixel."""
    errors = []
    random = np.random.default_rng(7)
    for a, n in ((32, 72), (16, 36)):
        radius, shifts = 8.0 * n, random.random((20, 2))
        approaches, wrong = [], []
        for shift in shifts:
            heights = paraboloid(n, radius, shift)
            found = solved(heights, 4 * MODULUS * a**3 / (3 * radius))
            approaches.append((found.displacement - heights.max()) / (a**2 / radius) - 1)
            r2 = -2 * radius * heights
            exact = 2 * MODULUS / (math.pi * radius) * np.sqrt(np.maximum(a**2 - r2, 0))
            wrong.append(np.linalg.norm(found.pressure - exact) / np.linalg.norm(exact))
        errors.append((abs(np.mean(approaches)), np.mean(wrong)))
    assert errors[0][0] < 1e-5
    assert 1.5 < errors[1][1] / errors[0][1] < 2.7 and errors[0][1] < 6e-3


def test_cone():
    """P = π a² E' m/2 at the approach π a m/2 (Sneddon 1965), to 1e-5 in the mean of twenty random centres."""
    a, slope, n = 32, 0.1, 72
    values = []
    for shift in np.random.default_rng(2).random((20, 2)):
        x, y = (np.arange(n) - n / 2 - c for c in shift)
        heights = -slope * np.hypot(x[:, None], y)
        values.append(solved(heights, math.pi * a**2 * MODULUS * slope / 2).displacement - heights.max())
    assert abs(np.mean(values) / (math.pi * a * slope / 2) - 1) < 1e-5


def test_round_punch():
    """P/2E'δ = √(N/π) − .1291 for N pixels in the mean of twenty random centres, to .001: the punch of Boussinesq, P =
    2 E' a δ, with the radius of a disc of as many pixels less what its border takes."""
    lost, x = [], np.arange(64) - 32
    for shift in np.random.default_rng(3).random((20, 2)):
        inside = (x[:, None] - shift[0]) ** 2 + (x - shift[1]) ** 2 <= 20**2
        found = solved(np.where(inside, 0.0, -1e3), 10.0)
        lost.append(math.sqrt(inside.sum() / math.pi) - 10.0 / (2 * MODULUS * found.displacement))
    assert abs(np.mean(lost) - 0.1291) < 0.001


def test_square_punch():
    """P/1.1523 E'δ = n − .378 at n = 512 pixels, to .001; P is linear in an imposed δ."""
    found = solved(np.zeros((512, 512)), 1.0)
    assert abs(512 - 1.0 / (1.1523 * MODULUS * found.displacement) - 0.378) < 0.001
    n = 32
    punch = np.zeros((n, n))
    free = solved(punch, 1.0)
    imposed = pgfmd.solve(punch, displacement=1e3, contact_modulus=MODULUS, boundary="open", threads=1)
    assert abs(imposed.force / 1e3 * free.displacement - 1) < 2e-4  # linear; gap_tolerance is 1e-4


def test_two_distant_spheres():
    """Each raises the other: λ − λ₁ = P/(πE's) (1 + (4/15)(a/s)² − (2/π)(a/s)³), to 5e-4."""
    n, radius, a, s = 96, 600.0, 12.0, 56
    x, y = np.arange(n)[:, None], np.arange(n)
    left, right = (-((x - at) ** 2 + (y - 48.25) ** 2) / (2 * radius) for at in (20.3, 20.3 + s))
    both = np.maximum(left, right)
    one = np.where(left >= right, left, -1e3)
    force = 4 * MODULUS * a**3 / (3 * radius)
    alone, pair = solved(one, force), solved(both, 2 * force)
    expected = force / (math.pi * MODULUS * s) * (1 + 4 / 15 * (a / s) ** 2 - 2 / math.pi * (a / s) ** 3)
    assert abs((pair.displacement - alone.displacement) / expected - 1) < 5e-4


def test_translation_transpose_and_mirror():
    """A contact does not depend on where it lies in the patch, nor on the names and senses of the axes."""
    heights = rough(48)
    wide = np.full((80, 70), -1e3)
    wide[9:57, 20:68] = heights
    here = solved(heights, 8.0, 1e-12)
    there = solved(wide, 8.0, 1e-12)
    assert np.abs(there.pressure[9:57, 20:68] - here.pressure).max() < 1e-5 * here.pressure.max()
    assert abs(there.displacement / here.displacement - 1) < 1e-6
    turned = solved(np.ascontiguousarray(heights.T[::-1]), 8.0, 1e-12)
    assert np.abs(turned.pressure - here.pressure.T[::-1]).max() < 1e-5 * here.pressure.max()


@dataclass(frozen=True)
class Padded(Open):
    """Open boundaries on a larger torus."""

    beyond: tuple[int, int] = (0, 0)

    def torus(self, shape, spacing):
        nx, ny = super().torus(shape, spacing)
        return nx + 2 * self.beyond[0], ny + 2 * self.beyond[1]


@pytest.mark.parametrize("count", broad([40, 400]))
def test_certificate_and_solution_against_brute_force(count):
    """With any padding, and pixels to 10:1: the compliance is positive definite; the solution is that of the dense
    reference; neither the bound of a feasible pressure nor ½⟨ε, Kε⟩ of a random ε that obeys the conditions, and is
    anything in the padding, is below the true error."""
    random = np.random.default_rng(11)
    for _ in range(count):
        shape, spacing = random.integers(2, 9, 2).tolist(), (1.0, 10 ** random.uniform(-1, 1))
        beyond, heights = random.integers(0, 17, 2).tolist(), random.normal(size=shape)
        mean = 10 ** random.uniform(-2, 1)
        side = tuple(n * a for n, a in zip(shape, spacing, strict=True))
        grid = SlabGrid(MPI.COMM_SELF, shape, side, domain=Padded(beyond=beyond))
        contact = reference.OpenContact(heights, spacing, reference.Solid(MODULUS), grid.torus)
        unit, dense = float(contact.pixel), contact.compliance.astype(float)
        assert np.abs(matrix(grid) / unit - dense).max() < 1e-13 and np.linalg.eigvalsh(dense).min() > 0
        problem = under_hard_wall(grid, heights, mean, elastic(MODULUS))
        found, exact = solve_contact(problem, Solver(tolerance=1e-12)), contact.hard(mean)
        assert exact.error_of(found.pressure) <= found.certified_error <= 1e-12
        table = open_kernel.half_space_table(grid) / MODULUS
        columns, rows = (np.minimum(np.arange(m), m - np.arange(m)) for m in grid.torus[::-1])
        stiffness = 1 / table[columns][:, rows].T
        stiffness[0, 0] = 0
        wrong = np.maximum(exact.x.astype(float) * (1 + random.uniform(0.01, 0.5) * random.normal(size=grid.size)), 0)
        wrong = wrong.reshape(shape) * (mean * grid.size / wrong.sum())
        state, relaxation = State(wrong.copy(), grid.new_field()), Relaxation(problem)
        relaxation.compute_gap(state, np.float64)
        relaxation.measure(state)
        lost = float(exact.error_of(wrong) * exact.scaled_work) * mean**2 * unit
        assert relaxation.bound(state, np.float64) * 2 * state.energy >= lost > -1e-12
        rho = random.normal(size=grid.torus)
        rest = state.gap - state.level
        inside = rho[: shape[0], : shape[1]]
        inside[...] = np.where(wrong > 0, rest, rest - 10 ** random.uniform(-3, 0) * np.abs(inside))
        assert np.sum(np.abs(np.fft.fft2(rho)) ** 2 * stiffness) / rho.size / 2 >= lost


@pytest.mark.parametrize("spacing", [(1.0, 120.0), (1.0, 900.0), (300.0, 1.0)])
def test_very_oblong_pixels(spacing):
    """A torus that is long for the sake of its kernel does not ask for blocks larger than the patch."""
    heights = np.random.default_rng(1).standard_normal((12, 10))
    assert pgfmd.solve(heights, 0.05, spacing=spacing, boundary="open").certified_error <= 1e-8


def test_the_periodic_limit():
    """Far from the border, a small contact in a periodic cell differs by 1.6 to 2.2 (a/L)³."""
    n, radius, a = 96, 700.0, 12.0
    heights, force = paraboloid(n, radius), 4 * MODULUS * a**3 / (3 * radius)
    cell = pgfmd.solve(heights, force=force, contact_modulus=MODULUS, tolerance=1e-12).pressure
    patch = solved(heights, force, 1e-12).pressure
    ratio = np.linalg.norm(cell - patch) / np.linalg.norm(patch) / (a / n) ** 3
    assert 1.6 < ratio < 2.2


@pytest.mark.mpi
@pytest.mark.parametrize("worth", [0.0, cropping.WORTH])
def test_ranks_agree_on_a_contact(worth, monkeypatch):
    """Pressure, approach, patches and line on any number of ranks are those of one, at odd sizes with a mesh, on the
    whole patch and on a rectangle of it: certified to 1e-22, pressures to 1e-10, of the order of its root."""
    monkeypatch.setattr(cropping, "WORTH", worth)
    heights = rough(259)
    grid = SlabGrid(MPI.COMM_WORLD, heights.shape)
    found = pgfmd.solve(heights[grid.rows], force=60.0, boundary="open", contact_modulus=MODULUS, tolerance=1e-22,
                        comm=MPI.COMM_WORLD)  # fmt: skip
    alone = solved(heights, 60.0, 1e-22)
    assert np.abs(found.pressure - alone.pressure[grid.rows]).max() < 1e-10 * alone.pressure.max()
    assert abs(found.displacement / alone.displacement - 1) < 1e-10
    assert abs(found.iterations - alone.iterations) <= 2
    ours, theirs = found.observables("patches"), alone.observables("patches")
    if grid.comm.rank == 0:
        assert np.array_equal(ours["patches"]["area"], theirs["patches"]["area"])
    assert abs(found.contact_area_corrected - alone.contact_area_corrected) < 1e-6


def test_a_cropped_contact_is_that_of_the_patch(monkeypatch):
    """Cropped or not, a contact off the middle is the same to the certificate, that of the patch itself."""
    heights = rough(300, 5)[40:, :260]
    cropped = solved(heights, 60.0, 1e-12)
    monkeypatch.setattr(cropping, "WORTH", 0.0)
    whole = solved(heights, 60.0, 1e-12)
    assert cropped.transforms < 0.8 * whole.transforms
    assert np.linalg.norm(cropped.pressure - whole.pressure) < 1e-5 * np.linalg.norm(whole.pressure)
    assert np.abs(cropped.gap - whole.gap).max() < 1e-7 * whole.gap.max()
    for name in ("displacement", "mean_gap", "elastic_energy"):
        assert abs(getattr(cropped, name) / getattr(whole, name) - 1) < 1e-6
    assert cropped.mean_pressure == pytest.approx(np.mean(cropped.pressure), rel=1e-12)
    again = pgfmd.certify(heights, cropped.pressure, contact_modulus=MODULUS, boundary="open")
    assert abs(again.certified_error / cropped.certified_error - 1) < 0.3 and cropped.certified_error < 1e-12


def test_a_high_punch_under_a_light_load():
    """Coarse heights overshoot beside its edge, by far more than it sinks in: F/(E' δ) is that of a low one."""
    x, y = np.indices((256, 256)) - 127.5
    inside = x**2 + y**2 < 42**2
    low, high = (solved(np.where(inside, 0.0, depth), 30.0, 1e-8) for depth in (-1.0, -500.0))
    assert high.displacement == pytest.approx(low.displacement, rel=1e-6)
    assert high.contact_area == low.contact_area == np.count_nonzero(inside) / inside.size


@pytest.mark.parametrize("margin", [0.4, 0.7])
def test_a_rectangle_is_enlarged_until_it_is_proved(margin, monkeypatch):
    """A rectangle that cuts off contact (.4), or might (.7), is not taken; no point outside the last one touches."""
    heights = paraboloid(260, 900, (50, -40))
    usual = solved(heights, 30.0, 1e-12)
    taken, solve = [], cropping._on_rectangle

    def follow(problem, box, *options):
        found, proved = solve(problem, box, *options)
        taken.append((box, proved))
        return found, proved

    monkeypatch.setattr(cropping, "_on_rectangle", follow)
    monkeypatch.setattr(cropping, "MARGIN", margin)
    found = solved(heights, 30.0, 1e-12)
    assert [proved for _, proved in taken] == [False, True]
    assert np.linalg.norm(found.pressure - usual.pressure) < 1e-5 * np.linalg.norm(usual.pressure)
    (top, bottom), (left, right) = taken[-1][0]
    outside = np.ones(found.pressure.shape, bool)
    outside[top:bottom, left:right] = False
    assert not found.pressure[outside].any() and found.gap[outside].min() > 0 and found.gap.min() == 0


@pytest.mark.parametrize("n", [512, 1024])
def test_a_small_sphere_costs_less_than_a_pair(n):
    """Contact of radius .05 L, to 1e-8, at random centres near the middle: at most the work of one periodic pair of
    transforms.  (Near a corner 1.7, as the torus is larger.)"""
    for centre in np.random.default_rng(3).random((3, 2)):
        found = solved(paraboloid(n, 8 * n, centre), 4 * MODULUS * (0.05 * n) ** 3 / (24 * n), 1e-8)
        assert found.transforms <= 1


@pytest.mark.parametrize("control", ["contact_area", "mean_gap", "displacement", "force"])
def test_what_a_load_gives_imposed_gives_the_load(control):
    """Area, mean gap, displacement and force of a solution, imposed, lead back to its pressure."""
    heights = rough(40)
    known = solved(heights, 9.0)
    targets = {"contact_area": known.contact_area, "mean_gap": known.mean_gap, "displacement": known.displacement,
               "force": 9.0}  # fmt: skip
    found = pgfmd.solve(heights, boundary="open", contact_modulus=MODULUS, **{control: float(targets[control])})
    assert abs(found.mean_pressure / known.mean_pressure - 1) < (0.03 if control == "contact_area" else 2e-4)
    assert abs(known.mean_gap - known.gap.mean()) < 1e-12


@pytest.mark.parametrize(
    ("control", "n", "within", "work"), [("displacement", 128, 1e-4, 1.7), ("mean_gap", 256, 3e-4, 5)]
)
def test_a_target_costs_a_few_solutions(control, n, within, work):
    """At most so many times the work of the load that it gives; a displacement one solution, also of a whole patch."""
    heights = self_affine(SlabGrid(MPI.COMM_SELF, (n, n)), 0.8, 8.0, 0.1, 3)
    for pressure in (0.002, 0.02):
        options = {"boundary": "open", "contact_modulus": 1.0}
        known = pgfmd.solve(heights, pressure, **options)
        found = pgfmd.solve(heights, **{control: getattr(known, control)}, **options)
        assert abs(found.mean_pressure / pressure - 1) < within and found.transforms < work * known.transforms


@pytest.mark.parametrize("seed", range(4))
def test_the_bound_of_a_mean_gap(seed):
    """Uniform pressure has the response's mean; loose solutions miss the best mean gap by what certificates allow."""
    shape, rng = [(64, 64), (40, 23), (17, 50), (96, 64)][seed], np.random.default_rng(seed)
    grid, law = grid_of(shape), HardWall()
    heights = self_affine(SlabGrid(MPI.COMM_SELF, shape), 0.6, 4.0, 0.1, seed + 1)
    problem = ContactProblem(grid, heights, Homogeneous(contact_modulus=MODULUS), law)
    control = MeanGap(problem, Load(mean_gap=(0.1,)))
    assert abs(control._uniform / response(grid, np.ones(shape)).mean() - 1) < 1e-12
    worst = 0.0
    for pressure in 10.0 ** rng.uniform(-3, -1, 6) * MODULUS:
        best = pgfmd.solve(heights, pressure, boundary="open", contact_modulus=MODULUS, tolerance=1e-14)
        for tolerance in 10.0 ** rng.uniform(-6, -1, 4):
            loose = ActiveSetIteration.contact(problem.at(pressure), tolerance)
            allowed = control.uncertainty(loose, best.mean_gap) * control.allowed(loose, best.mean_gap)
            worst = max(worst, abs(loose.mean_gap - best.mean_gap) / allowed)
    assert 0.1 < worst <= 1


@pytest.mark.parametrize("wall", [{"kind": "hardness", "hardness": 0.06}, {"kind": "exponential", "zeta": 0.02}])
def test_other_walls_obey_their_law(wall):
    """Pressure and gap of a certified solution are those of the law, with the displacement of the dense response."""
    heights = rough(24, slope=0.3)
    found = pgfmd.solve(heights, force=6.0, boundary="open", contact_modulus=MODULUS, wall=wall, tolerance=1e-12)
    u = response(grid_of(heights.shape), found.pressure)
    rest = u - heights - (found.gap - found.plastic_depth)  # the level, the same everywhere
    inside = found.pressure > 0
    assert np.ptp(rest[inside]) < 1e-4 * np.ptp(heights) and abs(rest[inside].mean() - found.displacement
                                                                 + heights.max()) < 1e-4  # fmt: skip
    if wall["kind"] == "exponential":
        assert np.allclose(found.pressure, MODULUS * np.exp(-found.gap / 0.02), rtol=2e-2, atol=1e-6)
    else:
        assert found.pressure.max() <= 0.06 and (found.pressure == 0.06).any()


@pytest.mark.parametrize("imposed", [{"mean_gap": 0.3}, {"displacement": -0.3}, {"displacement": 0.05}])
def test_a_flat_patch_under_a_wall_with_a_range(imposed):
    """A mean gap above or a displacement before first contact leads to a load, as on a rough patch."""
    wall = {"kind": "exponential", "zeta": 0.1}
    found = pgfmd.solve(np.zeros((8, 8)), boundary="open", contact_modulus=MODULUS, wall=wall, **imposed)
    (name, target), = imposed.items()
    assert abs(getattr(found, name) - target) < 1e-5
    assert np.allclose(found.pressure, MODULUS * np.exp(-found.gap / 0.1), rtol=1e-2)


def test_coarse_fields_lie_between_the_points():
    """Restriction and interpolation keep a plane away from the border, and mirror at it."""
    fine = grid_of((41, 40))
    place = SubGrid.coarse(fine)
    x, y = np.arange(41)[:, None], np.arange(40)
    plane = 0.3 * x + 0.1 * y
    coarse = restrict_locally(fine, place, plane)
    centres = 0.3 * (2 * np.arange(21)[:, None] + 0.5) + 0.1 * (2 * np.arange(20) + 0.5)
    assert np.abs(coarse - centres)[2:-3, 2:-2].max() < 1e-5
    rows = Interpolation(place, fine, [centres]).rows(0, 0, 41)
    assert np.abs(rows - plane)[4:-4, 4:-4].max() < 1e-9
    steps = np.repeat(np.arange(21.0)[:, None], 20, 1)
    first = Interpolation(place, fine, [steps]).rows(0, 0, 1)[0, 0]  # −¼, between the mirrored points −2, −1, 0, 1
    assert abs(first - np.dot([-0.0390625, 0.2734375, 0.8203125, -0.0546875], [1, 0, 0, 1])) < 1e-12


@pytest.mark.mpi
def test_patches_do_not_wrap():
    """A patch that reaches two opposite borders is one patch, two at opposite borders are two."""
    comm = MPI.COMM_WORLD
    mask = np.zeros((12, 9), bool)
    mask[0, 2:4] = mask[-1, 2:4] = mask[5, 0] = mask[5, -1] = True
    starts = SlabGrid(comm, mask.shape).starts
    rows = slice(starts[comm.rank], starts[comm.rank + 1])
    assert label_patches(comm, mask[rows], starts, 8, False).count == 4
    assert label_patches(comm, mask[rows], starts, 8, True).count == 2


@pytest.mark.mpi
def test_pressure_at_the_border_is_counted(caplog):
    """A warning counts the border's points that touch, corners once, on any number of ranks; there is none without."""
    grid = SlabGrid(MPI.COMM_WORLD, (30, 24))
    heights = paraboloid(30, 100.0)[:, :24]
    options = {"boundary": "open", "contact_modulus": MODULUS, "comm": MPI.COMM_WORLD}
    corner = np.maximum(heights, np.roll(heights, (15, 15), (0, 1)))
    for surface, force in ((heights, 1.0), (corner, 1e4)):
        found = pgfmd.solve(surface[grid.rows].copy(), force=force, **options)
        pressure, (first, stop) = found.pressure, (grid.rows.start, grid.rows.stop)
        border = np.ones(grid.shape, bool)
        border[1:-1, 1:-1] = False
        count = int(grid.reduction.sum(np.count_nonzero(pressure[border[first:stop]])))
        caplog.clear()
        found.warn_at_border()
        expected = [f"{count} points at the border"] if count and grid.comm.rank == 0 else []
        assert [text[: len(expected[0])] for text in caplog.messages] == expected
        assert (count > 0) == (surface is corner)


def test_what_open_boundaries_do_not_have_is_refused_by_name():
    """Observables of a period, dynamics, other transforms and refinement: one line that names them."""
    heights = rough(16)
    contact = solved(heights, 1.0)
    for name in ("acf", "gap_spectrum", "lowpass", "discretisation", "subsurface", "percolation", "gap_slope"):
        with pytest.raises(InputError, match=f"{name} needs a period"):
            contact.observables(name)
    for options in ({"method": "gfmd"}, {"refine": 2}, {"thickness": 5.0, "base": "free"}):
        with pytest.raises(InputError, match="open"):
            solved(heights, 1.0, **options)
    with pytest.raises(InputError, match="mpi4py-fft"):
        SlabGrid(MPI.COMM_SELF, (8, 8), transform="mpi4py-fft", domain=OPEN)


def test_a_job_with_a_force(tmp_path):
    """`jobs/sphere.toml` on fewer points: the force is that asked for, and the approach Hertz's a²/R to 1 %."""
    job = Path(__file__).parents[1] / "jobs" / "sphere.toml"
    results = pgfmd.run(load(str(job), ["grid.n=48"]), tmp_path / "out")
    row = results[0].numbers
    assert abs(row["mean_pressure"] / 0.0013333333333333335 - 1) < 1e-12 and row["target"] == 0.0013333333333333335
    assert abs(row["displacement"] / 0.01 - 1) < 0.01
    assert results.field("pressure", 0).max() > 0


def test_bodies_of_the_table():
    """Cone and punch as their keys say: round and square ends, tilt, rounded border."""
    grid = {"n": 32, "boundary": "open"}
    r = np.hypot(np.arange(32)[:, None] - 16, np.arange(32) - 16)
    assert np.allclose(pgfmd.surface({"grid": grid, "surface": {"kind": "cone", "slope": 0.2}}), -0.2 * r)
    end = pgfmd.surface({"grid": grid, "surface": {"kind": "punch", "radius": 8.0, "tilt": [0.1, 0.0]}})
    flat = 0.1 * (np.arange(32)[:, None] - 16.0)
    assert np.allclose(end, flat - 1e3 * (r > 8))
    rounded = {"kind": "punch", "radius": 8.0, "shape": "square", "edge": 4.0}
    beyond = np.maximum(np.maximum(np.abs(np.arange(32) - 16)[:, None], np.abs(np.arange(32) - 16)) - 8.0, 0)
    assert np.allclose(pgfmd.surface({"grid": grid, "surface": rounded}), -(beyond**2) / 8)


@pytest.mark.parametrize("base", ["bonded", "sliding"])
def test_slabs(base):
    """A slab is the half-space if it is thick, and responds beyond some thicknesses to nothing if it is thin: a contact
    in the middle of a patch is then that of a periodic cell, up to how waves beyond the grid's end on either torus.
    Between them two ways to the symbol agree to 1e-8."""
    heights, force = rough(48), 8.0
    options = {"force": force, "contact_modulus": MODULUS, "base": base, "poisson": 0.3, "tolerance": 1e-12}
    thick = pgfmd.solve(heights, boundary="open", thickness=1e6, **options)
    half = solved(heights, force, 1e-12)
    assert np.abs(thick.pressure - half.pressure).max() < 1e-5 * half.pressure.max()
    thin, cell = (pgfmd.solve(heights, boundary=name, thickness=1.5, **options) for name in ("open", "periodic"))
    assert np.abs(thin.pressure - cell.pressure).max() < 1e-4 * thin.pressure.max()
    if base == "bonded":  # on a sliding base the mean mode of a cell is uniaxial strain
        assert abs(thin.displacement / cell.displacement - 1) < 1e-5
    slab, grid = Homogeneous(contact_modulus=1.0, poisson=0.3, thickness=3.8, base=base), grid_of((96, 96))
    tables = []
    for thin_to in (1.0, 0.0):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(open_kernel, "THIN", thin_to)
            tables.append(open_kernel.layer_table(grid, slab, slab.thickness))
    assert np.abs(tables[0] - tables[1]).max() < 1e-8 * tables[0].max()


@pytest.mark.parametrize("n", [6, 24])
def test_slabs_of_few_spacings_on_small_patches(n):
    """From a third of a spacing to three, and above: the table is that of the kernel of a far larger torus, cut off, to
    1 %, as the waves that the grid lacks end elsewhere."""
    grid, wide = grid_of((n, n)), grid_of((300, 300))
    for thickness in (0.3, 0.6, 1.0, 2.9, 3.2):
        slab = Homogeneous(contact_modulus=1.0, poisson=0.3, thickness=thickness, base="bonded")
        expected = open_kernel.cropped_table(wide, grid, slab.open_table(wide))
        assert np.abs(slab.open_table(grid) - expected).max() < 0.01 * expected.max()


@pytest.mark.parametrize("thickness", [0.7, 6.0])
def test_layers(thickness):
    """A layer of the base's own material is a half-space; a soft one between ends where both half-spaces are: far away
    the response is that of the base, to 1 % at 10 thicknesses or more."""
    grid = grid_of((96, 64))
    layer = {"contact_modulus": 1.0, "poisson": 0.3, "thickness": thickness, "base_poisson": 0.3}
    same, soft = (Layered(base_modulus=modulus, **layer) for modulus in (1.0, 4.0))
    table = open_kernel.half_space_table(grid)
    assert np.abs(same.open_table(grid) / table - 1).max() < 1e-12
    pressure, u = np.zeros(grid.shape), grid.new_field()
    pressure[4, 4] = 1.0
    grid.convolve(source(pressure), soft.apply_compliance(grid, np.float64, 1 / grid.modes), sink(u))
    x, y = np.arange(96)[:, None] - 4, np.arange(64) - 4
    far = (np.hypot(x, y) > 60) & (np.abs(x) > 8) & (np.abs(y) > 8)
    assert np.abs(u * np.hypot(x, y) * math.pi * 4.0 - 1)[far].max() < 0.03
    assert soft.open_table(grid).min() > 0
