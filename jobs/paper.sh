#!/usr/bin/env bash
# The paper, reproduced: all runs of figures F1–F9 and table T1, the figures, and the report.
#
#   bash jobs/paper.sh [--small] [FOLDER]      # FOLDER: results/paper, or results/paper-small
#
# Runs that are complete are not repeated: start it again after an interruption.  --small scales every grid down by 8, for
# a look in a coffee break; its numbers mean little.  RANKS=2 OMP_NUM_THREADS=1 changes the division of the cores.
set -euo pipefail

cd "$(dirname "${BASH_SOURCE[0]}")/.."
small=
if [ "${1:-}" = --small ]; then small=yes; shift; fi
folder=${1:-results/paper${small:+-small}}
ranks=${RANKS:-1}
export OMP_NUM_THREADS=${OMP_NUM_THREADS:-$(($(nproc) / ranks > 0 ? $(nproc) / ranks : 1))}
bash tools/setup.sh
source tools/env.sh
python=$PWD/.venv/bin/python

# size N LAMBDA_S: the overrides of a job at that size; scaled down, the shortest wave keeps its part of the cell where it
# can.
size() {
    local n=$1 shortest=$2
    if [ -n "$small" ]; then
        n=$((n / 8)) shortest=$((shortest / 8 > 0 ? shortest / 8 : 1))
    fi
    echo "grid.n=$n surface.lambda_s=$shortest.0"
}

# One line per run: name, job, overrides.
plan() {
    local h seed zeta points areas
    echo "large jobs/paper/large.toml $(size 4096 64)"
    for h in 0.3 0.8; do
        echo "scales-h$h jobs/paper/scales.toml $(size 2048 8) surface.hurst=$h"
    done
    for points in 2 4 8 16 32 64; do
        [ -n "$small" ] && [ "$points" -gt 16 ] && continue
        echo "resolution-$points jobs/paper/resolution.toml grid.n=$((32 * points)) surface.lambda_s=$points.0"
    done
    for seed in 1 2 3 4; do
        for h in 0.3 0.5 0.8; do
            [ "$h" = 0.3 ] && areas="load.contact_area=[0.04,0.08,0.09]" || areas=
            echo "exponents-h$h-s$seed jobs/paper/exponents.toml $(size 2048 1) surface.hurst=$h surface.seed=$seed $areas"
            echo "loads-h$h-s$seed jobs/paper/loads.toml $(size 1024 16) surface.hurst=$h surface.seed=$seed"
        done
        for zeta in 0.05 0.25 1.0; do
            echo "exponential-z$zeta-s$seed jobs/paper/exponential.toml $(size 1024 32) wall.zeta=$zeta surface.seed=$seed"
        done
    done
}

mkdir -p "$folder"
todo=$(plan | "$python" tools/pending.py "$folder")
total=$(printf '%s' "$todo" | grep -c . || true)
echo "$total of $(plan | wc -l) runs to do, $ranks rank(s) × $OMP_NUM_THREADS thread(s), into $folder"
done=0
while read -r name job overrides; do
    [ -n "$name" ] || continue
    done=$((done + 1))
    printf '%s  run %d of %d: %s\n' "$(date +%T)" "$done" "$total" "$name"
    settings=()
    for setting in $overrides; do settings+=(--set "$setting"); done
    mpirun -n "$ranks" "$python" -m mpi4py -m pgfmd run "$job" --output "$folder/$name" --overwrite "${settings[@]}" \
        </dev/null 2>"$folder/$name.log" || { cat "$folder/$name.log" >&2; exit 1; }
done <<<"$todo"

"$python" tools/report.py "$folder" --output "$folder/report"
echo "report: $folder/report/report.html"
