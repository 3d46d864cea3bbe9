"""Compiled loops against the NumPy lines that specify them."""

import numpy as np
import pytest

from pgfmd.grid import kernels
from pgfmd.solvers.active_set import kernels as set_kernels

rng = np.random.default_rng(5)


@pytest.fixture
def points():
    """A random set of points on a 9 × 7 slab: mask, offsets, columns."""
    mask = rng.random((9, 7)) < 0.4
    mask[3] = False
    return mask, np.concatenate([[0], np.cumsum(mask.sum(axis=1))]), np.nonzero(mask)[1].astype(np.int32)


def test_strips_in_tiles():
    """Rows to tiles and back, and a few columns of these, transposed, there and back."""
    half, start, count = rng.random((37, 14)) + 1j, 2, 11
    strip, tiles = half[:, start : start + count], np.zeros((3, 42, 4), complex)
    kernels.rows_to_tiles(half, start, count, 3, tiles)
    assert np.array_equal(np.hstack(list(tiles))[3:40, :count], strip)
    assert np.count_nonzero(tiles) == strip.size
    back = np.zeros_like(half)
    kernels.tiles_to_rows(tiles, 3, back, start, count)
    assert np.array_equal(back[:, start : start + count], strip)
    assert np.count_nonzero(back) == strip.size
    block, target = np.zeros((6, 38), complex), np.zeros_like(tiles)
    kernels.gather_columns(tiles[:, 3:].copy(), 37, 3, 6, block)
    assert np.array_equal(block[:, :37], strip[:, 3:9].T)
    kernels.scatter_columns(block, 37, 3, 6, target)
    assert np.array_equal(np.hstack(list(target))[:37, 3:9], strip[:, 3:9])
    assert np.count_nonzero(target) == 37 * 6


@pytest.mark.parametrize(("dtype", "close"), [(np.float64, 1e-15), (np.float32, 1e-6)])
def test_divide_by_q(dtype, close):
    """block · factor/|q|, zero for the mean mode; to rounding of a square root and two products."""
    qx, qy = rng.random(8).astype(dtype), rng.random(3).astype(dtype)
    qx[0] = qy[0] = 0
    block = rng.random((3, 8)).astype(dtype) + 1j * rng.random((3, 8)).astype(dtype)
    q = np.hypot(qx[None, :], qy[:, None])
    expected = block * np.divide(2.5, q, out=np.zeros_like(q), where=q > 0)
    kernels.divide_by_q(block.view(dtype).reshape(3, 8, 2), qx**2, qy**2, dtype(2.5))
    assert np.abs(block - expected).max() < 4 * close * np.abs(expected).max()


@pytest.mark.parametrize(("dtype", "close"), [(np.float64, 1e-15), (np.float32, 1e-6)])
def test_multiply_by_q(dtype, close):
    """block · factor |q|, to rounding of a square root and two products."""
    qx, qy = rng.random(8).astype(dtype), rng.random(3).astype(dtype)
    block = rng.random((3, 8)).astype(dtype) + 1j * rng.random((3, 8)).astype(dtype)
    expected = block * (2.5 * np.hypot(qx[None, :], qy[:, None]))
    kernels.multiply_by_q(block.view(dtype).reshape(3, 8, 2), qx**2, qy**2, dtype(2.5))
    assert np.abs(block - expected).max() < 4 * close * np.abs(expected).max()


def test_open_gap_and_close_pressure():
    """A gap where there is no pressure, above a level; and pressure where there is no gap, and its sum."""
    pressure, gap = np.maximum(rng.standard_normal((9, 7)), 0), rng.standard_normal((9, 7))
    opened, closed = gap.copy(), rng.standard_normal((9, 7))
    kernels.open_gap(pressure, opened, 0.3, 2, 8)
    assert np.array_equal(opened[2:8], np.where(pressure > 0, 0, np.maximum(gap - 0.3, 0))[2:8])
    assert np.array_equal(opened[:2], gap[:2])
    expected = np.where(opened != 0, 0, np.maximum(closed, 0))[2:8]
    assert np.isclose(kernels.close_pressure(closed, opened, 2, 8), expected.sum(), rtol=1e-14)
    assert np.array_equal(closed[2:8], expected)


