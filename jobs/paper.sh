#!/usr/bin/env bash
# The paper, reproduced: all runs of figures F1–F9 and table T1, the figures, and the report with a verdict on each claim
# (report.html and, where there is a browser, report.pdf).
#
#   bash jobs/paper.sh [--small | --full] [FOLDER]      # FOLDER: results/paper, or results/paper-small
#
# Runs that are complete are not repeated: start it again after an interruption.  As many runs go on at a time as there are
# cores (JOBS=1: one), each with one thread.  --full computes the limits instead: larger cells, more surfaces, more loads.
# Figures whose runs are not in FOLDER are taken from jobs/paper/results.  --small scales every grid down by 8, for a look
# in a coffee break; its verdicts mean little.  PYTHON=… takes that interpreter, and sets nothing up.
set -euo pipefail

cd "$(dirname "${BASH_SOURCE[0]}")/.."
small=1 plan=standard
case ${1:-} in
    --small) small=8 && shift ;;
    --full) plan=limits && shift ;;
esac
folder=${1:-results/paper$([ "$small" = 1 ] || echo -small)}
jobs=${JOBS:-$(env -u OMP_NUM_THREADS nproc)} # nproc heeds that variable
[ -n "${PYTHON:-}" ] || bash tools/setup.sh
source tools/env.sh
export OMP_NUM_THREADS=1
python=${PYTHON:-$PWD/.venv/bin/python}

# size N LAMBDA_S: the overrides of a job at that size.  Scaled down, the shortest wave keeps its part of the cell where it
# can: λ_s = a stays, others become 2 a or more.
size() {
    local n=$(($1 / small)) shortest=$2
    if [ "$shortest" -gt 1 ]; then shortest=$((shortest / small > 2 ? shortest / small : 2)); fi
    echo "grid.n=$n surface.lambda_s=$shortest.0 solid.thickness=$n.0"
}

# pressures H LAMBDA_S: those at which f_c is near 4 and 8 % (H = 0.3, λ_s = a: 9 % as well).
pressures() {
    case $1-$2 in
        0.3-1) echo "[0.00104,0.00216,0.00245]" ;;
        0.5-1) echo "[0.00124,0.00252]" ;;
        0.8-1) echo "[0.00155,0.00316]" ;;
        *) echo "[0.00147,0.003]" ;;
    esac
}

# One line per run: name, job, overrides; those of 4096² points come first.
standard() {
    local h seed zeta points n shortest seeds
    for seed in 1 2 3 4 5 6; do
        for h in 0.3 0.8; do
            echo "scales-h$h-s$seed-low jobs/paper/scales.toml $(size 4096 8) surface.hurst=$h surface.seed=$seed" \
                'output.observables=["histogram","spectra","lowpass"]'
            echo "scales-h$h-s$seed-high jobs/paper/scales.toml $(size 4096 8) surface.hurst=$h surface.seed=$seed" \
                "load.pressure=[0.001,0.0224,0.0295,0.0367,0.0461,0.0626,0.079,0.09,0.256]"
        done
    done
    for seed in 1 2 3 4 5 6 7 8; do
        echo "large-s$seed jobs/paper/large.toml $(size 4096 64) surface.seed=$seed"
    done
    for n in 4096 2048 1024 512; do
        case $n in 4096) seeds="1 2 3 4" ;; *) seeds="1 2 3 4 5 6 7 8" ;; esac
        for h in 0.3 0.5 0.8; do
            for seed in $seeds; do
                echo "exponents-n$n-h$h-s$seed jobs/paper/exponents.toml $(size $n 1) surface.hurst=$h surface.seed=$seed" \
                    "load.pressure=$(pressures $h 1)"
            done
        done
    done
    for shortest in 8 32; do
        for h in 0.3 0.8; do
            for seed in 1 2 3 4 5 6 7 8; do
                echo "shortest-l$shortest-h$h-s$seed jobs/paper/exponents.toml $(size 2048 $shortest) surface.hurst=$h" \
                    "surface.seed=$seed load.pressure=$(pressures $h $shortest)"
            done
        done
    done
    for seed in 1 2 3 4 5 6 7 8; do
        for h in 0.3 0.5 0.8; do
            echo "loads-h$h-s$seed jobs/paper/loads.toml $(size 1024 16) surface.hurst=$h surface.seed=$seed"
        done
        for h in 0.3 0.8; do
            echo "islands-h$h-s$seed jobs/paper/islands.toml $(size 512 1) surface.hurst=$h surface.seed=$seed" \
                "load.pressure=$(pressures $h 1)"
        done
    done
    for seed in 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16; do
        for zeta in 0.01 0.25 1.0; do
            echo "exponential-z$zeta-s$seed jobs/paper/exponential.toml $(size 1024 32) wall.zeta=$zeta surface.seed=$seed"
        done
    done
    for points in 2 4 8 16 32 64; do
        [ "$small" = 8 ] && [ "$points" -gt 16 ] && continue
        echo "resolution-$points jobs/paper/resolution.toml grid.n=$((32 * points)) surface.lambda_s=$points.0"
    done
}

