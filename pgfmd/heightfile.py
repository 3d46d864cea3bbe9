"""Heights from a NumPy or HDF5 file, each rank reading its own rows."""

from __future__ import annotations

import os

import h5py
import numpy as np

from .errors import InputError
from .grid import SlabGrid
from .parallel import raise_together
from .validate import printable

DETREND = ("none", "mean", "plane")


def read_heights(
    grid: SlabGrid, path: str | os.PathLike, dataset: str | None = None, detrend: str = "none", scale: float = 1.0
) -> np.ndarray:
    """Heights (nx_local, ny) in float64 from `path`: .npy, or HDF5 with a two-dimensional dataset.  Collective.

    dataset may be left out if the HDF5 file holds just one two-dimensional dataset (or one named "height" or
    "heights"). detrend takes out the mean, or the plane that fits best by least squares, which a periodic cell
    cannot hold.
    Raises InputError on all ranks: file missing, unreadable, truncated, of another shape than the grid, or not finite.
    """
    with raise_together(grid.comm):
        with np.errstate(invalid="ignore", over="ignore"):  # what is not finite is named below
            heights = _rows(os.fspath(path), dataset, grid.shape, grid.rows)
            heights *= scale
        bad = np.argwhere(~np.isfinite(heights))
        if len(bad):
            row, column = bad[0]
            raise InputError(
                f"{path}: the height at [{row + grid.rows.start}, {column}] is {heights[row, column]}; "
                "all heights must be finite"
            )
    if detrend == "mean":
        heights -= grid.reduction.sum(heights) / grid.size
    elif detrend == "plane":
        _subtract_plane(grid, heights)
    return heights


def _rows(path: str, dataset: str | None, shape: tuple[int, int], rows: slice) -> np.ndarray:
    """Rows of the array in the file, as float64."""
    try:
        if path.endswith(".npy"):
            return _checked(np.load(path, mmap_mode="r", allow_pickle=False), path, shape, rows)
        with h5py.File(path, "r", locking=False) as file:
            return _checked(_dataset(file, path, dataset), path, shape, rows)
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except Exception as error:  # whatever a damaged file makes NumPy or HDF5 raise
        reason = printable(" ".join(str(error).split()), 200) or type(error).__name__
        raise InputError(f"{path}: cannot be read as heights (.npy or HDF5), perhaps truncated: {reason}") from None


def _dataset(file: h5py.File, path: str, name: str | None) -> h5py.Dataset:
    if name is not None:
        if not isinstance(file.get(name), h5py.Dataset):
            raise InputError(f"{path}: holds no dataset {name!r}")
        return file[name]
    found = []
    file.visititems(lambda key, item: found.append(key) if isinstance(item, h5py.Dataset) and item.ndim == 2 else None)
    usual = [key for key in found if key in ("height", "heights")]
    choice = usual or found
    if len(choice) != 1:
        listed = ", ".join(found[:5]) or "none"
        raise InputError(f'{path}: say which dataset holds the heights (path = "file.h5:dataset"); found: {listed}')
    return file[choice[0]]


def _checked(array, path: str, shape: tuple[int, int], rows: slice) -> np.ndarray:
    if array.dtype.kind not in "fiu":
        raise InputError(f"{path}: heights must be real numbers, not {array.dtype}")
    if tuple(array.shape) != shape:
        raise InputError(f"{path}: array of shape {tuple(array.shape)}; the grid has {shape[0]} x {shape[1]} points")
    return np.array(array[rows], dtype=np.float64, order="C")


def _subtract_plane(grid: SlabGrid, heights: np.ndarray) -> None:
    """Least-squares plane: with coordinates about their mean, the three coefficients are independent.  Collective."""
    nx, ny = grid.shape
    x = (np.arange(grid.rows.start, grid.rows.stop) - (nx - 1) / 2)[:, None]
    y = (np.arange(ny) - (ny - 1) / 2)[None, :]
    level, along_x, along_y = grid.reduction.sums(heights.sum(), np.sum(x * heights), np.sum(y * heights))
    slope_x = along_x / (ny * nx * (nx**2 - 1) / 12) if nx > 1 else 0.0
    slope_y = along_y / (nx * ny * (ny**2 - 1) / 12) if ny > 1 else 0.0
    heights -= level / grid.size + slope_x * x + slope_y * y