def test_fill_and_drain_rows(points):
    """rows[mask] = values, and values = rows[mask]."""
    mask, offsets, columns = points
    values, rows = rng.random(len(columns)), np.full((9, 7), np.nan)
    set_kernels.fill_rows(values, columns, offsets, 0, rows)
    assert np.array_equal(rows[mask], values)
    assert not rows[~mask].any()
    back = np.zeros_like(values)
    set_kernels.drain_rows(rows[2:], columns, offsets, 2, back)
    assert np.array_equal(back[offsets[2] :], values[offsets[2] :])


def test_fill_wrapped(points):
    """The values on the set, zero elsewhere, and two columns from the other side on each side."""
    mask, offsets, columns = points
    values, rows = rng.random(len(columns)), np.full((6, 11), np.nan)
    set_kernels.fill_wrapped(values, columns, offsets, 2, 5, 2, rows)
    dense = np.zeros((9, 7))
    dense[mask] = values
    assert np.array_equal(rows[:5], np.pad(dense, ((0, 0), (2, 2)), mode="wrap")[2:7])


@pytest.mark.parametrize("density", [0.05, 0.4, 0.95])
def test_apply_stencil(density):
    """A correlation with a symmetric disc of radius 2, on points that lie apart and on runs of them."""
    mask, field = rng.random((9, 70)) < density, rng.random((13, 74))
    weights = rng.random(6)
    a, b, c, d, e, f = weights
    stencil = np.array([[0, 0, f, 0, 0], [0, e, d, e, 0], [c, b, a, b, c], [0, e, d, e, 0], [0, 0, f, 0, 0]])
    offsets = np.concatenate([[0], np.cumsum(mask.sum(axis=1))])
    out = np.zeros(offsets[-1])
    set_kernels.apply_stencil(field, weights, np.nonzero(mask)[1].astype(np.int32), offsets, 0, 9, out)
    windows = np.lib.stride_tricks.sliding_window_view(field, (5, 5))
    assert np.allclose(out, np.einsum("ijst,st->ij", windows, stencil)[mask], rtol=1e-13)


@pytest.mark.parametrize("room", [5, 7, 40])
def test_correlate(room):
    """The stencil on a periodic field that is zero off one set, at the points of another, few rows at a time."""
    source, target, halo = rng.random((30, 40)) < 0.3, rng.random((14, 40)) < 0.5, 8
    field, weights = np.where(source, rng.random((30, 40)), 0), rng.random(6)
    lists = [
        (np.nonzero(mask)[1].astype(np.int32), np.concatenate([[0], np.cumsum(mask.sum(axis=1))]))
        for mask in (source, target)
    ]
    out, whole = (np.zeros(target.sum()) for _ in range(2))
    for rows in ((0, 5), (5, 14)):
        set_kernels.correlate(field[source], *lists[0], halo, weights, np.empty((room, 44)), *lists[1], *rows, out)
    padded = np.pad(field, ((0, 0), (2, 2)), mode="wrap")[halo - 2 : halo + 16]
    set_kernels.apply_stencil(padded, weights, *lists[1], 0, 14, whole)
    assert np.array_equal(out, whole)


def test_spread_and_interpolate(points):
    """Values to the nodes around each point by weights, and back by the same: one is the transpose of the other."""
    mask, offsets, columns = points
    x_first, y_first = np.repeat([-1, 0, 1], 3).astype(np.int32), np.array([-1, 0, 1, 2, 3, 2, 4], np.int32)
    x_weights, y_weights = rng.random((9, 4)), rng.random((7, 4))
    matrix = np.zeros((len(columns), 7, 5))  # points × nodes −1 … 5 and 0 … 4, periodic
    for k, (i, j) in enumerate(zip(*np.nonzero(mask), strict=True)):
        for s in range(4):
            for t in range(4):
                matrix[k, x_first[i] + s + 1, (y_first[j] + t) % 5] += x_weights[i, s] * y_weights[j, t]
    splines = x_first, x_weights, y_first, y_weights
    values, nodes = rng.random(len(columns)), np.zeros((5, 5))
    set_kernels.spread_points(values, columns, offsets, 0, 9, *splines, 0, nodes)
    assert np.allclose(nodes, np.einsum("k,kij->ij", values, matrix)[1:6], rtol=1e-13)
    nodes, out = rng.random((7, 5)), np.ones(len(columns))
    set_kernels.add_interpolated(nodes, -1, columns, offsets, 0, 9, *splines, out)
    assert np.allclose(out, 1 + np.einsum("kij,ij->k", matrix, nodes), rtol=1e-13)