# The same beyond the paper: cells to 8192 a, loads at given areas, eight ranges of the wall.
limits() {
    local h seed n shortest zeta
    for h in 0.3 0.8; do
        for seed in 1 2 3 4; do
            echo "limit-exponents-h$h-s$seed jobs/paper/exponents.toml $(size 8192 1) surface.hurst=$h" \
                "surface.seed=$seed load.pressure=$(pressures $h 1)" \
                'output.observables=["histogram","spectra","patches","bearing"]'
        done
        for seed in $(seq 5 32); do
            echo "limit-bearing-h$h-s$seed jobs/paper/exponents.toml $(size 8192 1) surface.hurst=$h surface.seed=$seed" \
                "load.pressure=[$([ "$h" = 0.3 ] && echo 0.00245 || echo 0.00316)]" \
                'output.observables=["spectra","patches","bearing"]'
        done
        for n in 8192 4096 1024; do
            for seed in $(seq $((n == 8192 ? 2 : n == 4096 ? 4 : 16))); do
                echo "limit-kappa-n$n-h$h-s$seed jobs/paper/loads.toml $(size $n 16) surface.hurst=$h surface.seed=$seed" \
                    "load.pressure=[0.00003,0.0001,0.00035,0.00073,0.0015]" \
                    'output.observables=["spectra","discretisation"]'
            done
        done
        for seed in $(seq 16); do
            echo "limit-crossover-h$h-s$seed jobs/paper/scales.toml $(size 2048 8) surface.hurst=$h surface.seed=$seed" \
                "load.pressure=[0.0036,0.0056,0.0076,0.0097,0.0119,0.0142,0.0167,0.0224,0.0285,0.0367,0.0462,0.0745]" \
                'output.observables=["spectra"]'
        done
        for seed in 1 2 3 4; do
            echo "limit-solved-h$h-s$seed jobs/paper/scales.toml $(size 2048 8) surface.hurst=$h surface.seed=$seed" \
                "load.contact_area=[0.02,0.08,0.24,0.5,0.8]" 'output.observables=["spectra","lowpass"]'
            for shortest in 1 2 4 8 16 32 64; do
                echo "limit-moment-l$shortest-h$h-s$seed jobs/paper/loads.toml $(size 2048 $shortest) surface.hurst=$h" \
                    "surface.seed=$seed load.contact_area=[0.005,0.02,0.08]" 'output.observables=["histogram"]'
            done
            for shortest in 16 32 64; do
                echo "limit-patches-l$shortest-h$h-s$seed jobs/paper/large.toml $(size 4096 $shortest)" \
                    "surface.hurst=$h surface.seed=$seed load.pressure=[0.00073,0.00314]" \
                    'output.observables=["patches"]'
            done
        done
        for seed in 1 2 3 4 5 6 7 8; do
            echo "limit-beyond-h$h-s$seed jobs/paper/exponents.toml $(size 2048 32) surface.hurst=$h surface.seed=$seed" \
                'load.pressure=[0.003] output.spectra.all_modes=true output.observables=["spectra","bearing"]'
        done
    done
    for seed in 1 2 3 4 5 6 7 8; do
        for zeta in 0.03 0.125 0.25 0.5 1.0 2.0 4.0 8.0; do
            echo "limit-wall-z$zeta-s$seed jobs/paper/exponential.toml $(size 1024 32) wall.zeta=$zeta surface.seed=$seed" \
                'output.fields=["height","gap"]'
        done
    done
}

mkdir -p "$folder"
$plan | "$python" tools/paper/runs.py "$folder" --jobs "$jobs"
"$python" tools/paper/report.py "$folder" --output "$folder/report" --jobs "$jobs" $([ "$small" = 1 ] || echo --small)
echo "report: $folder/report/report.html"
