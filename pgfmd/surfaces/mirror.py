"""Mirror images of a surface, in a cell of twice the size."""

from __future__ import annotations

import numpy as np


def folded(count: int, copies: int) -> np.ndarray:
    """Index in the file of each of `count` grid points: 0 … m−1, and back to 0 if there are mirror images."""
    index = np.arange(count)
    return np.minimum(index, 2 * (count // copies) - 1 - index)
