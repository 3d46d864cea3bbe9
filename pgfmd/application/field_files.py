"""The fields of a run: a file for the heights and one for each load, and small files that show them together.

    fields/height.h5, fields/load_0000.h5, …    written by all ranks, each in one piece on the disk
    fields/load_0000_patches.h5, …              large groups of a load, to which observables.h5 links
    fields.h5       height (x, y); pressure, gap, … of all loads (load, x, y); load_0000/pressure, … (x, y) of each
    fields.vtkhdf   the same for ParaView and VTK: one image, the loads as its time steps

The last two have virtual datasets (HDF5 1.10), which refer to the files in fields/ and copy no numbers; so these files
must stay where they are.  A missing file reads as NaN, or −1 for integers.
"""

import logging
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from pgfmd.application import files, hdf5_slabs, restart
from pgfmd.application.files import CHECKPOINT_FILE, FIELDS_FILE, VTK_FILE, Form, load_name
from pgfmd.application.tables import add_grid_axes, annotate, fill_group, name_axes
from pgfmd.observables.schema import FIELDS, Dataset
from pgfmd.parallel.collectives import Reduction, from_root, raise_together
from pgfmd.parallel.mpi import MPI

log = logging.getLogger("pgfmd")

VTK_VERSION = (2, 0)  # of the format VTKHDF: images with steps in time

UNDATED = ("software", "softwareVersion", "commit", "format_version")  # so the same numbers make the same bytes

Links = dict[str, tuple[str, str]]
"""Name of a field ("height", "load_0000/pressure") → its file, and its dataset there."""


@dataclass(frozen=True)
class Shown:
    """A dataset in a file of fields: the path of the file from the result folder, name, type and attributes."""

    file: str
    dataset: str
    dtype: np.dtype
    attributes: Mapping[str, Any] = field(default_factory=dict)


