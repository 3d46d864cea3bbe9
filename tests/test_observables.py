"""What is measured on a contact, against brute-force sums over whole fields, exact rules and known distributions."""

import itertools
import math
import tracemalloc

import numpy as np
import pytest
from contacts import elastic, rough_on, solution_of, under_hard_wall
from mpi4py import MPI
from whole_fields import rowblocks

from pgfmd.errors import InputError, SolverError
from pgfmd.grid.cell import Cell
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.transforms import source
from pgfmd.observables import binning, histogram, schema
from pgfmd.observables.contact import Contact
from pgfmd.observables.contact_area import contact_area, line_of
from pgfmd.observables.histogram import linear_edges, log_edges, pressure_groups
from pgfmd.observables.lowpass import coarsening, lowpass, octaves, touches_fully
from pgfmd.observables.observable_kinds import LAYOUT, OBSERVABLES
from pgfmd.observables.rough_surface import Rings, RoughSurface, correlate, indicator, mode_rings
from pgfmd.physics.laws.exponential_law import ExponentialWall
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.active_set.contact_from_coarse import solve_hard_wall
from pgfmd.solvers.dispatch import solve_contact
from pgfmd.surfaces.self_affine import self_affine
from pgfmd.surfaces.sinusoid import sinusoid
from pgfmd.theory import persson

pytestmark = [pytest.mark.mpi, pytest.mark.uneven]

MODULUS = 8 / 3
NAMES = ["histogram", "spectra", "acf", "patches", "bearing", "lowpass"]
# Square, odd and stretched, more columns than rows, one row per rank
GRIDS = [((24, 24), (24.0, 24.0)), ((15, 22), (30.0, 7.0)), ((4, 9), (4.0, 9.0))]
CASES = pytest.mark.parametrize(("shape", "lengths"), GRIDS)


def fields(shape):
    """Whole fields: rough heights, and a pressure with exact zeros that follows them."""
    rng = np.random.default_rng(11)
    heights = rng.normal(size=shape)
    heights += 3 * np.cos(2 * np.pi * np.arange(shape[0]) / shape[0])[:, None]
    return heights, np.maximum(heights + 0.3 * rng.normal(size=shape) - 1.5, 0)


def asked(names, **tables):
    """Observables by name, with their tables of options."""
    return [OBSERVABLES[name](**tables.get(name, {})) for name in names]


def observe(comm, shape, lengths, names=NAMES[:5], cutoff=None, **tables):
    """Groups of whole fields that are cut into slabs; those of rank 0 on every rank."""
    grid = SlabGrid(comm, shape, lengths)
    heights, pressure = (field[grid.rows].copy() for field in fields(shape))
    surface = RoughSurface(under_hard_wall(grid, heights, solid=elastic(MODULUS)), asked(names, **tables), cutoff)
    return comm.bcast(Contact.of(surface, solution_of(pressure)).measure())


def whole_transform(field):
    """f̂(q) = Σ f exp(−iq·r) by the defining sum, (nx, ny), in the order of numpy.fft."""
    along = [np.exp(-2j * np.pi * np.outer(np.arange(n), np.arange(n)) / n) for n in field.shape]
    return along[0] @ field @ along[1].T


def whole_wave_numbers(shape, lengths):
    """|q| of every mode, (nx, ny)."""
    along = [2 * np.pi * np.fft.fftfreq(n, length / n) for n, length in zip(shape, lengths, strict=True)]
    return np.hypot(along[0][:, None], along[1][None, :])


def ring_means(edges, place, value):
    """Mean place, mean value and number of points in each bin that holds any: rows of (m', 3)."""
    rings = [(place > low) & (place <= high) for low, high in itertools.pairwise(edges)]
    return np.array([(place[ring].mean(), value[ring].mean(), ring.sum()) for ring in rings if ring.any()])


