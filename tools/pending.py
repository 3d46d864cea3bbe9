"""Which runs are still to be done: for scripts that can be started again.

    printf '%s\\n' "NAME JOB.toml section.key=value …" … | python tools/pending.py RESULTS

Reads one run per line, and prints those whose folder RESULTS/NAME does not hold a complete run of that very job.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from pgfmd.errors import InputError
from pgfmd.io.results import Results
from pgfmd.job import job as config


def is_done(folder: Path, job: str, overrides: list[str]) -> bool:
    """Whether the folder holds a complete run of the job.  Raises InputError if the job is not valid."""
    wanted = config.load(job, overrides)
    try:
        results = Results(folder)
        done = config.parse(results.provenance["effective_toml"], str(folder))
        return results.status == "complete" and not config.differences(done, wanted)
    except InputError:
        return False


def main(arguments: list[str] | None = None) -> int:
    """The command line; exit code 0, or 2 if a job is not valid."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path, metavar="RESULTS", help="folder of the result folders")
    folder = parser.parse_args(arguments).results
    try:
        for line in sys.stdin:
            if line.strip():
                name, job, *overrides = line.split()
                if not is_done(folder / name, job, overrides):
                    print(line.strip())
    except InputError as error:
        print(f"pending.py: error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
