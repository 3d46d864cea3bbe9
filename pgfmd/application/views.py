"""Small files that show all fields of a run together, without copies of the numbers, which are in other files.

    fields.h5       height (x, y); pressure, gap, … of all loads (load, x, y); load_0000/pressure, … (x, y) of each
    fields.vtkhdf   the same for ParaView and VTK: one image, the loads as its time steps

Their datasets are virtual (HDF5 1.10): they refer to the files of fields, which must stay where they are.  A missing
file reads as NaN, or −1 for integers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from pgfmd.application.files import load_name
from pgfmd.application.tables import add_grid_axes, name_axes

VTK_VERSION = (2, 0)  # of the format VTKHDF: images with steps in time


@dataclass(frozen=True)
class Shown:
    """A dataset in a file of fields: the path of the file from the result folder, type, and what it says of itself."""

    file: str
    dataset: str
    dtype: np.dtype
    attributes: Mapping[str, Any] = field(default_factory=dict)


def described(directory: Path, file: str, dataset: str) -> Shown:
    """A dataset (nx, ny) of a file below `directory`, with its units and description."""
    with h5py.File(directory / file, "r", locking=False) as content:
        source = content[dataset]
        about = {name: source.attrs[name] for name in ("units", "description") if name in source.attrs}
        return Shown(file, dataset, source.dtype, about)


@dataclass(frozen=True)
class View:
    """What the files show: shape (nx, ny) and lengths of the grid, their unit, and the fields by name: "height", or
    "load_0000/pressure".
    """

    shape: tuple[int, int]
    lengths: tuple[float, float]
    length_unit: str
    fields: Mapping[str, Shown]

    @property
    def numbers(self) -> list[int]:
        """The loads that have fields."""
        return sorted({int(name.split("/")[0].removeprefix("load_")) for name in self.fields if "/" in name})

    @property
    def stacks(self) -> dict[str, list[Shown | None]]:
        """Name of a field → that field of each load that has fields (None: not written)."""
        names = dict.fromkeys(name.split("/")[1] for name in self.fields if "/" in name)
        return {name: [self.fields.get(f"{load_name(number)}/{name}") for number in self.numbers] for name in names}

    def write_netcdf(self, file: h5py.File) -> None:
        """Fill fields.h5, which readers of netCDF-4, xarray among them, understand: all axes have coordinates."""
        add_grid_axes(file, self.shape, self.lengths, self.length_unit)
        if self.numbers:
            file["load"] = np.array(self.numbers)
            file["load"].attrs.update(description="number of the load, counted from 0", units="1")
        for name, shown in self.fields.items():
            self._virtual(file, name, [shown], ())
            name_axes(file, name, ("x", "y"))
        for name, several in self.stacks.items():
            self._virtual(file, name, several, (len(several),))
            name_axes(file, name, ("load", "x", "y"))

    def write_vtk(self, file: h5py.File) -> None:
        """Fill fields.vtkhdf.  VTK's first axis is the contiguous one, our y: `Direction` exchanges x and y."""
        spacing = [length / count for length, count in zip(self.lengths, self.shape, strict=True)]
        root, count = file.create_group("VTKHDF"), len(self.numbers)
        root.attrs["Version"] = np.array(VTK_VERSION)
        root.attrs["Type"] = np.bytes_("ImageData")
        root.attrs["WholeExtent"] = np.array([0, self.shape[1] - 1, 0, self.shape[0] - 1, 0, 0])
        root.attrs["Origin"] = np.zeros(3)
        root.attrs["Spacing"] = np.array([spacing[1], spacing[0], 1.0])
        root.attrs["Direction"] = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]).ravel()
        points = root.create_group("PointData")
        single = {name: [shown] * max(count, 1) for name, shown in self.fields.items() if "/" not in name}
        for name, several in (single | self.stacks).items():
            self._virtual(points, name, several, (count,) if count else ())
        if count:
            steps = root.create_group("Steps")
            steps.attrs["NSteps"] = count
            steps["Values"] = np.array(self.numbers, float)
            for name in points:
                steps[f"PointDataOffsets/{name}"] = np.arange(count)

    def _virtual(self, group: h5py.Group, name: str, several: Sequence[Shown | None], first: tuple[int, ...]) -> None:
        """A virtual dataset of shape (*first, nx, ny) of as many fields."""
        known = next(shown for shown in several if shown is not None)
        layout = h5py.VirtualLayout((*first, *self.shape), known.dtype)
        for number, shown in enumerate(several):
            if shown is not None:
                place = (number,) if first else (slice(None), slice(None))
                layout[place] = h5py.VirtualSource(shown.file, shown.dataset, self.shape, shown.dtype)
        missing = np.nan if np.issubdtype(known.dtype, np.floating) else -1
        group.create_virtual_dataset(name, layout, fillvalue=missing).attrs.update(known.attributes)
