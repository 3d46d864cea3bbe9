#!/usr/bin/env bash
# one_mpi.sh BIN FOLDER: the quickstart and the collective tests on 2 and 3 ranks, with python and mpirun of BIN.
set -e
cd "$(dirname "${BASH_SOURCE[0]}")/.."
source tools/env.sh
export PATH=$1:$PATH PYTHONPATH=$PWD MPLBACKEND=Agg
for ranks in 2 3; do
    "$1/mpirun" -n $ranks "$1/python" -m mpi4py -m pgfmd run jobs/quickstart.toml --output "$2/$ranks" --set grid.n=256
    "$1/mpirun" -n $ranks "$1/python" -m mpi4py -m pytest -q -p no:cacheprovider -m mpi tests/test_collectives.py \
        tests/test_grid.py >"$2/$ranks.log" || { tail -n 40 "$2/$ranks.log"; exit 1; }
    tail -n 1 "$2/$ranks.log"
done
