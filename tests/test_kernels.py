"""Compiled loops against the NumPy lines that specify them."""

import numpy as np
import pytest

from pgfmd import kernels

rng = np.random.default_rng(5)


@pytest.fixture
def points():
    """A random set of points on a 9 × 7 slab: mask, offsets, columns."""
    mask = rng.random((9, 7)) < 0.4
    mask[3] = False
    return mask, np.concatenate([[0], np.cumsum(mask.sum(axis=1))]), np.nonzero(mask)[1].astype(np.int32)


def test_gather_and_scatter_columns():
    """A few columns, transposed, there and back."""
    strip, block = rng.random((37, 11)) + 1j, np.zeros((5, 37), complex)
    kernels.gather_columns(strip, 4, 5, block)
    assert np.array_equal(block, strip[:, 4:9].T)
    target = np.zeros_like(strip)
    kernels.scatter_columns(block, 4, 5, target)
    assert np.array_equal(target[:, 4:9], strip[:, 4:9])
    assert not target[:, :4].any()


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


def test_fill_and_drain_rows(points):
    """rows[mask] = values, and values = rows[mask]."""
    mask, offsets, columns = points
    values, rows = rng.random(len(columns)), np.full((9, 7), np.nan)
    kernels.fill_rows(values, columns, offsets, 0, rows)
    assert np.array_equal(rows[mask], values)
    assert not rows[~mask].any()
    back = np.zeros_like(values)
    kernels.drain_rows(rows[2:], columns, offsets, 2, back)
    assert np.array_equal(back[offsets[2] :], values[offsets[2] :])


def test_apply_stencil(points):
    """A correlation with the stencil, evaluated on the set."""
    mask, offsets, columns = points
    stencil, field = rng.random((3, 3)), rng.random((11, 9))
    stencil[0, 2] = 0
    taps = np.nonzero(stencil)
    out = np.zeros(len(columns))
    kernels.apply_stencil(field, *taps, stencil[taps], columns, offsets, 0, 9, out)
    windows = np.lib.stride_tricks.sliding_window_view(field, (3, 3))
    assert np.allclose(out, np.einsum("ijst,st->ij", windows, stencil)[mask], rtol=1e-14)


def test_blocks(points):
    """Sums over blocks of pixels, and a value per block added to the points in it."""
    mask, offsets, columns = points
    values, rows = rng.random(len(columns)), np.nonzero(mask)[0]
    sums, expected = np.zeros((4, 3)), np.zeros((4, 3))
    kernels.block_sums(values, columns, offsets, 0, 9, 2, 3, sums)
    np.add.at(expected, ((rows + 2) // 3, columns // 3), values)
    assert np.allclose(sums, expected, rtol=1e-14)
    out = np.zeros_like(values)
    kernels.add_blocks(values, sums, columns, offsets, 0, 9, 2, 3, out)
    assert np.allclose(out, values + sums[(rows + 2) // 3, columns // 3], rtol=1e-14)


def test_contact_lists_and_sums():
    """The set {p > 0 or (p = 0 and gap < level)}, its values, and the sums of the certificate."""
    p = np.maximum(rng.random((9, 7)) - 0.5, 0)
    p[1, 1] = -0.1
    gap, heights = rng.random((9, 7)) - 0.3, rng.random((9, 7))
    mask = (p > 0) | ((p == 0) & (gap < 0.1))
    counts = np.empty(9, np.int64)
    kernels.count_contact(p, gap, 0.1, 0, 9, counts)
    assert np.array_equal(counts, mask.sum(axis=1))
    offsets, columns = np.concatenate([[0], np.cumsum(counts)]), np.empty(mask.sum(), np.int32)
    kernels.list_contact(p, gap, 0.1, 0, 9, offsets, columns)
    assert np.array_equal(columns, np.nonzero(mask)[1])
    values = np.empty(mask.sum())
    kernels.take_rows(gap, columns, offsets, 0, 9, values)
    assert np.array_equal(values, gap[mask])
    kernels.put_rows(heights, columns, offsets, 0, 9, values)
    assert np.array_equal(heights[mask], gap[mask])
    on = p > 0
    expected = (p * gap)[on].sum(), (p * (gap + heights))[on].sum(), p[on].sum(), on.sum(), gap.min()
    assert np.allclose(kernels.contact_sums(p, gap, heights, 0, 9), expected, rtol=1e-13)
    violation = np.where(on, np.abs(gap - 0.05), 0.05 - gap).max()
    assert kernels.largest_violation(p, gap, 0.05, 0, 9) == pytest.approx(violation, rel=1e-14)


def test_start_rows():
    """Contact where reach · p exceeds the gap, with the coarse pressure."""
    coarse, u, h = rng.random((9, 7)), rng.random((9, 7)), rng.random((9, 7))
    out = np.empty((9, 7))
    total, count = kernels.start_rows(coarse, u, h, 0.3, out)
    mask = 0.3 * coarse > u - h
    assert np.array_equal(out, np.where(mask, coarse, 0))
    assert (total, count) == (pytest.approx(out.sum()), mask.sum())


def test_interpolate_rows():
    """Σ_s Σ_t w_s v_t coarse[i + s, j + t]."""
    coarse = rng.random((8, 6))
    index, weights = np.array([0, 3, 5]), rng.random((3, 2))
    columns, column_weights = rng.integers(0, 6, (4, 2)), rng.random((4, 2))
    out = np.empty((3, 4))
    kernels.interpolate_rows(coarse, index, weights, columns, column_weights, out)
    picked = coarse[(index[:, None] + np.arange(2))[:, :, None, None], columns[None, None]]
    assert np.allclose(out, np.einsum("is,jt,isjt->ij", weights, column_weights, picked), rtol=1e-14)
