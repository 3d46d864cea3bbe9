"""Random heights files of all kinds, the quick version of tools/bench/campaign_heights.py."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from conftest import ROOT, SIZE

pytest.importorskip("mpi4py")
sys.path.insert(0, str(ROOT / "tools" / "bench"))

import campaign_heights  # noqa: E402

from pgfmd.surfaces.file import FromFile  # noqa: E402

pytestmark = pytest.mark.skipif(SIZE > 1, reason="once is enough")


def test_random_files(tmp_path):
    """300 of them: the heights that were written, to the rounding of their format, or one line."""
    verdicts, bad = campaign_heights.campaign(7, range(300), tmp_path)
    assert not bad, "\n".join(bad[:5])
    assert verdicts["right"] > 150 and verdicts["refused"] > 20


@pytest.mark.parametrize(
    "spoil", [np.transpose, lambda heights: heights * (1 + 1e-12), lambda heights: np.nan_to_num(heights) * 1e6]
)
def test_wrong_heights_are_seen(tmp_path, monkeypatch, spoil):
    """A reader that turns its heights, rounds them or mistakes their unit is called wrong."""
    read = FromFile.heights

    def spoilt(self, grid, unit):
        found = spoil(read(self, grid, unit))
        return found if found.shape == grid.shape else np.resize(found, grid.shape)

    monkeypatch.setattr(FromFile, "heights", spoilt)
    _, bad = campaign_heights.campaign(7, range(20), tmp_path)
    assert len(bad) > 5