class FieldFiles:
    """The fields of one run.

    directory: the result folder; folder: name of the one in it for fields; provenance: returns the attributes of a
    file's root, on rank 0; links: the fields that have been written.
    """

    def __init__(
        self, comm: MPI.Comm, directory: Path, folder: str, form: Form, provenance: Callable[[], dict[str, Any]]
    ) -> None:
        self.comm, self.directory, self.folder, self.form = comm, directory, folder, form
        self._provenance, self.links = provenance, Links()
        self._described: dict[str, Shown] = {}  # the links whose files have been read

    def write(self, name: str, fields: dict[str, np.ndarray], show: bool) -> None:
        """Write NAME.h5 with this rank's slabs (nx_local, ny) of `fields`, named alike on all ranks.  Collective.

        show: whether to update fields.h5 now; False while superseded results are live.
        Raises ValueError for a slab of another shape, OSError if the file cannot be written, on all ranks.
        """
        form = self.form
        slabs = {key: hdf5_slabs.Field(local, self._stored(key, local)) for key, local in fields.items()}
        with raise_together(self.comm):
            expected = (form.rows.stop - form.rows.start, form.shape[1])
            for key, local in fields.items():
                if local.shape != expected:
                    raise ValueError(f"field {key}: slab of shape {local.shape}, expected {expected}")
        if form.shape[0] * sum(slab.row_bytes for slab in slabs.values()) > files.LARGEST_LISTED:
            slabs |= {key + files.ROW_SUMS: slab.sums() for key, slab in slabs.items()}

        def create(file: h5py.File, key: str) -> h5py.Dataset:
            file.attrs.update({attribute: self._provenance()[attribute] for attribute in UNDATED})
            width, dtype = slabs[key].local.shape[1], slabs[key].dtype
            dataset = hdf5_slabs.create_dataset(file, key, (form.shape[0], width), dtype)
            if key not in fields:
                annotate(dataset, Dataset("1", "SHA-256 of each row of the field"), form.units)
                return dataset
            annotate(dataset, FIELDS.get(key, Dataset("1", key)), form.units)
            add_grid_axes(file, form.shape, form.lengths, form.length_unit)
            name_axes(file, key, ("x", "y"))
            return dataset

        path = self.directory / self.folder / f"{name}.h5"
        hdf5_slabs.replace_by(self.comm, form, path, slabs, create)
        for key in fields:
            link = key if key == name else f"{name}/{key}"
            self.links[link] = f"{name}.h5", key
            self._described.pop(link, None)
        if show:
            from_root(self.comm, self.write_views)

    def _stored(self, name: str, local: np.ndarray) -> np.dtype:
        """Type of a field in the file: as the job asks; double for reals that over- or underflow in it.  Collective."""
        if not np.issubdtype(local.dtype, np.floating):
            return local.dtype
        asked, reduction = np.dtype(self.form.precision), Reduction(self.comm)
        largest, limits = max(reduction.max(local), -reduction.min(local)), np.finfo(asked)
        if largest == 0 or float(limits.tiny) / float(limits.eps) <= largest <= float(limits.max):
            return asked
        if self.comm.rank == 0 and asked != np.float64:
            log.info("%s is written in float64: %s does not hold values of %.1e", name, asked, largest)
        return np.dtype(np.float64)

    # Rank 0.

    def begin(self, has_results: bool) -> None:
        """Make the folder; remove the drafts of interrupted runs and, without results, all its files."""
        for draft in (self.directory / self.folder).glob(".*.h5.tmp"):
            draft.unlink(missing_ok=True)
        if not has_results:
            self.remove(self.folder, and_checkpoint=False)
        (self.directory / self.folder).mkdir(exist_ok=True)

    def remove_tables(self, name: str, kept: Collection[str]) -> None:
        """Remove the files of groups of a load, but those that are `kept` (paths from the result folder)."""
        for path in restart.own_field_files(self.directory / self.folder):
            if path.name.startswith(f"{name}_") and str(path.relative_to(self.directory)) not in kept:
                path.unlink(missing_ok=True)

    def write_table(self, file: str, title: str, table: Mapping[str, np.ndarray]) -> None:
        """Write a group of a load as a file (a path from the result folder) of its own."""

        def fill(content: h5py.File) -> None:
            content.attrs.update({name: self._provenance()[name] for name in UNDATED})
            fill_group(content, table, self.form.groups[title], self.form.units)

        files.create(self.directory / file, fill)

    def write_views(self) -> None:
        """Write fields.h5 and fields.vtkhdf anew, if there are fields."""
        if not self.links:
            return
        for name, (file, dataset) in self.links.items():
            if name not in self._described:
                self._described[name] = described(self.directory, f"{self.folder}/{file}", dataset)
        files.create(self.directory / FIELDS_FILE, self._fill_netcdf)
        files.create(self.directory / VTK_FILE, self._fill_vtk)

    def remove_views(self) -> None:
        """Remove fields.h5 and fields.vtkhdf."""
        for name in (FIELDS_FILE, VTK_FILE):
            (self.directory / name).unlink(missing_ok=True)

    def remove(self, folder: str, and_checkpoint: bool) -> None:
        """Remove the fields that this program wrote into a folder, and the folder if nothing else is in it."""
        for path in restart.own_field_files(self.directory / folder):
            if and_checkpoint or path.name != CHECKPOINT_FILE:
                path.unlink(missing_ok=True)
        with suppress(OSError):
            (self.directory / folder).rmdir()

    def remove_replaced(self) -> None:
        """Remove the fields of replaced results, which are in the other folder, and the views of them."""
        self.remove_views()
        for folder in set(restart.FIELDS_FOLDERS) - {self.folder}:
            self.remove(folder, and_checkpoint=True)

    @property
    def _numbers(self) -> list[int]:
        """The loads that have fields."""
        return sorted({int(name.split("/")[0].removeprefix("load_")) for name in self._described if "/" in name})

    @property
    def _stacks(self) -> dict[str, list[Shown | None]]:
        """Name of a field → that field of each load that has fields (None: not written)."""
        names = dict.fromkeys(name.split("/")[1] for name in self._described if "/" in name)
        loads = [load_name(number) for number in self._numbers]
        return {name: [self._described.get(f"{load}/{name}") for load in loads] for name in names}

    def _fill_netcdf(self, file: h5py.File) -> None:
        """Fill fields.h5.  All axes have coordinates, so that it is netCDF-4, which xarray reads."""
        file.attrs.update(self._provenance())
        add_grid_axes(file, self.form.shape, self.form.lengths, self.form.length_unit)
        if self._numbers:
            file["load"] = np.array(self._numbers)
            file["load"].attrs.update(description="number of the load, counted from 0", units="1")
        for name, shown in self._described.items():
            _add_virtual(file, name, [shown], self.form.shape)
            name_axes(file, name, ("x", "y"))
        for name, several in self._stacks.items():
            _add_virtual(file, name, several, (len(several), *self.form.shape))
            name_axes(file, name, ("load", "x", "y"))

    def _fill_vtk(self, file: h5py.File) -> None:
        """Fill fields.vtkhdf.  VTK's first axis is the contiguous one, our y: `Direction` exchanges x and y."""
        file.attrs.update(self._provenance())
        (nx, ny), (lx, ly) = self.form.shape, self.form.lengths
        root, count = file.create_group("VTKHDF"), len(self._numbers)
        root.attrs["Version"] = np.array(VTK_VERSION)
        root.attrs["Type"] = np.bytes_("ImageData")
        root.attrs["WholeExtent"] = np.array([0, ny - 1, 0, nx - 1, 0, 0])
        root.attrs["Origin"] = np.zeros(3)
        root.attrs["Spacing"] = np.array([ly / ny, lx / nx, 1.0])
        root.attrs["Direction"] = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]).ravel()
        points = root.create_group("PointData")
        single = {name: [shown] * max(count, 1) for name, shown in self._described.items() if "/" not in name}
        for name, several in (single | self._stacks).items():
            _add_virtual(points, name, several, (count, nx, ny) if count else (nx, ny))
        if count:
            steps = root.create_group("Steps")
            steps.attrs["NSteps"] = count
            steps["Values"] = np.array(self._numbers, float)
            for name in points:
                steps[f"PointDataOffsets/{name}"] = np.arange(count)


def described(directory: Path, file: str, dataset: str) -> Shown:
    """A dataset (nx, ny) of a file below `directory`, with its units and description."""
    with h5py.File(directory / file, "r", locking=False) as content:
        source = content[dataset]
        about = {name: source.attrs[name] for name in ("units", "description") if name in source.attrs}
        return Shown(file, dataset, source.dtype, about)


def _add_virtual(group: h5py.Group, name: str, several: Sequence[Shown | None], shape: tuple[int, ...]) -> None:
    """A virtual dataset of that shape: (nx, ny) of one field, or (number of fields, nx, ny)."""
    known = next(shown for shown in several if shown is not None)
    layout = h5py.VirtualLayout(shape, known.dtype)
    for number, shown in enumerate(several):
        if shown is not None:
            place = (number,) if len(shape) == 3 else (slice(None), slice(None))
            layout[place] = h5py.VirtualSource(shown.file, shown.dataset, shape[-2:], shown.dtype)
    missing = np.nan if np.issubdtype(known.dtype, np.floating) else -1
    group.create_virtual_dataset(name, layout, fillvalue=missing).attrs.update(known.attributes)
