"""Parts of tools/bench/campaign.py: drawing random jobs, running, judging and shrinking them."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[3] / "tests"))  # for tests/reference.py
