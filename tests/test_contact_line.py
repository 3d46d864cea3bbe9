"""The contact line between pixels, against contacts whose line is known exactly: waves, discs, and their symmetries."""

import math

import numpy as np
import pytest
from conftest import SIZE
from contacts import elastic, rough_on, under_hard_wall
from mpi4py import MPI

from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables.contact import Contact
from pgfmd.observables.contact_area import LARGEST_RATIO, contact_line
from pgfmd.observables.contact_line import Tables, edge_table, locate
from pgfmd.observables.patch_table import label_patches
from pgfmd.observables.rough_surface import RoughSurface
from pgfmd.solvers.active_set.contact_from_coarse import solve_hard_wall
from pgfmd.surfaces.rigid_surface import coordinates
from pgfmd.theory import lattice_edge as theory
from pgfmd.theory.exact import Westergaard

pytestmark = pytest.mark.mpi


def solve(grid, heights, load, modulus=1.0, tolerance=1e-12):
    """Pressure and gap of a hard contact."""
    found = solve_hard_wall(under_hard_wall(grid, heights, load, elastic(modulus)), tolerance)
    return found.pressure, found.gap


def measure(grid, pressure, gap, modulus=1.0):
    """Area inside the line, and its length."""
    area, length = contact_line(grid, pressure, gap, elastic(modulus)).total()
    return grid.reduction.sum(pressure > 0) * grid.pixel_area + area, length


def shift_by_quadrature(normal, spacing=(1.0, 1.0), stiffness=lambda q: q):
    """δ = (1/π) ∫_0^∞ log(K(t)/K(|fold(t n)|)) dt/t²: the other form of `LatticeEdge.shift`, for any direction."""
    end = 1.05 * max(spacing) / np.pi  # of 1/t, where K(t) = K(|fold(t n)|)
    t = 1 / ((np.arange(400_000) + 0.5) / 400_000 * end)
    folded = [part * t - 2 * np.pi / step * np.round(part * t * step / (2 * np.pi))
              for part, step in zip(normal, spacing, strict=True)]  # fmt: skip
    return np.mean(np.log(stiffness(t) / stiffness(np.hypot(*folded)))) * end / np.pi


@pytest.mark.parametrize("spacing", [(1.0, 1.0), (1.0, 0.5)])
@pytest.mark.parametrize(("m", "k"), [(1, 0), (3, 1), (5, 4), (1, 1), (1, 4)])
def test_shift_has_two_forms(m, k, spacing):
    """The Wiener–Hopf series and the integral over all wave numbers give one δ; both have errors below 5e-4."""
    edge = theory.lattice_edge(m, k, spacing)
    assert math.hypot(*edge.normal) == pytest.approx(1, rel=1e-12, abs=0)
    assert edge.shift == pytest.approx(shift_by_quadrature(edge.normal, spacing), abs=5e-4)


@pytest.mark.parametrize(("base", "poisson"), [("bonded", 0.0), ("bonded", 0.4), ("sliding", 0.25)])
@pytest.mark.parametrize("thickness", [0.1, 0.5, 1.0, 2.0])
@pytest.mark.parametrize(("m", "k"), [(1, 0), (3, 1), (1, 1)])
def test_shift_on_a_slab_has_two_forms(m, k, thickness, base, poisson):
    """So does the stiffness of a slab give one δ."""
    stiffness = elastic(1.0, thickness, base, poisson).stiffness
    edge = theory.lattice_edge(m, k, stiffness=stiffness)
    assert edge.shift == pytest.approx(shift_by_quadrature(edge.normal, stiffness=stiffness), abs=5e-4)


@pytest.mark.parametrize(("m", "k"), [(1, 0), (2, 1)])
def test_edge_of_a_winkler_foundation(m, k):
    """With one stiffness for all waves pressures and gaps are linear in the distance, and pixels count right."""
    edge = theory.lattice_edge(m, k, stiffness=lambda q: np.full_like(q, 5.0))
    lines = np.arange(-20, 20)
    distance = edge.distance(lines, 0.3)
    np.testing.assert_allclose(edge.signed(lines, 0.3), np.where(distance > 0, distance, distance / 5), atol=1e-6)
    assert edge.shift == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(("m", "k"), [(1, 0), (2, 1), (4, 3)])
