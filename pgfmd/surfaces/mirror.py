"""Mirror images of a surface, in a cell of twice the size."""

from __future__ import annotations

import numpy as np


def folded(count: int, copies: int) -> np.ndarray:
    """Index in the file of each of `count` grid points along a side.

    copies: 1 gives 0 … count−1; 2, with a mirror image, 0 … m−1, m−1 … 0 for m = count/2.
    """
    index = np.arange(count)
    return np.minimum(index, 2 * (count // copies) - 1 - index)