@CASES
@pytest.mark.parametrize("bins", [("log", 20), ("log", 4), ("linear", 7)])
def test_spectra_are_brute_force_sums(comm, shape, lengths, bins):
    """Each spectrum is the mean over all modes of a ring of |f̃|², f̃ = (1/N) Σ f exp(−iq·r); cross: of Re h̃* σ̃.
    Both sides round at 1e-16 of the largest mode; the cross spectrum is a difference of sums, hence its margin."""
    found = observe(comm, shape, lengths, spectra={"spacing": bins[0], "bins": bins[1]})
    heights, pressure = fields(shape)
    h, p, c = (whole_transform(f) / f.size for f in (heights, pressure, (pressure > 0).astype(float)))
    expected = {"stress": abs(p) ** 2, "contact": abs(c) ** 2, "height": abs(h) ** 2, "cross": (np.conj(h) * p).real}
    place = whole_wave_numbers(shape, lengths)
    for name, values in expected.items():
        group = found[f"{name}_spectrum"]
        rings = ring_means(group["edges"], place, values)
        q, value, modes = (group[key] for key in ("q", "value", "count"))
        np.testing.assert_allclose(np.transpose([q, modes]), rings[:, [0, 2]], rtol=1e-13)
        scale = abs(values[place > 0]).max()
        np.testing.assert_allclose(value, rings[:, 1], rtol=1e-12, atol=1e-13 * scale)


