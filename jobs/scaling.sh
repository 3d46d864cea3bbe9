#!/usr/bin/env bash
# How a solve scales: seconds, messages and memory of runs on this machine, one rank's share of big ones, and from these
# a model of a big machine.
#
#   bash jobs/scaling.sh [RANKS…]          # default: 2 4 8 16; SIZES="256 512 1024 2048" on one rank, N=1024 on
#                                          # several, whose memory is measured at MEMORY=4096
#
# Writes results/scaling/: measured.jsonl, scaling-{model,parts,runs}.csv, scaling.png.
set -euo pipefail

cd "$(dirname "${BASH_SOURCE[0]}")/.."
source tools/env.sh
folder=results/scaling
mkdir -p "$folder"
rm -f "$folder/measured.jsonl"
ranks=("$@")
[ $# -gt 0 ] || ranks=(2 4 8 16)
n=${N:-1024}

tool() { # RANKS COMMAND OPTIONS…
    mpirun -n "$1" .venv/bin/python -m mpi4py tools/bench/scaling.py "$2" "$folder/measured.jsonl" "${@:3}"
}

for size in ${SIZES:-256 512 1024 2048}; do
    tool 1 measure --n "$size"
done
tool 4 measure --n "$size" --exchanged # the last and largest: its messages are counted
for count in "${ranks[@]}"; do
    tool "$count" measure --n "$n"
    tool "$count" memory --n "${MEMORY:-4096}"
done
for share in "2048 1" "4096 512" "16384 512" "65536 4096" "32768 4096"; do
    .venv/bin/python tools/bench/scaling.py emulate "$folder/measured.jsonl" --n "${share% *}" --ranks "${share#* }"
done
.venv/bin/python tools/bench/scaling.py draw "$folder/measured.jsonl" --output "$folder"