def test_scale_modes():
    """block · scale"""
    block, scale = rng.random((3, 8)) + 1j * rng.random((3, 8)), rng.random((3, 8))
    expected = block * scale
    kernels.scale_modes(block.view(float).reshape(3, 8, 2), scale)
    assert np.allclose(block, expected, rtol=1e-15)


def test_blocks(points):
    """Sums over blocks of pixels, and a value per block added to the points in it."""
    mask, offsets, columns = points
    values, rows = rng.random(len(columns)), np.nonzero(mask)[0]
    row_block, column_block = np.arange(9) // 3, np.arange(7) // 3
    sums, expected = np.zeros((3, 3)), np.zeros((3, 3))
    set_kernels.block_sums(values, columns, offsets, 0, 9, 3, column_block, sums)
    np.add.at(expected, (rows // 3, columns // 3), values)
    assert np.allclose(sums, expected, rtol=1e-14)
    out = np.zeros_like(values)
    set_kernels.add_blocks(values, sums, columns, offsets, 0, 9, row_block, column_block, out)
    assert np.allclose(out, values + sums[rows // 3, columns // 3], rtol=1e-14)


@pytest.mark.parametrize("start", [0, 5])
def test_blocks_of_blocks(start):
    """Sums over blocks of a slab that begins anywhere, what is left of values less their mean, and shares added."""
    field, shares, weights, means = rng.random((9, 7)), rng.random((9, 7)), rng.random((9, 7)), rng.random((5, 3))
    sums, expected = np.zeros((5, 3)), np.zeros((5, 3))
    rows, columns = (start + np.arange(9)) // 3, np.arange(7) // 3
    np.add.at(expected, (rows[:, None], columns[None, :]), field)
    kernels.sum_over_blocks(field, start, 3, sums)
    assert np.allclose(sums, expected, rtol=1e-14)
    mean, out = means[rows[:, None], columns], np.empty((9, 7))
    kernels.rest_in_blocks(field, shares, weights, means, start, 3, out)
    assert np.allclose(out, weights * (field * shares - mean), rtol=1e-13, atol=1e-15)
    expected = field + shares * mean
    kernels.add_from_blocks(means, shares, start, 3, field)
    assert np.allclose(field, expected, rtol=1e-14)


def test_sums_and_differences_of_two_precisions():
    """a + b and a − b, rounded once."""
    a, b, out = rng.random((3, 8)).astype(np.float32), rng.random((3, 8)), np.empty((3, 8), np.float32)
    kernels.add_rows(b, b, out)
    assert np.array_equal(out, (b + b).astype(np.float32))
    expected = a - b
    kernels.subtract_rows(a, b, b)
    assert np.array_equal(b, expected)


def test_start_of_gaps():
    """max(u − h, 0) where there is no pressure."""
    p, u, h, gap = np.maximum(rng.random((9, 7)) - 0.5, 0), rng.random((9, 7)), rng.random((9, 7)), np.empty((9, 7))
    kernels.start_gap(p, u, h, gap)
    assert np.array_equal(gap, np.where(p > 0, 0, np.maximum(u - h, 0)))


def test_contact_lists_and_sums():
    """The set {p > 0 or (p = 0 and gap < level)}, its values, and the sums of the certificate."""
    p = np.maximum(rng.random((9, 7)) - 0.5, 0)
    p[1, 1] = -0.1
    gap, heights = rng.random((9, 7)) - 0.3, rng.random((9, 7))
    mask = (p > 0) | ((p == 0) & (gap < 0.1))
    counts = np.empty(9, np.int64)
    busy = np.ones((9, 1), bool)
    set_kernels.count_contact(p, gap, 0.1, busy, 0, 9, counts)
    assert np.array_equal(counts, mask.sum(axis=1))
    offsets, columns = np.concatenate([[0], np.cumsum(counts)]), np.empty(mask.sum(), np.int32)
    set_kernels.list_contact(p, gap, 0.1, busy, 0, 9, offsets, columns)
    assert np.array_equal(columns, np.nonzero(mask)[1])
    values = np.empty(mask.sum())
    set_kernels.take_rows(gap, columns, offsets, 0, 9, values)
    assert np.array_equal(values, gap[mask])
    set_kernels.put_rows(heights, columns, offsets, 0, 9, values)
    assert np.array_equal(heights[mask], gap[mask])
    set_kernels.add_to_rows(heights, columns, offsets, 0, 9, values)
    assert np.array_equal(heights[mask], 2 * gap[mask])
    on = p > 0
    expected = (p * gap)[on].sum(), (p * (gap + heights))[on].sum(), p[on].sum(), on.sum()
    assert np.allclose(kernels.contact_sums(p, gap, heights, 0, 9), expected, rtol=1e-13)
    assert np.allclose(set_kernels.contact_sums(p, gap, heights, columns, offsets, 0, 9), expected, rtol=1e-13)


def test_busy_segments():
    """Segments with listed points or a low gap; the same points are found in them as anywhere."""
    ny = 2 * kernels.SEGMENT + 9
    p, gap = np.zeros((5, ny)), 1 + rng.random((5, ny))
    p[1, 70], gap[2, 3], gap[3, ny - 1] = 1.0, 0.5, 0.5
    least, busy = np.empty((5, 3)), np.empty((5, 3), bool)
    kernels.least_of_segments(gap, least)
    parts = [gap[:, a : a + kernels.SEGMENT].min(axis=1) for a in range(0, ny, kernels.SEGMENT)]
    assert np.array_equal(least, np.transpose(parts))
    offsets, columns = np.array([0, 0, 1, 1, 1, 1]), np.array([70], np.int32)
    set_kernels.mark_busy(columns, offsets, least, 0.7, 0, 5, busy)
    assert np.array_equal(np.transpose(np.nonzero(busy)), [(1, 1), (2, 0), (3, 2)])
    counts, found = np.empty(5, np.int64), np.empty(3, np.int32)
    set_kernels.count_contact(p, gap, 0.7, busy, 0, 5, counts)
    assert np.array_equal(counts, [0, 1, 1, 1, 0])
    set_kernels.list_contact(p, gap, 0.7, busy, 0, 5, np.concatenate([[0], np.cumsum(counts)]), found)
    assert np.array_equal(found, [70, 3, ny - 1])


def test_finish_rows():
    """p and the gap in other units, the gap nowhere negative and 0 in contact; how far it was from that."""
    p, gap = np.maximum(rng.standard_normal((9, 7)), 0), rng.standard_normal((9, 7))
    pressure, opened = p.copy(), gap.copy()
    violation = kernels.finish_rows(pressure, opened, 0.05, 3.0, 2.0)
    assert np.allclose(pressure, 3 * p, rtol=1e-15)
    assert np.allclose(opened, np.where(p > 0, 0, 2 * np.maximum(gap - 0.05, 0)), rtol=1e-14)
    assert violation == pytest.approx(np.where(p > 0, np.abs(gap - 0.05), 0.05 - gap).max(), rel=1e-14)


def test_squares_of_steps():
    """The sum of the squares of steps along rows."""
    field = rng.standard_normal((9, 7))
    assert kernels.squares_of_steps(field) == pytest.approx((np.diff(field, axis=1) ** 2).sum(), rel=1e-13)


def test_start_rows():
    """Contact where reach · p exceeds the gap, with the coarse pressure."""
    coarse, u, h = rng.random((9, 7)), rng.random((9, 7)), rng.random((9, 7))
    out = np.empty((9, 7))
    total, count = kernels.start_rows(coarse, u, h, 0.3, out)
    mask = 0.3 * coarse > u - h
    assert np.array_equal(out, np.where(mask, coarse, 0))
    assert (total, count) == (pytest.approx(out.sum()), mask.sum())


def test_interpolate_rows():
    """Σ_s Σ_t w_s v_t coarse[i + s, j + t], columns from −1 on, periodic."""
    coarse = rng.random((8, 6))
    index, weights = np.array([0, 3, 4]), rng.random((3, 4))
    first, column_weights = rng.integers(-1, 6, 4), rng.random((4, 4))
    columns = (first[:, None] + np.arange(4)) % 6
    out = np.empty((3, 4))
    kernels.interpolate_rows(coarse, index, weights, first, column_weights, out)
    picked = coarse[(index[:, None] + np.arange(4))[:, :, None, None], columns[None, None]]
    assert np.allclose(out, np.einsum("is,jt,isjt->ij", weights, column_weights, picked), rtol=1e-13)


def test_sums_over_listed_points(points):
    """Σ f v and Σ f over the points of some rows; Σ f and Σ max(f, 0) by blocks of columns."""
    mask, offsets, columns = points
    field, values = rng.standard_normal(mask.shape), rng.standard_normal(offsets[-1]).astype(np.float32)
    inside, part = field[2:8][mask[2:8]], slice(offsets[2], offsets[8])
    assert np.isclose(set_kernels.dot_rows(field, columns, offsets, 2, 8, values), inside @ values[part], rtol=1e-14)
    assert np.isclose(set_kernels.sum_rows(field, columns, offsets, 2, 8), inside.sum(), rtol=1e-14)
    sums, masked = np.ones((2, 4)), np.where(mask, field, 0)[2:8]
    set_kernels.signed_sums(field, columns, offsets, 2, 8, 1, sums)
    for row, values in zip(sums, (masked, np.maximum(masked, 0)), strict=True):
        assert np.allclose(row - 1, np.add.reduceat(values.sum(axis=0), (0, 2, 4, 6)), rtol=1e-14)


def test_take_below_and_cut(points):
    """level − f, and max(f, 0) with its change and how often, and the same times a factor by blocks of columns, at the
    points of some rows; nothing elsewhere.
    """
    mask, offsets, columns = points
    field, part = rng.standard_normal(mask.shape), slice(offsets[2], offsets[8])
    old, values = field.copy(), np.zeros(offsets[-1], np.float32)
    set_kernels.take_below(field, columns, offsets, 2, 8, 0.3, values)
    assert np.array_equal(values[part], (0.3 - old[2:8][mask[2:8]]).astype(np.float32))
    chosen = mask & (np.arange(9) >= 2)[:, None] & (np.arange(9) < 8)[:, None]
    assert set_kernels.cut_negative(field, columns, offsets, 2, 8, values) == np.count_nonzero(old[chosen] < 0)
    assert np.array_equal(field, np.where(chosen, np.maximum(old, 0), old))
    assert np.array_equal(values[part], (field - old)[2:8][mask[2:8]].astype(np.float32))
    field, factors = old.copy(), np.array([1.5, 0.5, 2.0, 0.0])
    set_kernels.cut_and_scale(field, columns, offsets, 2, 8, 1, factors, values)
    assert np.array_equal(field, np.where(chosen, np.repeat(factors, 2)[:7] * np.maximum(old, 0), old))
    assert np.array_equal(values[part], (field - old)[2:8][mask[2:8]].astype(np.float32))


def test_vectors_of_conjugate_gradients():
    """(Σ a b, Σ a, Σ b) in double precision; d = f d + z − m; x += s d and r −= s (p − m), in single."""
    a, b, direction, z, x = rng.standard_normal((5, 1000)).astype(np.float32)
    part, real = slice(10, 900), np.float32
    double = a.astype(float), b.astype(float)
    expected = double[0][part] @ double[1][part], double[0][part].sum(), double[1][part].sum()
    assert np.allclose(set_kernels.dot_and_sums(a, b, 10, 900), expected, rtol=1e-12, atol=1e-12)
    expected = direction.copy()
    expected[part] = (0.3 * direction + (z - 0.1))[part]
    set_kernels.turn(direction, z, real(0.3), real(0.1), 10, 900)
    assert np.allclose(direction, expected, rtol=0, atol=1e-6)
    expected = x.copy(), a.copy()
    expected[0][part] += 0.2 * direction[part]
    expected[1][part] -= 0.2 * (b[part] - 0.4)
    set_kernels.advance(x, a, direction, b, real(0.2), real(0.4), 10, 900)
    assert np.allclose([x, a], expected, rtol=0, atol=1e-6)
