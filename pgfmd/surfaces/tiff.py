"""Heights in TIFF images of one channel, through the optional package Pillow.  No MPI here."""

from __future__ import annotations

import warnings

import numpy as np

from pgfmd.errors import InputError
from pgfmd.surfaces.measurement import Measurement, damage_reported

SUFFIXES = (".tif", ".tiff")


def read(path: str) -> Measurement:
    """The values of the pixels, [line, column]; sizes and units in a TIFF are ignored: they are not those of heights.

    Raises InputError, without the path: Pillow is not installed, the file is damaged, holds colours or several images.
    """
    try:
        from PIL import Image
    except ImportError:
        raise InputError("TIFF images are read by Pillow, which is not installed here: pip install pillow") from None
    with damage_reported("cannot be read as a TIFF image"), warnings.catch_warnings(action="ignore"):
        with Image.open(path) as image:
            bands, count, values = image.getbands(), getattr(image, "n_frames", 1), np.array(image)
    if len(bands) > 1 or image.mode == "P" or values.ndim != 2:
        raise InputError(f"is an image of colours ({image.mode}), not of heights")
    if count > 1:
        raise InputError(f"holds {count} images; one of heights is needed")
    return Measurement(values, "TIFF image, values of pixels")
