"""The area of the contact patch that each point belongs to, for pictures of the patches.  No MPI."""

from collections.abc import Iterator

import numpy as np
from reading import Load
from scipy import ndimage, sparse

MOST_POINTS = 2**26  # of a grid whose patches are found here, in memory; a run can keep them as the field "labels"
PATCHES = f'the field "labels", or a hard wall, the field "pressure" and at most {MOST_POINTS:,} points'


def areas(load: Load, count: int) -> Iterator[np.ndarray] | None:
    """The area of the patch that each point belongs to (0: no contact), `count` rows at a time; None if the patches
    are not known: the field "labels" was not kept, and they cannot be found from the pressures.
    """
    point, size = np.prod(load.spacings), 8 * count * load.results.shape[1]
    if "labels" in load.fields:
        return _by_area(lambda: (rows for _, rows in load.results.blocks("labels", load.index, size)), point)
    if "pressure" not in load.fields or load.law != "hard" or np.prod(load.results.shape) > MOST_POINTS:
        return None
    contact = np.concatenate([rows > 0 for _, rows in load.results.blocks("pressure", load.index)])
    connectivity = load.job.get("output", {}).get("patches", {}).get("connectivity", 8)
    labels = labelled(contact, connectivity)
    return _by_area(lambda: (labels[start : start + count] for start in range(0, len(labels), count)), point)


def _by_area(blocks, point: float) -> Iterator[np.ndarray]:
    """Labels (0: none), which are read twice, as areas."""
    counts = np.zeros(1, int)
    for rows in blocks():
        before, counts = counts, np.bincount(rows.ravel(), minlength=len(counts))
        counts[: len(before)] += before
    counts[0] = 0
    yield from (counts[rows] * point for rows in blocks())


def labelled(contact: np.ndarray, connectivity: int = 8) -> np.ndarray:
    """Numbers of the connected sets of a periodic field of booleans, from 1 on; 0 elsewhere."""
    labels, count = ndimage.label(contact, np.ones((3, 3)) if connectivity == 8 else None)
    pairs = []
    for first, last in ((labels[0], labels[-1]), (labels[:, 0], labels[:, -1])):
        for shift in (-1, 0, 1) if connectivity == 8 else (0,):
            other = np.roll(last, shift)
            both = (first > 0) & (other > 0)
            pairs.append(np.stack([first[both], other[both]]))
    rows, columns = np.concatenate(pairs, axis=1)
    graph = sparse.coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(count + 1, count + 1))
    return sparse.csgraph.connected_components(graph, directed=False)[1].astype(labels.dtype)[labels]
