#!/usr/bin/env bash
# The reference set: contacts of self-affine surfaces, each number with the error of its solver and grid and the scatter of
# its surfaces apart.
#
#   bash jobs/reference.sh [--large] [FOLDER]     # FOLDER: results/reference
#
# H from .2 to 1, λ_l/λ_r of 1, 4 and 16, λ_r/λ_s from 8 to 64 (grids to 1024²), 8 surfaces of each and 4 of the largest;
# one in ten is solved again on a grid of twice the points, to check the stated errors.  --large: λ_r/λ_s to 256 (grids to
# 4096²) and 16 surfaces of each: some 24 core-hours.  Complete runs are kept: start it again after a stop.  JOBS=N: runs at
# a time.  PYTHON=… takes that interpreter, and sets nothing up.
set -euo pipefail

cd "$(dirname "${BASH_SOURCE[0]}")/.."
large=0
if [ "${1:-}" = --large ]; then large=1; shift; fi
folder=${1:-results/reference}
jobs=${JOBS:-$(env -u OMP_NUM_THREADS nproc)} # nproc heeds that variable
[ -n "${PYTHON:-}" ] || bash tools/setup.sh
source tools/env.sh
export OMP_NUM_THREADS=1
python=${PYTHON:-$PWD/.venv/bin/python}

# One line per run, small grids first: name, job, overrides.
plan() {
    local points h rolloff n seed largest=1024 surfaces=8
    [ "$large" = 1 ] && largest=4096 surfaces=16
    for ((points = 64; points <= largest; points *= 2)); do
        for rolloff in 1 4 16; do
            [ $((points / 8 / rolloff)) -ge 8 ] || continue
            for ((seed = 1; seed <= (points == 1024 && large == 0 ? 4 : surfaces); seed++)); do
                for h in 0.2 0.4 0.6 0.8 1.0; do
                    n=h$h-l$rolloff-r$((points / 8 / rolloff))-s$seed
                    local keys="grid.n=$points surface.hurst=$h surface.lambda_r=$((points / rolloff)).0 surface.seed=$seed"
                    echo "$n jobs/reference.toml $keys"
                    if [ "$seed" = 1 ] && [ "$points" -le $((largest / 2)) ]; then
                        echo "$n-fine jobs/reference.toml $keys grid.refine=2"
                    fi
                done
            done
        done
    done
}

mkdir -p "$folder"
plan | "$python" tools/paper/runs.py "$folder" --jobs "$jobs"
"$python" tools/bench/reference_table.py "$folder" --output "$folder/table"
echo "tables and figures: $folder/table"
