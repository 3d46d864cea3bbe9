"""Results of earlier formats as the present one has them.

1: spectra of stress, contact and bearing area were those of sums over points, N² larger than those of Fourier
   coefficients (N points); the area of low-passed surfaces was the corrected one.
2: every spectrum is that of Fourier coefficients; low-passed surfaces have both areas.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

SUMS_IN_1 = ("stress_spectrum", "contact_spectrum", "bearing_spectrum")


def modern(
    title: str, table: Mapping[str, np.ndarray], version: int, shape: tuple[int, int]
) -> Mapping[str, np.ndarray]:
    """A group of one load, read from a file of that format, on a grid of that shape.  One that needs no change
    is returned itself."""
    if version >= 2:
        return table
    if title in SUMS_IN_1:
        return {**table, "value": table["value"] / float(shape[0] * shape[1]) ** 2}
    if title == "lowpass_area":
        return {"q": table["q"], "area_corrected": table["area"]}
    return table
