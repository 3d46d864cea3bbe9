"""Compiled loops against the NumPy lines that specify them."""

import numpy as np
import pytest

from pgfmd.grid import kernels
from pgfmd.physics.laws.adhesive_laws import decay
from pgfmd.physics.laws.hard import finish_rows
from pgfmd.solvers.active_set import (
    active_set,
    conjugate_gradients,
    contact_from_coarse,
    continuation,
    feasible,
    particle_mesh,
    preconditioner,
    stencil,
)
from pgfmd.solvers.second_order import spectral_dots


@pytest.fixture
def rng():
    """Random numbers, the same in each test."""
    return np.random.default_rng(5)


@pytest.fixture
def points(rng):
    """A random set of points on a 9 × 7 slab: mask, offsets, columns."""
    mask = rng.random((9, 7)) < 0.4
    mask[3] = False
    return mask, np.concatenate([[0], np.cumsum(mask.sum(axis=1))]), np.nonzero(mask)[1].astype(np.int32)


def test_strips_in_tiles(rng):
    """Rows to the tiles of two targets and back, and a few columns of the first, transposed, there and back."""
    half, start, count = rng.random((37, 14)) + 1j, 2, 11
    strip, flat = half[:, start : start + count], np.zeros(7 + 42 * (12 + 2), complex)
    tiles, other = flat[7 : 7 + 42 * 12].reshape(3, 42, 4), flat[7 + 42 * 12 :].reshape(42, 2)
    table = np.array([[start, start + count, 7, 4], [0, 2, 7 + 42 * 12, 2]])
    kernels.rows_and_tiles(half, 3, flat, table, 42, False)
    assert np.array_equal(np.hstack(list(tiles))[3:40, :count], strip)
    assert np.array_equal(other[3:40], half[:, :2])
    assert np.count_nonzero(flat) == strip.size + 2 * 37
    back = np.zeros_like(half)
    kernels.rows_and_tiles(back, 3, flat, table, 42, True)
    assert np.array_equal(back[:, : start + count], half[:, : start + count])
    assert np.count_nonzero(back) == strip.size + 2 * 37
    block, target = np.zeros((6, 38), complex), np.zeros_like(tiles)
    kernels.tiles_and_columns(tiles[:, 3:].copy(), 37, 3, 6, block, False)
    assert np.array_equal(block[:, :37], strip[:, 3:9].T)
    kernels.tiles_and_columns(target, 37, 3, 6, block, True)
    assert np.array_equal(np.hstack(list(target))[:37, 3:9], strip[:, 3:9])
    assert np.count_nonzero(target) == 37 * 6


@pytest.mark.parametrize(("dtype", "close"), [(np.float64, 1e-15), (np.float32, 1e-6)])
def test_scale_by_q(dtype, close, rng):
    """block · factor |q| and block · factor/|q|, zero for the mean mode; to rounding of a root and two products."""
    qx, qy = rng.random(8).astype(dtype), rng.random(3).astype(dtype)
    qx[0] = qy[0] = 0
    q = np.hypot(qx[None, :], qy[:, None])
    for divide, scale in ((False, 2.5 * q), (True, np.divide(2.5, q, out=np.zeros_like(q), where=q > 0))):
        block = rng.random((3, 8)).astype(dtype) + 1j * rng.random((3, 8)).astype(dtype)
        expected = block * scale
        kernels.scale_by_q(block.view(dtype).reshape(3, 8, 2), qx**2, qy**2, dtype(2.5), divide)
        assert np.abs(block - expected).max() < 4 * close * np.abs(expected).max()


