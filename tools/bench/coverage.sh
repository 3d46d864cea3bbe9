#!/usr/bin/env bash
# How many lines of pgfmd/ the default tests run; compiled loops are counted by running them uncompiled on small grids.
#
#   bash tools/bench/coverage.sh [PYTEST'S ARGUMENTS…]     # after `bash tools/setup.sh test`; some 12 minutes
#
# Leaves .coverage, with the tests that run each line, for mutants.py.
set -euo pipefail

cd "$(dirname "${BASH_SOURCE[0]}")/../.." || exit 1
source tools/env.sh
export MPLBACKEND=Agg PYTHONPATH=$PWD:$PWD/tools/bench COVERAGE_RCFILE=$PWD/tools/bench/coverage.ini COVERAGE_FILE=$PWD/.coverage
python=$PWD/.venv/bin/python
rm -f .coverage .coverage.*
"$python" -m coverage run -m pytest -q -p no:cacheprovider "$@" | tail -n 3
PGFMD_CACHE=$(mktemp -d) "$python" -m coverage run -m pytest -p uncompiled -q -p no:cacheprovider \
    tests/test_{kernels,patches,contact_line,inner,certify,hard_wall,exponential,formula_wall,hardness,loads,grid}.py \
    tests/test_{surfaces,topography,observables,spectra,light_loads,gfmd,bearing,leakage}.py | tail -n 1
"$python" -m coverage combine -q
"$python" -m coverage report --skip-covered --sort=miss | tail -n 60
