"""Measured topographies in instruments' formats, read by the optional package SurfaceTopography.  No MPI here."""

from __future__ import annotations

import io
import warnings

from pgfmd.errors import InputError
from pgfmd.surfaces.measurement import Measurement, damage_reported

MISSING = (
    "is neither .npy nor HDF5 with a two-dimensional dataset; instruments' formats are read by SurfaceTopography, "
    "which is not installed here: run tools/setup.sh surfaces (or pip install SurfaceTopography)"
)


def read(path: str) -> Measurement:
    """The default channel of the file, by SurfaceTopography, which detects the format.

    Raises InputError, without the path: the package is not installed, the format is not known, the file damaged, or a
    line scan.
    """
    try:
        import SurfaceTopography
    except ImportError:
        raise InputError(MISSING) from None
    with damage_reported("cannot be read by SurfaceTopography"), warnings.catch_warnings(action="ignore"):
        with SurfaceTopography.open_topography(_source(path)) as reader:
            lengths, dim = reader.default_channel.physical_sizes, reader.default_channel.dim
            # That package makes no topography without sizes: a file that gives none gets sides of 1, ignored below.
            surface = reader.topography(**({} if lengths else {"physical_sizes": (1.0,) * dim}))
            name, unit = f"{reader.name()}, by SurfaceTopography", surface.unit
            matrix = reader.format() == "asc" and not lengths
            heights = surface.heights() if dim == 2 else None
    if heights is None:
        raise InputError("holds a line scan, not the heights of a surface")
    if matrix and 3 in heights.shape:
        raise InputError("three columns are x, y and height, but with points missing or units given they are not read")
    found = Measurement(heights, name, lengths and (float(lengths[0]), float(lengths[1])), unit)
    # That package takes the lines of a bare matrix as lines of an image, y; here they are x, as in .npy.
    return Measurement(heights.T, name, None, unit) if matrix else found


def _source(path: str) -> str | io.BytesIO:
    """The file; SDF of EUR 15178 (BCR) gets the magic word of ISO 25178-71, the one that the package knows."""
    with open(path, "rb") as file:
        if file.read(8) not in (b"aBCR-1.0", b"bBCR-1.0"):
            return path
        file.seek(0)
        content = file.read()
    return io.BytesIO(content[:1] + b"ISO" + content[4:])