@pytest.mark.parametrize("density", [0.05, 0.4, 0.95])
def test_correlate(density, rng):
    """A correlation with an even kernel of radius √10 of a periodic field that is zero off one set, at the points of
    another: on points that lie apart and on runs of them, in rows of two calls, more than are evaluated together."""
    source, target = rng.random((84, 70)) < 0.3, rng.random((78, 70)) < density
    field, out = np.where(source, rng.random((84, 70)), 0), np.zeros(target.sum())
    disc = stencil.symmetric_kernel(rng.random(len(stencil.OFFSETS)))
    assert np.count_nonzero(disc) == 37
    lists = [
        (np.nonzero(mask)[1].astype(np.int32), np.concatenate([[0], np.cumsum(mask.sum(axis=1))]))
        for mask in (source, target)
    ]
    for rows in ((0, 5), (5, 78)):
        stencil.correlate((field[source], lists[0]), (disc[3:, 3:], True), np.empty((38, 76)), lists[1], rows, out)
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(field, ((0, 0), (3, 3)), mode="wrap"), (7, 7))
    assert np.allclose(out, np.einsum("ijst,st->ij", windows, disc)[target], rtol=1e-13, atol=1e-15)


def test_spread_and_interpolate(points, rng):
    """Values to the nodes around each point by weights, and back by the same: one is the transpose of the other."""
    mask, offsets, columns = points
    x_first, y_first = np.repeat([-1, 0, 1], 3).astype(np.int32), np.array([-1, 0, 1, 2, 3, 2, 4])
    x_weights, y_weights = rng.random((9, 4)), rng.random((7, 4))
    y_nodes = ((y_first[:, None] + np.arange(4)) % 5).astype(np.int32)
    matrix = np.zeros((len(columns), 7, 5))  # points × nodes −1 … 5 and 0 … 4, periodic
    for k, (i, j) in enumerate(zip(*np.nonzero(mask), strict=True)):
        for s in range(4):
            for t in range(4):
                matrix[k, x_first[i] + s + 1, y_nodes[j, t]] += x_weights[i, s] * y_weights[j, t]
    splines = x_first, x_weights, y_nodes, y_weights
    values, nodes = rng.random(len(columns)), np.zeros((5, 5))
    particle_mesh.spread_points(values, (columns, offsets), (0, 9), splines, 0, nodes)
    assert np.allclose(nodes, np.einsum("k,kij->ij", values, matrix)[1:6], rtol=1e-13, atol=0)
    nodes, out = rng.random((7, 5)), np.ones(len(columns))
    particle_mesh.add_interpolated(nodes, -1, (columns, offsets), (0, 9), splines, out)
    assert np.allclose(out, 1 + np.einsum("kij,ij->k", matrix, nodes), rtol=1e-13, atol=0)