@CASES
@pytest.mark.parametrize("bins", [("log", 20), ("linear", 3)])
def test_autocorrelations_are_brute_force_means(comm, shape, lengths, bins):
    """C(Δr) = ⟨f(r) f(r + Δr)⟩, averaged over rings of Δr and along both axes; C(0), the mean square, in a bin of its
    own; rounding only."""
    found = observe(comm, shape, lengths, acf={"spacing": bins[0], "bins": bins[1]})
    heights, pressure = fields(shape)
    place = rowblocks.distances(shape, lengths)
    for name, field in {"stress": pressure, "contact": (pressure > 0) * 1.0, "height": heights}.items():
        shifts = np.ndindex(shape)
        expected = np.reshape([np.mean(field * np.roll(field, shift, (0, 1))) for shift in shifts], shape)
        group = found[f"{name}_acf"]
        rings = ring_means(group["edges"], place, expected)
        got = np.transpose([group[key] for key in ("r", "value", "count")])
        np.testing.assert_allclose(got, rings, rtol=1e-12, atol=1e-13)
        assert got[0].tolist() == [0, pytest.approx(np.mean(field**2), rel=1e-13, abs=0), 1]
        for axis, (label, line) in enumerate({"x": expected[:, 0], "y": expected[0]}.items()):
            lags = np.arange(shape[axis] // 2 + 1)
            np.testing.assert_allclose(found[f"{name}_acf_{label}"]["value"], line[lags], rtol=1e-12, atol=1e-13)
            step = lengths[axis] / shape[axis]
            np.testing.assert_allclose(found[f"{name}_acf_{label}"]["r"], lags * step, rtol=1e-15)


def sum_rule_residuals(grid, pressure):
    """How far spectra and real-space means of a distributed pressure are from obeying the exact rules, relatively.
    |Θ̃(0)|² = f_c², |σ̃(0)|² = ⟨σ⟩², Σ |Θ̃|² = f_c, Σ |σ̃|² = ⟨σ²⟩, and with m₂ = ⟨σ²⟩ f_c/⟨σ⟩² f_c Σ_{q≠0}
    |f̃|²/|f̃(0)|² is 1 − f_c for the contact and m₂ − f_c for the stress."""
    modes = mode_rings(grid, binning.wave_number_bins(grid.shape, grid.lengths))
    c, s = (correlate(grid, fill, modes).power for fill in (indicator(pressure, 0.0), source(pressure)))
    sums = pressure > 0, pressure, pressure**2
    fraction, mean, square = (grid.reduction.sum(each) / grid.size for each in sums)
    m2 = square * fraction / mean**2
    return {
        "contact_zero": c[0] / fraction**2 - 1,
        "stress_zero": s[0] / mean**2 - 1,
        "contact_sum": c.sum() / fraction - 1,
        "stress_sum": s.sum() / square - 1,
        "contact_rest": fraction * c[1:].sum() / c[0] - (1 - fraction),
        "stress_rest": (fraction * s[1:].sum() / s[0] - (m2 - fraction)) / m2,
    }


@pytest.mark.parametrize("n", [96, pytest.param(4096, marks=pytest.mark.long)])
def test_sum_rules(comm, n):
    """The exact sum rules of stress and contact spectra to 1e-10: N roundings of 1e-16 add up.  They hold for any
    field, here a rough one that is cut off at zero, with f_c near 0.08."""
    grid, heights = rough_on(comm, (n, n), 0.3, 1, 0.031, 3)
    height = np.sqrt(grid.reduction.dot(heights, heights) / grid.size)
    pressure = np.maximum(heights - 1.4 * height, 0)
    residuals = sum_rule_residuals(grid, pressure)
    if comm.rank == 0:
        print({name: f"{value:.1e}" for name, value in residuals.items()})
    assert max(map(abs, residuals.values())) <= 1e-10


def test_spectra_end_at_the_cut_off(comm):
    """With q_max no mode beyond it enters any average."""
    q_max = 2 * np.pi / 5
    place = whole_wave_numbers((24, 24), (24.0, 24.0))
    found = observe(comm, (24, 24), (24.0, 24.0), cutoff=q_max)["stress_spectrum"]
    assert found["count"].sum() == np.count_nonzero((place > 0) & (place <= q_max))


def test_spectra_of_all_modes(comm):
    """With all_modes, the averages hold every mode of the grid, and with q = 0 the whole mean square (Parseval)."""
    pressure = fields((24, 24))[1]
    found = observe(comm, (24, 24), (24.0, 24.0), cutoff=2 * np.pi / 5, spectra={"all_modes": True})["stress_spectrum"]
    assert found["count"].sum() == pressure.size - 1
    total = np.sum(found["value"] * found["count"]) + pressure.mean() ** 2
    assert total == pytest.approx(np.mean(pressure**2), rel=1e-12, abs=0)


@CASES
def test_groups_do_not_depend_on_ranks(comm, shape, lengths):
    """All groups on these ranks are those of one rank: counts, bins and thresholds bit for bit, sums to rounding.  A
    fit is found where its misfit is lowest: to the square root of rounding."""
    together, alone = observe(comm, shape, lengths), observe(MPI.COMM_SELF, shape, lengths)
    assert together.keys() == alone.keys()
    for group, columns in alone.items():
        assert columns.keys() == together[group].keys()
        for key, values in columns.items():
            exact = key in ("edges", "count", "threshold", "area", "extent_x", "extent_y")
            rtol, margin = (0, 0) if exact else (1e-11, 1e-13 * np.max(np.abs(values), initial=0))
            rtol = 1e-6 if group == "persson_fit" else rtol
            np.testing.assert_allclose(together[group][key], values, rtol, margin, err_msg=f"{group}/{key}")


def test_groups_are_in_the_schema(comm):
    """Every dataset has its unit and description, of all observables of a hard wall at a given load."""
    names = OBSERVABLES.keys() - {"adhesion", "closing_load"}
    found = observe(comm, (24, 24), (24.0, 24.0), names, partial_slip={"friction": 0.3})
    for group, columns in found.items():
        for name, values in columns.items():
            axes = LAYOUT[group][name].axes
            assert np.ndim(values) == len(axes)
            assert all(len(columns[axis]) == size for axis, size in zip(axes, np.shape(values), strict=True))


@pytest.mark.parametrize(
    ("names", "first", "each"),
    [((), 0.5, 0), (("histogram", "patches"), 0.5, 0), (("spectra",), 0.5, 1.5), (("acf",), 1, 2),
     (("spectra", "acf"), 1, 2.5), (("bearing",), 0.5, 0), (("spectra", "bearing"), 0.5, 2)],
)  # fmt: skip
def test_work(comm, names, first, each):
    """Only what is asked for is computed: transforms for the heights, once, and for each load."""
    grid = SlabGrid(comm, (24, 24))
    heights, pressure = (field[grid.rows].copy() for field in fields(grid.shape))
    surface = RoughSurface(under_hard_wall(grid, heights, solid=elastic(MODULUS)), asked(names))
    assert grid.transforms == first
    contact = Contact.of(surface, solution_of(pressure))
    assert contact.numbers and contact.measure() is not None
    assert grid.transforms == first + each
    assert sorted(surface.seconds) == sorted(names) and min(surface.seconds.values(), default=1) > 0
    assert each <= sum(observable.cost(contact.surface.cell, None).transforms for observable in asked(names))


def test_memory(comm):
    """All observables take less than a quarter more memory than the solution of the contact did, at its peak."""
    tracemalloc.start()
    grid, solid = SlabGrid(comm, (512, 512)), elastic(MODULUS)
    heights = self_affine(grid, 0.5, 8, 0.05, 5)
    surface = RoughSurface(under_hard_wall(grid, heights, solid=solid), asked(NAMES), 2 * np.pi / 8)
    tracemalloc.reset_peak()
    solution = solve_hard_wall(under_hard_wall(grid, heights, 0.01, solid), 1e-3)
    solving = tracemalloc.get_traced_memory()[1]
    tracemalloc.reset_peak()
    Contact.of(surface, solution).measure()
    observing = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert grid.reduction.sum(solving) > 40 * grid.size  # heights, pressure, gap, strips and one more field: it counts
    assert grid.reduction.sum(observing) <= 1.25 * grid.reduction.sum(solving)


@CASES
def test_area_counts_pixels_and_edges(comm, shape, lengths):
    """f_c and periodic edges by NumPy; S_d is the patches' sum; without a contact line nothing is corrected."""
    pressure = fields(shape)[1]
    grid = SlabGrid(comm, shape, lengths)
    area, mask = contact_area(grid, pressure[grid.rows].copy(), None), pressure > 0
    edges = [np.count_nonzero(mask != np.roll(mask, 1, axis)) for axis in (0, 1)]
    assert (area.pixels, area.edges_x, area.edges_y) == (mask.sum(), *edges)
    assert area.corrected == area.fraction == mask.mean() and area.perimeter == area.edge_length
    perimeters = observe(comm, shape, lengths, ("patches",))["patches"]["perimeter"]
    assert perimeters.sum() == pytest.approx(area.edge_length, rel=1e-14, abs=0)


def test_row(comm):
    """κ = f_c E' g/p̄ with the surface's spectral slope, and nan at no load; all numbers of the schema are there."""
    grid = SlabGrid(comm, (32, 48), (32.0, 24.0))
    heights = self_affine(grid, 0.5, 1, 0.07, 3)
    surface = RoughSurface(under_hard_wall(grid, heights, solid=elastic(MODULUS)))
    assert surface.rms_slope == pytest.approx(0.07, rel=1e-12, abs=0)  # that of which the surface was made
    solution = solve_hard_wall(under_hard_wall(grid, heights, 0.01, elastic(MODULUS)), 1e-3)
    row = Contact.of(surface, solution).numbers
    assert schema.LOADS.keys() - row.keys() == {"target"}  # which the job knows
    assert row["contact_area"] == grid.reduction.sum(solution.pressure > 0) / grid.size
    assert row["kappa"] == pytest.approx(row["contact_area"] * MODULUS * 0.07 / 0.01, rel=1e-12, abs=0)
    assert 0 < row["pressure_error"] == solution.pressure_error < 1
    unloaded = solve_hard_wall(under_hard_wall(grid, heights, 0.0, elastic(MODULUS)))
    nothing = Contact.of(surface, unloaded).numbers
    assert nothing["contact_area"] == nothing["contact_area_corrected"] == 0 and math.isnan(nothing["kappa"])


def test_patches_hold_the_contact(comm):
    """Areas add up to the contact area, loads to the load; labels are the numbers of the rows of the table."""
    grid = SlabGrid(comm, (24, 30), (24.0, 15.0))
    heights, pressure = (field[grid.rows].copy() for field in fields(grid.shape))
    surface = RoughSurface(under_hard_wall(grid, heights, solid=elastic(MODULUS)), asked(["patches"]))
    contact = Contact.of(surface, solution_of(pressure))
    table = comm.bcast(contact.measure()["patches"])
    assert table["area"].sum() == contact.area.pixels * grid.pixel_area
    assert table["load"].sum() == pytest.approx(grid.reduction.sum(pressure) * grid.pixel_area, rel=1e-14, abs=0)
    labels = grid.fetch(contact.fields(("labels",), 8)["labels"], 0, 24)
    np.testing.assert_array_equal(np.bincount(labels.ravel())[1:] * grid.pixel_area, table["area"])


@CASES
def test_histograms_are_those_of_numpy(comm, shape, lengths):
    """Counts equal numpy.histogram of the contact points (pressures) and of the open points (gaps); densities too."""
    found, pressure = observe(comm, shape, lengths, ("histogram",), histogram={"bins": 30}), fields(shape)[1]
    contact = pressure[pressure > 0]
    for name in ("pressure_histogram", "pressure_histogram_log"):
        count, density, edges = (found[name][key] for key in ("count", "density", "edges"))
        np.testing.assert_array_equal(count, np.histogram(contact, edges)[0])
        np.testing.assert_allclose(density, np.histogram(contact, edges, density=True)[0], rtol=1e-14)
        assert count.sum() == contact.size
    gaps = found["gap_histogram"]
    assert gaps["count"].sum() == pressure.size - contact.size
    assert np.sum(gaps["density"] * np.diff(gaps["edges"])) == pytest.approx(1 - contact.size / pressure.size)


def test_moments(comm):
    """⟨σⁿ⟩_c/σ_c^n against NumPy, m₂ among them; independent of the unit of pressure, however small or large."""
    pressure = fields((24, 24))[1]
    contact = pressure[pressure > 0] / pressure[pressure > 0].mean()
    grid = SlabGrid(comm, (24, 24))
    for unit in (1e-200, 1.0, 1e200):
        moments = pressure_groups(grid, unit * pressure[grid.rows], 10)["pressure_moments"]
        np.testing.assert_array_equal(moments["order"], [1, 2, 3, 4])
        np.testing.assert_allclose(moments["value"], [np.mean(contact**n) for n in (1, 2, 3, 4)], rtol=1e-13)


def test_persson_fit_finds_the_width(comm):
    """Pressures at the quantiles of P(σ) = N(σ; p̄, s) − N(σ; −p̄, s) give back s; the bins' counts round at 1e-4."""
    shape, mean, width = (160, 150), 0.3, 0.7
    at = np.linspace(0, 8, 200001)
    above = persson.exceedance(at, mean, width)  # falls from f_c to 0
    levels = (np.arange(shape[0] * shape[1]) + 0.5) / (shape[0] * shape[1])
    pressure = np.where(levels < above[0], np.interp(-levels, -above, at), 0.0).reshape(shape)
    grid = SlabGrid(comm, shape)
    found = comm.bcast(pressure_groups(grid, pressure[grid.rows].copy(), 200).get("persson_fit"))
    assert float(found["width"]) == pytest.approx(width, rel=1e-3)
    assert float(found["residual"]) < 0.02


def test_edges_hold_all_values_and_are_decimals():
    """For values of any size the edges enclose them, and rounding by 1e-15 (another rank count) changes no edge."""
    for value in (3e-250, 1.7e-5, 0.123, 1.0, 9.96, 99.4, 4.2e9, 7e250):
        edges = linear_edges(0.0, value, 50)
        assert value <= edges[-1] <= 1.101 * value and edges[0] == 0
        np.testing.assert_array_equal(edges, linear_edges(0.0, value * (1 - 1e-15), 50))
        edges = log_edges(value / 1e5, value, 20)
        assert edges[0] <= value / 1e5 and edges[-1] >= value
        np.testing.assert_allclose(np.diff(np.log10(edges)), 0.05, rtol=1e-10)
    assert linear_edges(0.0, 0.0, 5)[-1] == 1.0


def test_fit_of_many_bins(comm):
    """The fit of a histogram of 64,000 bins is that of 1000, to which they are merged; a minimum is found to 1e-8."""
    grid = SlabGrid(comm, (160, 150))
    pressure = np.maximum(np.random.default_rng(2).normal(size=grid.shape) - 0.5, 0)[grid.rows]
    groups = (pressure_groups(grid, pressure.copy(), bins) for bins in (1000, 64000))
    coarse, fine = (comm.bcast(each.get("persson_fit")) for each in groups)
    assert float(fine["width"]) == pytest.approx(float(coarse["width"]), rel=1e-6)


@pytest.mark.parametrize("n", [1, 2, 5, 8])
def test_sums_over_rings(n):
    """Sums over bins are those of searchsorted and bincount, for even and odd counts."""
    rng = np.random.default_rng(n)
    along = np.minimum(np.arange(n), n - np.arange(n)) ** 2 * 1.7
    across, weight, values = np.array([0.0, 1.0, 9.0]), rng.random(3), rng.normal(size=(3, n))
    edges = np.sqrt([0.5, 1.7 * (1 + 1e-9), 4.0, 20.0])
    rings = Rings(SlabGrid(MPI.COMM_SELF, (4, 4)), along, across, weight, edges)
    place = np.sqrt(along + across[:, None])
    for got, terms in ((rings.sums(values, 0, 3), values), (rings.count, 1 + 0 * place), (rings.roots, place)):
        index = np.searchsorted(edges, place.ravel())
        np.testing.assert_allclose(got, np.bincount(index, (terms * weight[:, None]).ravel(), 5), atol=1e-14)


def test_lowpass_removes_short_waves(comm):
    """A long wave with a ripple, low-passed between the two, is the long wave; rounding only."""
    grid = SlabGrid(comm, (48, 40), (6.0, 5.0))
    wave, ripple = sinusoid(grid, 1.0, (1, 1)), sinusoid(grid, 0.2, (9, 7))
    cutoff = 2 * np.pi * np.hypot(1 / 6, 1 / 5)  # a mode on the cut-off stays
    np.testing.assert_allclose(lowpass(grid, wave + ripple, cutoff), wave, atol=1e-14)


def test_area_of_the_low_passed_surface(comm):
    """f(q) of a 2-D sinusoid with a ripple that q leaves out is the sinusoid's own: A = 0.1905 at f = 0.1, to 0.003.
    That is the area inside the contact line; that of the pixels is larger."""
    grid = SlabGrid(comm, (512, 512), (1.0, 1.0))
    heights = sinusoid(grid, 0.01, (1, 1)) + sinusoid(grid, 0.001, (40, 40))
    load = 0.1 * np.sqrt(2) * np.pi * MODULUS * 0.01
    q = 2 * np.pi * np.array([8.0, 30.0])  # on 64² and 256² points

    def solve(problem, start):
        assert problem.grid.shape[0] < 512 and start is None and problem.mean_pressure == load
        return solve_hard_wall(problem, 1e-8)

    problem = under_hard_wall(grid, heights, solid=elastic(MODULUS))
    surface = RoughSurface(problem, asked(["lowpass"], lowpass={"q": q}), solve=solve)
    contact = Contact.of(surface, solution_of(np.zeros(grid.local_shape), mean_pressure=load))
    found = contact.measure()["lowpass_area"]
    cell = contact.surface.cell
    assert coarsening(cell, q[0]) > coarsening(cell, q[1]) > 1
    assert found["area_corrected"][1] == pytest.approx(0.1905, abs=0.003)
    assert found["area_corrected"][0] == pytest.approx(0.1905, abs=0.01)
    assert np.all(found["area"] > found["area_corrected"])


def test_area_is_that_of_the_finest_grid(comm):
    """f(q) from coarse grids agrees with the same low-passed surfaces solved on the full grid, inside their contact
    lines, to .5 %.  8 points per wave err by up to .2 % for a spectrum that ends there, a few patches by more."""
    grid, solid = SlabGrid(comm, (256, 256)), elastic(MODULUS)
    heights = self_affine(grid, 0.5, 4, 0.05, 5)
    problem = under_hard_wall(grid, heights, 0.01, solid)
    surface = RoughSurface(problem, asked(["lowpass"], lowpass={"q": 2 * np.pi / np.array([64, 32])}))
    solution = solve_hard_wall(problem, 1e-4)
    found = Contact.of(surface, solution).measure()["lowpass_area"]
    for q, area in zip(found["q"], found["area_corrected"], strict=True):
        smooth = problem.on(grid, lowpass(grid, heights, q))
        direct = solve_hard_wall(smooth, 1e-6)
        line = line_of(smooth, direct, True)
        assert area == pytest.approx(contact_area(grid, direct.pressure, line).corrected, rel=0.005)
    assert np.all(np.diff(found["area_corrected"]) < 0)


def test_area_of_a_surface_without_waves(comm):
    """Below its only wave, of which rounding is left, a surface is flat: f = 1, at any load that is not nothing."""
    grid = SlabGrid(comm, (48, 48))
    problem = under_hard_wall(grid, sinusoid(grid, 0.1, (2, 0)), 0.003, elastic(MODULUS))
    surface = RoughSurface(problem, asked(["lowpass"], lowpass={"q": [2 * np.pi / 48, 2 * np.pi / 24]}))
    contact = Contact.of(surface, solve_contact(problem))
    found = contact.measure()["lowpass_area"]
    assert found["area"][0] == found["area_corrected"][0] == 1
    assert found["area"][1] == pytest.approx(contact.area.fraction, abs=2 / 48)  # the wave itself is there


def test_no_contact_has_a_negative_area(comm):
    """At a load that one pixel bears, the area inside the line is positive and not above that of the pixels."""
    grid = SlabGrid(comm, (64, 64))
    problem = under_hard_wall(grid, self_affine(grid, 0.8, 16, 0.1, 1), 1e-9)
    solution = solve_hard_wall(problem, 1e-8)
    area = Contact.of(RoughSurface(problem, [], 2 * np.pi / 16), solution).area
    assert area.pixels == 1 and 0 < area.corrected <= area.fraction and area.perimeter > 0


def test_cross_spectra_in_any_units(comm):
    """Lengths × 1e-90 and pressures × 1e80, whose squares have a ratio beyond the range of doubles: the same sums over
    the bins, in these units, of contacts solved to 1e-12."""
    found = []
    for length, pressure in ((1.0, 1.0), (1e-90, 1e80)):
        grid = SlabGrid(comm, (16, 12), (16 * length, 12 * length))
        heights = np.random.default_rng(3).standard_normal(grid.shape)[grid.rows] * length
        problem = under_hard_wall(grid, heights, 0.05 * pressure, elastic(pressure))
        contact = Contact.of(RoughSurface(problem, asked(["spectra"])), solve_hard_wall(problem, 1e-12))
        found.append(contact.cross_power / pressure / length)
    np.testing.assert_allclose(found[1], found[0], rtol=1e-4, atol=1e-4 * np.abs(found[0]).max())


def test_pressure_in_full_contact(comm):
    """Where every point touches, the spectrum of the pressure is that of full contact in each bin, mode by mode."""
    grid = SlabGrid(comm, (24, 15), (24.0, 30.0))
    heights = self_affine(grid, 0.5, 4, 0.01, 1)
    problem = under_hard_wall(grid, heights, 1.0, elastic(1.0, thickness=3.0))
    surface = RoughSurface(problem, asked(["spectra"]))
    groups = comm.bcast(Contact.of(surface, solve_hard_wall(problem, 1e-12)).measure())
    stress, full = (groups[f"{name}_spectrum"]["value"] for name in ("stress", "full_contact"))
    np.testing.assert_allclose(stress, full, rtol=1e-9, atol=1e-9 * full.max())


def test_no_patch_has_a_negative_area(comm):
    """Lines around single pixels close to other patches enclosed less than nothing: such patches have the area and the
    perimeter of their pixels, which are more than the lines give."""
    grid = SlabGrid(comm, (128, 128))
    problem = under_hard_wall(grid, self_affine(grid, 0.3, 4, 0.1, 1), 1e-3)
    contact = Contact.of(RoughSurface(problem, [], 2 * np.pi / 4), solve_hard_wall(problem, 1e-10))
    labels = contact.labels(8)
    beyond, length = (grid.reduction.sum(part) for part in contact.line_of_patches(8))
    table = contact.patches(labels, contact.pressure)
    if comm.rank == 0:
        area, inside = table["area"], table["area_corrected"]
        as_pixels = (inside == area) & (table["perimeter_corrected"] == table["perimeter"])
        assert inside.min() > 0 and area[as_pixels].max() <= 2 and 0 < as_pixels.sum() < len(area) / 5
        assert beyond < np.sum(inside - area) and length < np.sum(table["perimeter_corrected"])


@pytest.mark.parametrize("failure", [SolverError, InputError])
def test_a_contact_that_cannot_be_had_is_not_given(comm, caplog, failure):
    """If a further contact cannot be certified, its number is NaN and the log says why; all others are there, and the
    error bars of the area, which need none."""
    grid, heights = rough_on(comm, (64, 64), 0.5, 16, 0.05, 5)
    problem = under_hard_wall(grid, heights, 0.003, elastic(MODULUS))
    waves = 2 * np.pi / np.array([64, 32, 16])

    def solve(problem, start, options=None):
        if options is not None or lengths.append(start) or len(lengths) == 1:
            raise failure("no such luck")
        return solve_hard_wall(problem, 1e-4)

    lengths = []
    surface = RoughSurface(problem, asked(["lowpass", "discretisation"], lowpass={"q": waves}), 2 * np.pi / 16, solve)
    contact = Contact.of(surface, solve_hard_wall(problem, 1e-6))
    found = contact.measure()
    for name in ("area", "area_corrected"):
        assert np.isnan(found["lowpass_area"][name]).sum() == 1
    errors = found["discretisation"]
    missing = {f"{name}_error" for name in ("contact_perimeter", "mean_gap", "elastic_energy", "mean_square_pressure")}
    assert {name for name, value in errors.items() if np.isnan(value)} == missing
    assert ("no such luck" in caplog.text) == (comm.rank == 0)


@pytest.mark.parametrize("thickness", [np.inf, 20.0])
def test_full_contact_is_foreseen(comm, thickness):
    """A wave Δ cos(qx) is in full contact from p̄ = K(q) Δ on, on a half-space (π E'Δ/λ) and on a slab."""
    grid, base = SlabGrid(comm, (48, 30), (96.0, 30.0)), "free" if thickness < np.inf else "bonded"
    solid = elastic(MODULUS, thickness, base)
    full = 0.1 * float(solid.stiffness(np.array([2 * np.pi * 3 / 96]))[0])
    assert thickness < np.inf or full == pytest.approx(np.pi * MODULUS * 0.1 / 32, rel=1e-12, abs=0)
    heights = sinusoid(grid, 0.1, (3, 0))
    for load, expected in ((0.999, False), (1.001, True)):
        assert touches_fully(under_hard_wall(grid, heights, load * full, solid)) == expected


def test_octaves():
    """Default cut-offs double from 2π/L and end at the surface's own, which is the surface itself."""
    cell = Cell(n=(64, 32), length=(64.0, 32.0))
    for q, expected in ((12.8, [1, 2, 4, 8, 12.8]), (32, [1, 2, 4, 8, 16, 32]), (0.5, [1])):
        np.testing.assert_allclose(octaves(cell, 2 * np.pi * q / 64) * 64 / (2 * np.pi), expected)


def test_area_of_the_whole_surface(comm):
    """f(q) ends at the contact area itself, without another solution, and leaves that one as it was, bit for bit."""
    grid, solid = SlabGrid(comm, (64, 64)), elastic(MODULUS)
    heights = self_affine(grid, 0.5, 1, 0.05, 5)
    solution = solve_hard_wall(under_hard_wall(grid, heights, 0.01, solid), 1e-6)
    before = solution.pressure.copy(), solution.gap.copy(), heights.copy()
    surface = RoughSurface(under_hard_wall(grid, heights, solid=solid), asked(["lowpass"]))
    contact = Contact.of(surface, solution)
    found = contact.measure()["lowpass_area"]
    assert found["area"][-1] == contact.area.fraction
    assert found["area_corrected"][-1] == contact.area.corrected
    assert np.all(found["area_corrected"][:-1] > contact.area.corrected)
    for was, now in zip(before, (solution.pressure, solution.gap, heights), strict=True):
        np.testing.assert_array_equal(was, now)


def test_one_contact_for_all_observables(comm):
    """Under an exponential wall too, area, histogram, patches, spectrum and autocorrelation are of the same points."""
    grid, heights = rough_on(comm, (48, 40), 0.5, 4, 0.1, 5)
    problem = ContactProblem(grid, heights, elastic(MODULUS), ExponentialWall(zeta=0.02), 0.01)
    surface = RoughSurface(problem, asked(NAMES[:5], spectra={"all_modes": True}))
    contact = Contact.of(surface, solve_contact(problem))
    found = comm.bcast(contact.measure())
    assert 0 < contact.area.pixels < grid.reduction.sum(contact.pressure > 0)
    area = contact.area.fraction
    assert found["pressure_histogram"]["count"].sum() == contact.area.pixels
    assert found["patches"]["area"].sum() == pytest.approx(contact.area.pixels * grid.pixel_area, rel=1e-13, abs=0)
    assert found["contact_acf"]["value"][0] == pytest.approx(area, rel=1e-12, abs=0)
    spectrum = found["contact_spectrum"]
    assert np.sum(spectrum["count"] * spectrum["value"]) == pytest.approx(area - area**2, rel=1e-11, abs=0)
    assert found["bearing_acf"]["value"][0] == pytest.approx(area, rel=1e-12, abs=0)


@pytest.mark.parametrize("largest", [1e-300, 5e-324])
def test_pressures_at_the_end_of_double_precision(largest):
    """Bins about pressures whose density would overflow: nothing is fitted, and no warning."""
    assert histogram.linear_edges(0.0, largest, 10)[-1] == 1.0
    assert np.all(np.isfinite(1 / np.diff(histogram.log_edges(largest, largest, 4))))
    fit = histogram.persson_fit(np.linspace(0.0, 1.0, 11), np.arange(10), largest, 100)
    assert math.isnan(fit["width"])
