"""Heights from a file: NumPy or HDF5, each rank reading its own rows, or what an instrument wrote, read by rank 0."""

from __future__ import annotations

import os

import h5py
import numpy as np
from mpi4py import MPI

from pgfmd.errors import InputError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.options.text import printable
from pgfmd.parallel.collectives import from_root, raise_together
from pgfmd.surfaces import instruments, text
from pgfmd.surfaces.mirror import folded

HDF5_SUFFIXES = (".h5", ".hdf5")


def read_heights(
    grid: SlabGrid, source: tuple[str, str | None], copies: int, scale: float, length_unit: str | None
) -> np.ndarray:
    """Heights (nx_local, ny) in float64 of a (file, dataset), times `scale`, with mirror images if there are two copies
    along each side.  Collective.

    .npy and HDF5 files with a two-dimensional dataset are bare numbers, in the job's units; each rank reads its own
    rows.  dataset may be None if the file holds just one two-dimensional dataset (or one named "height" or
    "heights").  Any other file goes to SurfaceTopography on rank 0.  The cell is always the grid's; where such a file
    says how large it is, it must agree to 0.1 %, else the error says which n and length to write.  Where it says its
    unit, heights and size are converted to length_unit, which must then be a length ("m", "mm", "µm", "nm", …); None
    leaves them as they are.
    Raises InputError on all ranks: file missing, unreadable, truncated, of another shape or size than the grid, in an
    unknown unit, not finite, or the package for it is not installed.
    """
    path, dataset = source
    if any(count % copies for count in grid.shape):
        raise InputError(
            f'surface.periodic = "mirror": doubles the file, the grid of {grid.shape[0]} x {grid.shape[1]} points '
            "cannot be halved"
        )
    folds = [folded(count, copies) for count in grid.shape]
    if from_root(grid.comm, _from_instrument, path, dataset):
        heights = _scattered(grid, path, folds, copies, length_unit)
    else:
        with raise_together(grid.comm):
            heights = _rows(path, dataset, [len(fold) // copies for fold in folds], folds, grid.rows)
    with raise_together(grid.comm):
        _scale(heights, scale, path, grid.rows)
    return heights


def _from_instrument(path: str, dataset: str | None) -> bool:
    """Whether the file is neither .npy nor HDF5 with heights in it; serial."""
    if dataset is not None or path.endswith((".npy", *HDF5_SUFFIXES)) or not os.path.isfile(path):
        return False
    try:
        if not h5py.is_hdf5(path):
            return True
        with h5py.File(path, "r", locking=False) as file:
            return not _two_dimensional(file)
    except Exception:  # damaged HDF5: the reader says so
        return False


def _scattered(grid: SlabGrid, path: str, folds: list, copies: int, length_unit: str | None) -> np.ndarray:
    """Rows of what rank 0 reads with SurfaceTopography.  Collective."""
    message = None
    counts = np.diff(grid.starts) * grid.shape[1]
    with raise_together(grid.comm):
        if grid.comm.rank == 0:
            try:
                measured = (text.read(path) or instruments.read(path)).converted(length_unit)
                measured.check(grid.shape, grid.lengths, copies)
            except InputError as error:
                raise InputError(f"{path}: {error}") from None
            message = [measured.heights[np.ix_(*folds)], counts, grid.starts[:-1] * grid.shape[1], MPI.DOUBLE]
    heights = np.empty(grid.local_shape)
    grid.comm.Scatterv(message, heights)
    return heights


def _rows(path: str, dataset: str | None, shape: list[int], folds: list, rows: slice) -> np.ndarray:
    """Rows of the array in the file, as float64."""
    try:
        if path.endswith(".npy"):
            return _checked(np.load(path, mmap_mode="r", allow_pickle=False), path, shape, folds, rows)
        with h5py.File(path, "r", locking=False) as file:
            return _checked(_dataset(file, path, dataset), path, shape, folds, rows)
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except Exception as error:  # whatever a damaged file makes NumPy or HDF5 raise
        reason = printable(" ".join(str(error).split()), 200) or type(error).__name__
        raise InputError(f"{path}: cannot be read as heights (.npy or HDF5), perhaps truncated: {reason}") from None


def _two_dimensional(file: h5py.File) -> list[str]:
    """Names of the two-dimensional datasets."""
    found = []
    file.visititems(lambda key, item: found.append(key) if isinstance(item, h5py.Dataset) and item.ndim == 2 else None)
    return found


def _dataset(file: h5py.File, path: str, name: str | None) -> h5py.Dataset:
    if name is not None:
        if not isinstance(file.get(name), h5py.Dataset):
            raise InputError(f"{path}: holds no dataset {name!r}")
        return file[name]
    found = _two_dimensional(file)
    usual = [key for key in found if key in ("height", "heights")]
    choice = usual or found
    if len(choice) != 1:
        listed = ", ".join(found[:5]) or "none"
        raise InputError(f'{path}: say which dataset holds the heights (path = "file.h5:dataset"); found: {listed}')
    return file[choice[0]]


def _checked(array, path: str, shape: list[int], folds: list, rows: slice) -> np.ndarray:
    """The grid's rows of an array that is mapped or in the file; only those are read."""
    if array.dtype.kind not in "fiu":
        raise InputError(f"{path}: heights must be real numbers, not {array.dtype}")
    nx, ny = map(len, folds)
    if list(array.shape) != list(shape):
        wanted = "" if [nx, ny] == list(shape) else f", mirror images of {shape[0]} x {shape[1]}"
        raise InputError(f"{path}: array of shape {tuple(array.shape)}; the grid has {nx} x {ny} points{wanted}")
    wanted = folds[0][rows]
    first = wanted.min(initial=shape[0])
    with np.errstate(invalid="ignore", over="ignore"):  # what is not finite is named later
        block = np.array(array[first : max(first, wanted.max(initial=-1) + 1)], dtype=np.float64, order="C")
    return block if [nx, ny] == list(shape) else block[np.ix_(wanted - first, folds[1])]


def _scale(heights: np.ndarray, scale: float, path: str, rows: slice) -> None:
    """Multiply in place; raises InputError at a height that is not finite."""
    with np.errstate(invalid="ignore", over="ignore"):
        heights *= scale
    bad = np.argwhere(~np.isfinite(heights))
    if len(bad):
        row, column = bad[0]
        raise InputError(
            f"{path}: the height at [{row + rows.start}, {column}] is {heights[row, column]}; "
            "all heights must be finite"
        )
