#!/usr/bin/env bash
# Strong and weak scaling on this machine, through shared memory and in messages; a model of a big one from the parts.
#
#   bash jobs/scaling.sh [RANKS…]          # default: 1 2 4; sizes from SIZES="512 1024 2048"
#
# Writes results/scaling/: measured.jsonl, scaling-measured.csv, scaling-model.csv, scaling.png.
set -euo pipefail

cd "$(dirname "${BASH_SOURCE[0]}")/.."
source tools/env.sh
folder=results/scaling
mkdir -p "$folder"
rm -f "$folder/measured.jsonl"
ranks=("$@")
[ $# -gt 0 ] || ranks=(1 2 4)
for n in ${SIZES:-512 1024 2048}; do
    for count in "${ranks[@]}"; do
        ways=("")
        [ "$count" = 1 ] || ways=("" --exchanged)
        for way in "${ways[@]}"; do
            # shellcheck disable=SC2086
            mpirun -n "$count" .venv/bin/python -m mpi4py tools/scaling.py measure "$folder/measured.jsonl" --n "$n" $way
        done
    done
done
.venv/bin/python tools/scaling.py draw "$folder/measured.jsonl" --output "$folder"
