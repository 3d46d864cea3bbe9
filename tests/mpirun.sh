#!/usr/bin/env bash
# mpirun.sh RANKS PYTHON ARGUMENTS…: what tests/conftest.py starts; the settings are those of every script.
source "$(dirname "${BASH_SOURCE[0]}")/../tools/env.sh"
exec mpirun -n "$1" "$2" -m mpi4py "${@:3}"
