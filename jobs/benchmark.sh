#!/usr/bin/env bash
# Run time against error, of this solver and of its fastest peers, in one run on this machine.
#
#   bash jobs/benchmark.sh [DIR] [--all]
#
# Tables and pictures go to DIR (default results/benchmark), after each part of what is there by then; jobs/benchmark
# keeps some.  It takes three hours on two cores, which should have nothing else to do; --all adds every grid, surface and
# load, for a night, and needs 16 GB.
# Interrupted, it goes on where it was.
set -euo pipefail

cd "$(dirname "${BASH_SOURCE[0]}")/.."
folder=results/benchmark
all=
for argument in "$@"; do
    case $argument in --all) all=yes ;; *) folder=$argument ;; esac
done
bash tools/setup.sh bench
source tools/env.sh
run() { .venv/bin/python tools/bench/benchmark.py "$1" "$folder" "${@:2}"; }

run transforms
run cores
run resolution
# Everyone: a smooth surface on one core and on two, a rough one and two near full contact on one core.
run run --n 1024 --lambda-s 16 --hurst 0.8 --repeat 2
run run --n 1024 --lambda-s 1 --hurst 0.3 --threads 1 --repeat 1
run run --n 1024 --lambda-s 16 --hurst 0.8 --area 0.9 0.99 --threads 1 --repeat 1
# This solver alone from small to large: growth in transforms, and what a second core gains.
run run --n 512 1024 --methods pgfmd --lambda-s n/64 --hurst 0.8
run run --n 512 1024 --methods pgfmd --lambda-s 1 --hurst 0.3
run run --n 4096 --methods pgfmd --lambda-s n/64 --hurst 0.8 --repeat 1
run run --n 4096 --methods pgfmd --lambda-s 1 --hurst 0.3 --repeat 1
# Everyone again, on four times the points, peers at the settings that were best so far.
run run --n 2048 --lambda-s 16 n/64 --hurst 0.8 --threads 1 --repeat 1 --budget 300
run run --n 2048 --lambda-s 1 --hurst 0.3 --threads 1 --repeat 1 --budget 300
run run --n 2048 --lambda-s 16 --hurst 0.8 --area 0.9 --threads 1 --repeat 1 --budget 300
# Transforms to a certified error of 1e-8, and to 1e-12, from rough to smooth; time and memory.
loads=(--hurst 0.3 0.8 --area 0.05 0.2 0.5 0.7)
run counts --n 1024 2048 4096 --lambda-s 1 2 4 8 16 "${loads[@]}" --seeds 1 2 3
run counts --n 1024 2048 --lambda-s 1 16 "${loads[@]}" --tolerance 1e-12
run counts --n 1024 2048 4096 --lambda-s 16 "${loads[@]}" --seeds 1 2 3 --ranks 2
if [ -n "$all" ]; then
    run counts --n 8192 --lambda-s 2 4 8 "${loads[@]}" --seeds 1 2 3
    run counts --n 8192 16384 --lambda-s 16 "${loads[@]}" --seeds 1 2 3 --ranks 1 2
    run counts --n 8192 16384 --lambda-s 16 --area 0.2 0.5 --methods ASPHER
    for size in 512 1024 2048 4096; do
        run run --n $size --lambda-s 1 16 n/64 --hurst 0.3 0.8 --area 0.01 0.08 0.4 0.9 --repeat 2 --budget 600
    done
fi
