#!/usr/bin/env bash
# From nothing to a picture: sets everything up, solves a rough contact on two ranks, draws it.
#
#   bash jobs/quickstart.sh [--parallel-hdf5]     # takes wheels; with it, the system's MPI and, compiled, HDF5 with MPI
set -euo pipefail

cd "$(dirname "${BASH_SOURCE[0]}")/.."
bash tools/setup.sh "$@"
source tools/env.sh
mpirun -n 2 .venv/bin/python -m mpi4py -m pgfmd run jobs/quickstart.toml --output results/quickstart --overwrite
.venv/bin/pgfmd plot overview results/quickstart
echo
echo "Result files and pictures: $PWD/results/quickstart"
echo "The run, its loads and headline numbers: .venv/bin/pgfmd info results/quickstart"
echo "Now change a number in jobs/quickstart.toml, and run again."
