"""Results of earlier formats as the present one has them.

1: spectra of stress, contact and bearing area were those of sums over points, N² larger than those of Fourier
   coefficients (N points); the area of low-passed surfaces was the corrected one.
2: every spectrum is that of Fourier coefficients; low-passed surfaces have both areas.  Where a wall of limited
   hardness yields, the gap was negative: minus the plastic depth.  Its field is converted; what was made from it, the
   mean gap and the gap's histogram and spectrum, is not known (NaN).
3: the gap is 0 where the wall yields; the plastic depth is a field and a column of its own.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

SUMS_IN_1 = ("stress_spectrum", "contact_spectrum", "bearing_spectrum")
OF_GAPS = {"gap_histogram": "density", "gap_spectrum": "value"}


def modern(
    title: str, table: Mapping[str, np.ndarray], version: int, shape: tuple[int, int], overlap: bool
) -> Mapping[str, np.ndarray]:
    """A group of one load, read from a file of that format, on a grid of that shape.  overlap: whether its gaps are
    negative where the wall yields.  One that needs no change is returned itself."""
    if overlap and title in OF_GAPS:
        return {**table, OF_GAPS[title]: np.full_like(table[OF_GAPS[title]], np.nan)}
    if version >= 2:
        return table
    if title in SUMS_IN_1:
        return {**table, "value": table["value"] / float(shape[0] * shape[1]) ** 2}
    if title == "lowpass_area":
        return {"q": table["q"], "area_corrected": table["area"]}
    return table
