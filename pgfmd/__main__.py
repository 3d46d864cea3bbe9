"""`python -m pgfmd`: see `cli`."""

import sys

from pgfmd.application.cli import main

if __name__ == "__main__":
    sys.exit(main())