def test_blocks(points, rng):
    """Sums over blocks of pixels, and a value per block subtracted from the points in it; of rows that exist only."""
    mask, offsets, columns = points
    values, rows = rng.random(len(columns)), np.nonzero(mask)[0]
    sums, expected, beyond = np.zeros((3, 2)), np.zeros((3, 2)), np.zeros((5, 2))
    preconditioner.block_sums(values, (columns, offsets), (0, 9), sums)
    np.add.at(expected, (rows // 4, columns // 4), values)
    assert np.allclose(sums, expected, rtol=1e-14, atol=0)
    preconditioner.block_sums(values, (columns, offsets), (-4, 16), beyond)
    assert np.array_equal(beyond[1:4], sums) and not beyond[[0, 4]].any()
    out = np.zeros_like(values)
    preconditioner.subtract_blocks(values, beyond, (columns, offsets), (5, 0, 9), out)
    assert np.allclose(out, values - beyond[(5 + rows) // 4, columns // 4], rtol=1e-14, atol=1e-15)


@pytest.mark.parametrize("start", [0, 5])
def test_blocks_of_blocks(start, rng):
    """Sums over blocks of a slab that begins anywhere, values less their mean, and shares subtracted."""
    field, shares, weights, means = rng.random((9, 7)), rng.random((9, 7)), rng.random((9, 7)), rng.random((5, 3))
    sums, expected = np.zeros((5, 3)), np.zeros((5, 3))
    rows, columns = (start + np.arange(9)) // 3, np.arange(7) // 3
    np.add.at(expected, (rows[:, None], columns[None, :]), field)
    kernels.sum_over_blocks(field, start, 3, sums)
    assert np.allclose(sums, expected, rtol=1e-14, atol=0)
    mean, out = means[rows[:, None], columns], np.empty((9, 7))
    kernels.rest_in_blocks((field, shares, weights), means, start, 3, out)
    assert np.allclose(out, weights * (field * shares - mean), rtol=1e-13, atol=1e-15)
    expected = field - shares * mean
    kernels.subtract_blocks(means, shares, start, 3, field)
    assert np.allclose(field, expected, rtol=1e-14, atol=1e-15)


def test_finish_rows(rng):
    """p and the gap in other units, the gap nowhere negative and 0 in contact; how far it was from that."""
    p, gap = np.maximum(rng.standard_normal((9, 7)), 0), rng.standard_normal((9, 7))
    pressure, opened = p.copy(), gap.copy()
    violation = finish_rows(pressure, opened, 0.05, np.inf, 3.0, 2.0)
    assert np.allclose(pressure, 3 * p, rtol=1e-15, atol=0)
    assert np.allclose(opened, np.where(p > 0, 0, 2 * np.maximum(gap - 0.05, 0)), rtol=1e-14, atol=0)
    assert violation == pytest.approx(np.where(p > 0, np.abs(gap - 0.05), 0.05 - gap).max(), rel=1e-14, abs=0)


@pytest.fixture
def fields(rng):
    """Pressures below, at, between and above the bounds 0 and 1, gaps of either sign or 0, and heights."""
    p = rng.choice([-0.5, 0.0, 0.3, 0.6, 1.0, 1.4], (9, 7))
    return p, rng.choice([-0.4, 0.0, 0.2, 0.5], (9, 7)), rng.standard_normal((9, 7))


@pytest.mark.parametrize("change", [(0.7, 0.0, 0.0), (1.6, 0.0, 0.0), (0.0, 0.5, 0.3)])
def test_changed_pressures(fields, change):
    """A factor of those below the top, or p + stiffness · (level − gap), cut at 0 and the top; how many are at
    the top, the sum of the others, and its derivative, which is that of points between the bounds."""
    p, gap, _ = fields
    p = np.maximum(p, 0)
    new = p + change[1] * (change[2] - gap) if change[1] else np.where(p < 1, change[0] * p, p)
    slope = np.where((new > 0) & (new < 1), change[1] or p, 0)[2:8].sum()
    out, after = p.copy(), np.clip(new, 0, 1)[2:8]
    for keep in (False, True):
        full, rest, found_slope = feasible.change_rows((out, gap), change, 1.0, keep, (2, 8))
        assert np.array_equal(out[2:8], p[2:8]) or keep
        assert full == (after == 1).sum()
        assert rest == pytest.approx(after[after < 1].sum(), rel=1e-14, abs=0)
        assert np.isclose(found_slope, slope, rtol=1e-13, atol=0)
    assert np.allclose(out[2:8], after, rtol=1e-14, atol=0)
    assert np.array_equal(out[:2], p[:2])


def test_sums_of_a_state(fields):
    """Σ p g, Σ p and # between the bounds; Σ p (g + base + h), Σ p², Σ h² + (h − summit)² and # in contact."""
    p, gap, heights = fields
    on, free = p > 0, (p > 0) & (p < 1)
    expected = (p * gap)[free].sum(), p[free].sum(), free.sum(), (p * (gap + 0.7 + heights))[on].sum()
    expected += (p**2)[on].sum(), (heights**2 + (heights - 3) ** 2)[on].sum(), on.sum()
    sums = active_set.contact_sums((p, gap, heights), (1.0, 3.0, 0.7), 0, 9)
    assert np.allclose(sums, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("spare", [np.inf, 0.5])
def test_limits_of_the_field_of_the_certificate(fields, spare):
    """g − λ between the bounds; at most that where p = 0, at least that where p = top; first the value of the block,
    as far as it is allowed; nothing elsewhere.
    A point counts as at a bound from which g − λ is farther than `spare` times its distance in pressure."""
    p, gap, _ = fields
    p, out = np.clip(p, 0, 1), np.full((4, 12, 11), np.nan, np.float32)
    values = np.array([[-0.3], [0.2]], np.float32)  # of blocks of 16 rows; the first row here is row 10 of the first
    continuation.residual_limits((p, gap), (0.1, 1.0, spare), (1, 2), (values, 10), out)
    away, most = (gap - 0.1).astype(np.float32), np.finfo(np.float32).max
    with np.errstate(invalid="ignore"):  # inf · 0, at the bounds
        above, below = (p > 0) & (away <= spare * p), (p < 1) & (-away <= spare * (1 - p))
    least, largest = np.where(above, away, -most), np.where(below, away, most)
    value = np.repeat(values, 16, axis=0)[10 : 10 + len(p)]
    expected = least, largest, np.minimum(np.maximum(value, least), largest)
    assert np.array_equal(out[:3, 1:10, 2:-2], expected)
    assert np.count_nonzero(np.isfinite(out)) == 3 * p.size


@pytest.mark.parametrize("shape", [(9, 7), (8, 3), (7, 1)])
def test_means_between_limits(rng, shape):
    """The mean over eight points at a distance, cut at the limits; columns are periodic by repetition."""
    (rows, ny), stride, margin = shape, 2, 4
    wide = np.zeros((4, rows, ny + 2 * margin), np.float32)
    wide[:3] = np.pad(rng.standard_normal((3, rows, ny)), ((0, 0), (0, 0), (margin, margin)), mode="wrap")
    wide[0] -= 0.5
    wide[1] = np.maximum(wide[1], wide[0])
    least, most, field, _ = wide[:, :, margin:-margin].astype(float)
    steps = [(i, j) for i in (-stride, 0, stride) for j in (-stride, 0, stride) if i or j]
    expected = np.clip(sum(np.roll(field, step, (0, 1)) for step in steps) / 8, least, most)
    continuation.average_between(wide[2], wide[:2], stride, margin, wide[3])
    inner = slice(stride, rows - stride)
    assert np.allclose(wide[3, inner, margin:-margin], expected[inner], rtol=0, atol=1e-6)
    assert not wide[3, : inner.start].any() and not wide[3, inner.stop :].any()


def test_products_of_spectra(rng):
    """Σ_j w_j Σ_i Re(a* b), and the same of b* b."""
    a, b = (rng.standard_normal((3, 8, 2)).astype(np.float32) for _ in range(2))
    expected = [(np.array([1.0, 2, 2]) @ (left.astype(float) * b).sum(axis=(1, 2))).sum() for left in (a, b)]
    found = spectral_dots(a, b, np.array([1.0, 2, 2]))
    assert found == pytest.approx(expected, rel=1e-12, abs=0)


def test_start_rows(rng):
    """Contact where compliance · p exceeds the gap to new heights, with pressures that flatten a part of them."""
    p, g, coarse, h = rng.random((4, 9, 7))
    pressure, gap = np.empty((2, 9, 7))
    contact_from_coarse.start_rows((p, g, coarse), h, 0.3, (pressure, gap))
    flattened, contact = contact_from_coarse.ROUGHER * (h - coarse), 0.3 * p > g - (h - coarse)
    assert np.allclose(gap, g - (h - coarse) + np.where(contact, flattened, 0), rtol=0, atol=1e-15)
    assert np.allclose(pressure, np.where(contact, np.maximum(p + flattened / 0.3, 1e-30), 0), rtol=1e-14, atol=0)


@pytest.mark.parametrize("twice", [False, True])
def test_interpolate_rows(rng, twice):
    """Σ_s Σ_t w_s v_t coarse[i + s, j + t], columns from −1 on, periodic; twice: points and the middles between."""
    coarse = rng.random((8, 6))
    index, weights = np.array([0, 3, 4]), rng.random((3, 4))
    first, column_weights = rng.integers(-1, 6, 4), rng.random((4, 4))
    if twice:
        first, column_weights = np.arange(12) // 2 - 1, np.tile([[0, 1, 0, 0], rng.random(4)], (6, 1))
    columns = (first[:, None] + np.arange(4)) % 6
    out = np.empty((3, len(first)))
    kernels.interpolate_rows(coarse, (index, weights), (first, column_weights), True, out)
    picked = coarse[(index[:, None] + np.arange(4))[:, :, None, None], columns[None, None]]
    assert np.allclose(out, np.einsum("is,jt,isjt->ij", weights, column_weights, picked), rtol=1e-13, atol=0)


@pytest.mark.parametrize("twice", [False, True])
def test_combine_columns(rng, twice):
    """Σ_t w_t field[i, column t of j]; twice: the same weights around every second column."""
    field, columns, weights, out = rng.random((3, 9)), rng.integers(0, 9, (4, 8)), rng.random((4, 8)), np.empty((3, 4))
    if twice:
        field, out, weights = rng.random((3, 14)), np.empty((3, 7)), np.tile(rng.random(8), (7, 1))
        columns = (2 * np.arange(7)[:, None] - 3 + np.arange(8)) % 14
    kernels.combine_columns(field, columns, weights, out, True)
    picked = field[:, columns]
    assert np.allclose(out, np.einsum("jt,ijt->ij", weights, picked), rtol=1e-13, atol=0)


def test_combine_rows(rng):
    """Σ_t w_t rows[first + t]."""
    rows, first, weights, out = rng.random((12, 5)), np.array([0, 4, 1]), rng.random((3, 8)), np.empty((3, 5))
    kernels.combine_rows(rows, first, weights, out)
    assert np.allclose(out, [w @ rows[at : at + 8] for at, w in zip(first, weights, strict=True)], rtol=1e-13, atol=0)


def test_gap_of_a_displacement(rng):
    """u − h − base, and Σ u²."""
    u, h, gap = rng.standard_normal((3, 6, 9))
    assert active_set.gap_of(u, h, 0.3, gap) == pytest.approx(np.sum(u**2), rel=1e-13, abs=0)
    assert np.allclose(gap, u - h - 0.3, rtol=0, atol=1e-14)


def test_vectors_of_conjugate_gradients(rng):
    """(Σ a b, Σ a, Σ b) in double precision; d = f d + z − m; x += s d and r −= s (p − m), in single."""
    a, b, direction, z, x = rng.standard_normal((5, 1000)).astype(np.float32)
    part, real = slice(10, 900), np.float32
    double = a.astype(float), b.astype(float)
    expected = double[0][part] @ double[1][part], double[0][part].sum(), double[1][part].sum()
    assert np.allclose(conjugate_gradients.dot_and_sums(a, b, 10, 900), expected, rtol=1e-12, atol=1e-12)
    expected = direction.copy()
    expected[part] = (0.3 * direction + (z - 0.1))[part]
    conjugate_gradients.next_direction(direction, z, (real(0.3), real(0.1)), 10, 900)
    assert np.allclose(direction, expected, rtol=0, atol=1e-6)
    expected = x.copy(), a.copy()
    expected[0][part] += 0.2 * direction[part]
    expected[1][part] -= 0.2 * (b[part] - 0.4)
    conjugate_gradients.advance(x, a, (direction, b), (real(0.2), real(0.4)), 10, 900)
    assert np.allclose([x, a], expected, rtol=0, atol=1e-6)


def test_decay(rng):
    """exp(−g) up to the last gap, also at 0 and at what is not a number."""
    gap = np.concatenate([80 * rng.random(1000), [0.0, np.nan]])
    found = np.empty_like(gap)
    decay(gap, 60.0, found)
    np.testing.assert_allclose(found, np.where(gap > 60, 0, np.exp(-gap)), rtol=1e-15)
