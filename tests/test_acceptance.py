"""jobs/acceptance.sh: what a user of a cluster runs and sends back."""

import json
import math
import os
import subprocess
import sys

import acceptance
import pytest
from conftest import ROOT, starts_mpirun


@starts_mpirun
@pytest.mark.breadth
def test_the_script_writes_its_page(tmp_path):
    """On one and two ranks all is right, and the page has a row for each, with its seconds and messages."""
    environment = os.environ | {"FOLDER": str(tmp_path), "N": "128", "PYTHON": sys.executable}
    command = ["bash", str(ROOT / "jobs" / "acceptance.sh"), "2"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "acceptance.md").read_text()
    assert "**All is right on 1, 2 ranks.**" in page
    for ranks in (1, 2):
        assert f"| {ranks} | {ranks} |" in page and f"| 128 | {ranks} | 1 |" in page


@pytest.mark.parametrize("name", acceptance.ALLOWED)
@pytest.mark.parametrize("value", [1.0, math.nan])
def test_what_is_wrong_is_said(tmp_path, capsys, name, value):
    """An error that is too large, or is no number, stands in the first line, and the exit code is 1."""
    line = {"ranks": 4, "errors": dict.fromkeys(acceptance.ALLOWED, 0.0) | {name: value}, "nodes": [4], "machine": {}}
    (tmp_path / "checks.jsonl").write_text(json.dumps(line) + "\n")
    assert acceptance.main(["report", str(tmp_path)]) == 1
    assert f"**WRONG: 4 ranks: {name} " in (tmp_path / "acceptance.md").read_text()


def test_ranks_that_failed_are_said(tmp_path):
    """Runs that ended with an error, or not at all, stand in the first line, also where no other has ended."""
    assert acceptance.main(["report", str(tmp_path), "--failed", "8", "16"]) == 1
    text = (tmp_path / "acceptance.md").read_text()
    assert (
        "**WRONG: 8 ranks: ended with an error, or did not end; 16 ranks: ended" in text and "no run has ended" in text
    )
