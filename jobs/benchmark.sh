#!/usr/bin/env bash
# Run time against error, of this solver and of its fastest peers, in one run on this machine.
#
#   bash jobs/benchmark.sh [DIR] [--all]
#
# Tables and pictures go to DIR (default results/benchmark).  It takes about an hour on two cores, which should have nothing
# else to do; --all adds every grid, surface and load, for a night.  Interrupted, it goes on where it was.
set -euo pipefail

cd "$(dirname "${BASH_SOURCE[0]}")/.."
folder=results/benchmark
all=
for argument in "$@"; do
    case $argument in --all) all=yes ;; *) folder=$argument ;; esac
done
bash tools/setup.sh bench
source tools/env.sh
run() { .venv/bin/python tools/benchmark.py "$1" "$folder" "${@:2}"; }

run transforms
run resolution
# The scaling of this solver alone, in time and in transforms.
for size in 512 1024 4096; do
    run run --n $size --methods pgfmd --lambda-s 16 n/64 --hurst 0.8
    run run --n $size --methods pgfmd --lambda-s 1 --hurst 0.3
done
# Everyone, on one core and on two: smooth and rough surfaces at the usual load, and near full contact.
for size in 1024 2048; do
    run run --n $size --lambda-s 16 n/64 --hurst 0.8 --repeat 2
    run run --n $size --lambda-s 1 --hurst 0.3 --repeat 2 --budget 200
    run run --n $size --lambda-s 16 --hurst 0.8 --area 0.9 --threads 1 --repeat 2 --budget 200
done
if [ -n "$all" ]; then
    for size in 512 1024 2048 4096; do
        run run --n $size --lambda-s 1 16 n/64 --hurst 0.3 0.8 --area 0.01 0.08 0.4 0.9 --repeat 2 --budget 600
    done
fi