def test_edge_is_continuous_and_tends_to_the_continuum(m, k):
    """Moving the edge by one line of the grid is renumbering the lines; far inside p → √d, far outside g → (4/3)
    |d|^1.5, with corrections of relative order 1/d² that are below 1 % at d = 4."""
    edge = theory.lattice_edge(m, k, count=12 * (m + k))
    lines = np.arange(-6 * (m + k), 6 * (m + k))
    np.testing.assert_allclose(edge.signed(lines, 1.0)[1:], edge.signed(lines, 0.0)[:-1], rtol=1e-9, atol=1e-12)
    distance, signed = edge.distance(lines, 0.4), edge.signed(lines, 0.4)
    inside, outside = distance > 4, distance < -4
    np.testing.assert_allclose(signed[inside], np.sqrt(distance[inside]), rtol=0.01)
    np.testing.assert_allclose(-signed[outside], 4 / 3 * (-distance[outside]) ** 1.5, rtol=0.01)


def test_edge_is_the_solution_on_the_grid(comm):
    """Next to the edge of a wide wave, solved on the grid, pressures and gaps have the ratios of the edge problem, for
    the known place of the edge.  Terms of first order in distance over wavelength are left: at most 3π/1024 = 1 %."""
    n, fraction = 1024, 0.5
    grid = SlabGrid(comm, (n, 4))
    x, y = coordinates(grid)
    for phase in (0.1, 0.4, 0.7):
        heights = np.cos(2 * np.pi * (x - phase) / n) + 0 * y
        wave = Westergaard(1.0, n, 1.0)
        pressure, gap = solve(grid, heights, fraction * wave.full_pressure)
        profile = grid.fetch(pressure - gap, 0, n)[:, 0]
        half = n / math.pi * math.asin(math.sqrt(fraction))
        last = int(np.flatnonzero(profile[: n // 2] > 0)[-1])
        edge = theory.lattice_edge(1, 0)
        beta = 1 - (half + phase - last + edge.shift)
        expected = edge.signed(np.arange(-2, 3), beta)[::-1]
        found = profile[last - 2 : last + 3]
        np.testing.assert_allclose(found / found[1], expected / expected[1], rtol=0.01, atol=1e-3)


def test_staircase_is_the_mean_shift():
    """The constant is ∮ δ dθ / ∮ (|cos| + |sin|) dθ, here from 24 directions: to 1 %."""
    angles = (np.arange(24) + 0.5) / 24 * math.pi / 2
    mean = np.mean([shift_by_quadrature((math.cos(angle), math.sin(angle))) for angle in angles])
    assert theory.STAIRCASE == pytest.approx(mean * math.pi / 4, rel=0.01)


@pytest.mark.mpi("breadth")
@pytest.mark.parametrize("direction", [(1, 0), (0, 1), (9, 1), (5, 2), (3, 2), (4, 4), (1, 8)])
def test_straight_edges(comm, direction):
    """Edges of waves of any direction lie within .02 a (rms over offsets) of the exact ones, lengths within 2 %."""
    n, rng = 128, np.random.default_rng(12)
    waves = math.hypot(*direction) / n
    grid = SlabGrid(comm, (n, n))
    x, y = coordinates(grid)
    length, errors, lengths = 2 * n * n * waves, [], []
    for fraction in (0.3, 0.5, 0.7):
        for phase in rng.random(2):
            heights = np.cos(2 * np.pi * (direction[0] * x / n + direction[1] * y / n + phase))
            pressure, gap = solve(grid, heights, fraction * math.pi * waves)
            area, perimeter = measure(grid, pressure, gap)
            errors.append((area - n * n * 2 / math.pi * math.asin(math.sqrt(fraction))) / length)
            lengths.append(perimeter)
    assert np.mean(lengths) == pytest.approx(length, rel=0.02)
    assert np.sqrt(np.mean(np.square(errors))) < 0.02


@pytest.mark.mpi("breadth")
@pytest.mark.parametrize("direction", [(1, 0), (9, 1), (3, 2), (4, 4)])
def test_straight_edges_on_a_thin_slab(comm, direction):
    """A slab of .02 pixels answers a wave Δ cos(qx) like springs: p = k Δ (cos qx − cos φ) for |qx| < φ, p̄ = k Δ (sin
    φ − φ cos φ)/π.  The edges lie within .01 a of φ/q (rms); half-space edges lay .13 a outside."""
    n, rng = 128, np.random.default_rng(12)
    number = 2 * np.pi * math.hypot(*direction) / n
    grid, solid = SlabGrid(comm, (n, n)), elastic(1.0, 0.02)
    x, y = coordinates(grid)
    errors = []
    for half in (0.6, 1.3, 2.2):
        for phase in rng.random(2):
            heights = np.cos(2 * np.pi * (direction[0] * x / n + direction[1] * y / n + phase))
            load = float(solid.stiffness(np.array(number))) * (math.sin(half) - half * math.cos(half)) / math.pi
            found = solve_hard_wall(under_hard_wall(grid, heights, load, solid), 1e-12)
            beyond, _ = contact_line(grid, found.pressure, found.gap, solid).total()
            area = grid.reduction.sum(found.pressure > 0) + beyond
            errors.append((area - n * n * half / math.pi) / (n * n * number / math.pi))
    assert np.sqrt(np.mean(np.square(errors))) < 0.01


def test_stretched_pixels(comm):
    """The same on pixels twice as long as wide, in physical directions."""
    grid = SlabGrid(comm, (96, 128), (96.0, 64.0))
    x, y = coordinates(grid)
    wave = np.array([2 / 96, 1 / 64])
    heights = np.cos(2 * np.pi * (wave[0] * x + wave[1] * y + 0.137))
    number = math.hypot(*wave)
    pressure, gap = solve(grid, heights, 0.4 * math.pi * number)
    area, perimeter = measure(grid, pressure, gap)
    length = 2 * 96 * 64 * number
    assert abs(area - 96 * 64 * 2 / math.pi * math.asin(math.sqrt(0.4))) < 0.02 * length
    assert perimeter == pytest.approx(length, rel=0.01)


def disc(grid, radius, centre, modulus=1.0):
    """Pressure and gap of a paraboloid about `centre` whose contact has that radius."""
    lx, ly = grid.lengths
    x, y = coordinates(grid)
    dx, dy = (x - centre[0] + lx / 2) % lx - lx / 2, (y - centre[1] + ly / 2) % ly - ly / 2
    free = radius / (1 - 0.63902 * (radius / lx) ** 3)
    curvature = 10 * lx
    load = 4 * modulus * free**3 / (3 * curvature)
    return solve(grid, -(dx**2 + dy**2) / (2 * curvature), load / (lx * ly), modulus)


@pytest.mark.mpi("breadth")
@pytest.mark.parametrize(("radius", "within"), [(1.5, 0.03), (4.0, 0.01), (10.0, 0.001)])
def test_discs(comm, radius, within):
    """Area of a Hertz contact about any centre, rms over centres: 1 % asked for at 4 pixels radius (counting: 7 %). The
    errors are of the order of .1 pixel whatever the radius: 3 % at 1.5 pixels, .1 % at 10."""
    grid, rng = SlabGrid(comm, (64, 64)), np.random.default_rng(3)
    errors = []
    for _ in range(8):
        area, _ = measure(grid, *disc(grid, radius, 32 + rng.random(2)))
        errors.append(area / (math.pi * radius**2) - 1)
    assert np.sqrt(np.mean(np.square(errors))) < within


def test_perimeter_of_a_disc(comm):
    """Turning of the line is counted once around: the length of a circle of 10 pixels radius to 1 %."""
    grid = SlabGrid(comm, (64, 64))
    _, perimeter = measure(grid, *disc(grid, 10.0, (31.3, 32.8)))
    assert perimeter == pytest.approx(20 * math.pi, rel=0.01)


def rough(grid, seed=5):
    """A smooth random surface, the same on any rank count."""
    rng = np.random.default_rng(seed)
    x, y = coordinates(grid)
    heights = np.zeros(grid.local_shape)
    for kx, ky, phase, height in zip(
        rng.integers(-4, 5, 20), rng.integers(-4, 5, 20), rng.random(20), rng.random(20), strict=True
    ):
        heights += height * np.cos(2 * np.pi * (kx * x / grid.lengths[0] + ky * y / grid.lengths[1] + phase))
    return heights


def test_symmetries_and_units(comm):
    """Fields moved or transposed, other units, one rank alone: the same area and length, to rounding."""
    grid, alone = SlabGrid(comm, (48, 48)), SlabGrid(MPI.COMM_SELF, (48, 48))
    whole = solve(alone, rough(alone), 0.3)
    expected = measure(alone, *whole)
    assert expected[0] != np.count_nonzero(whole[0])
    changes = [lambda f: f, lambda f: np.roll(f, (7, -5), (0, 1)), lambda f: f.T, lambda f: f[::-1, :]]
    for change in changes:
        fields = [np.ascontiguousarray(change(field))[grid.rows] for field in whole]
        np.testing.assert_allclose(measure(grid, *fields), expected, rtol=1e-12)
    large = SlabGrid(comm, (48, 48), (48e3, 48e3))
    fields = [whole[0][grid.rows] * 7e9 / 1e3, whole[1][grid.rows]]
    area, length = measure(large, *fields, modulus=7e9)
    np.testing.assert_allclose([area / 1e6, length / 1e3], expected, rtol=1e-12)


def test_patches_share_the_line(comm):
    """Areas and perimeters of patches add up to those of the contact, for both connectivities and any slabs."""
    grid = SlabGrid(comm, (96, 64))
    pressure, gap = solve(grid, rough(grid), 0.05)
    line = contact_line(grid, pressure, gap, elastic(1.0))
    for connectivity in (4, 8):
        labels = label_patches(comm, pressure > 0, grid.starts, connectivity)
        found = [grid.reduction.sum(part) for part in line.of_patches(labels)]
        np.testing.assert_allclose(found, line.total(), rtol=1e-10)
        assert labels.count > 3


def test_nothing_and_everything(comm):
    """No contact and full contact have no line."""
    grid = SlabGrid(comm, (8, 12))
    for pressure in (0.0, 1.0):
        fields = np.full(grid.local_shape, pressure), np.full(grid.local_shape, 1 - pressure)
        assert contact_line(grid, *fields, elastic(1.0)).total() == (0.0, 0.0)


@pytest.mark.skipif(SIZE > 1, reason="once is enough")
def test_pressures_and_gaps_that_vanish():
    """Whatever pressures and gaps about a pair are next to nothing, the line passes within two pixels."""
    random, tables = np.random.default_rng(3), Tables((edge_table(1.0).values,) * 2)
    for least in (5e-324, 1e-303, 1e-150, 1e-30):
        around = random.choice([-0.0, least, -least, 1e-3, -0.1], (8, 2000))
        around[1], around[2] = random.choice([least, 1e-3], 2000), -random.choice([0.0, least, 0.1], 2000)
        offset, cosine = locate(around, np.zeros(2000, int), np.ones(2000), tables, LARGEST_RATIO)
        assert np.abs(offset).max() <= 2 and cosine.min() >= 0 and cosine.max() <= 2


@pytest.mark.parametrize(("wavelength", "resolved"), [(1.0, False), (2.0, False), (3.0, True)])
@pytest.mark.parametrize("hurst", [0.3, 0.9])
def test_no_line_where_roughness_goes_down_to_the_pixel(comm, hurst, wavelength, resolved):
    """The spectrum tells whether the grid resolves a surface, of which nothing else is known: from three points to its
    shortest wave on there is a line.  On a slab much thinner than a pixel there always is."""
    grid, heights = rough_on(comm, (64, 64), hurst, wavelength, 0.1, 3)
    for thickness, expected in ((math.inf, resolved), (0.1, True)):
        problem = under_hard_wall(grid, heights, 0.01, elastic(1.0, thickness))
        contact = Contact.of(RoughSurface(problem), solve_hard_wall(problem, 1e-6))
        assert (contact.line is not None) == expected
