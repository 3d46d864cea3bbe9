#!/usr/bin/env bash
# Is pgfmd right on this machine, and how fast?  Writes a report of one page, results/acceptance/acceptance.md, to send back.
#
#   bash jobs/acceptance.sh [RANKS…]       # default: 1, 2, 4 … up to the cores (or SLURM's tasks); N=2048 points a side
#
# On each number of ranks: a run compared with that on one rank (fields, numbers, patches, checksums of the files), a wave
# with its exact solution, then seconds and messages of a solve.  In a batch job of several nodes give the numbers of
# ranks that the nodes hold.  LAUNCH="srun -n" starts ranks otherwise than "mpirun -n"; PYTHON=… is another interpreter,
# FOLDER=… another folder.
# Exit code 1: something is wrong, and the report says what.
set -euo pipefail

cd "$(dirname "${BASH_SOURCE[0]}")/.."
source tools/env.sh
python=${PYTHON:-$PWD/.venv/bin/python} folder=${FOLDER:-results/acceptance}
rm -f "$folder"/{checks,measured}.jsonl
most=${SLURM_NTASKS:-$(env -u OMP_NUM_THREADS nproc)}
ranks=("$@")
if [ $# -eq 0 ]; then
    for ((count = 1; count < most; count *= 2)); do ranks+=("$count"); done
    ranks+=("$most")
fi
[ "${ranks[0]}" = 1 ] || ranks=(1 "${ranks[@]}")

for count in "${ranks[@]}"; do
    ${LAUNCH:-mpirun -n} "$count" "$python" -m mpi4py tools/bench/acceptance.py check "$folder"
    ${LAUNCH:-mpirun -n} "$count" "$python" -m mpi4py tools/bench/scaling.py measure "$folder/measured.jsonl" --n "${N:-2048}" \
        >"$folder/measured.log"
done
"$python" tools/bench/acceptance.py report "$folder"
