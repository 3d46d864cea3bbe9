"""Measured topographies in instruments' own formats, through the optional package SurfaceTopography.  No MPI here."""

from __future__ import annotations

import warnings

import numpy as np

from pgfmd.errors import InputError
from pgfmd.options.text import printable
from pgfmd.surfaces.measurement import Measurement

MISSING = (
    "is neither .npy nor HDF5 with a two-dimensional dataset; instruments' formats are read by SurfaceTopography, "
    "which is not installed here: run tools/setup.sh surfaces (or pip install SurfaceTopography)"
)


def read(path: str) -> Measurement:
    """The default channel of the file, by SurfaceTopography, which finds out the format itself.

    Raises InputError: the package is not installed, the format is not known, the file damaged, a line scan, or points
    that were not measured.  Its text lacks the path.
    """
    try:
        import SurfaceTopography
    except ImportError:
        raise InputError(MISSING) from None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with SurfaceTopography.open_topography(path) as reader:
                lengths, dim = reader.default_channel.physical_sizes, reader.default_channel.dim
                # Without sizes there is no topography for that package.
                surface = reader.topography(**({} if lengths else {"physical_sizes": (1.0,) * dim}))
                format = reader.name()
                unit, missing = surface.unit, bool(surface.has_undefined_data)
                heights = None if dim != 2 or missing else np.array(surface.heights(), np.float64, order="C")
    except Exception as error:  # whatever a damaged file makes dozens of readers raise
        reason = printable(" ".join(str(error).split()), 200) or type(error).__name__
        raise InputError(f"cannot be read by SurfaceTopography: {reason}") from None
    if dim != 2:
        raise InputError("holds a line scan, not the heights of a surface")
    if missing:
        raise InputError("has points that were not measured; fill them first (SurfaceTopography: fill_undefined_data)")
    return Measurement(heights, lengths and tuple(float(value) for value in lengths), unit, format)
