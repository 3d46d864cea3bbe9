#!/usr/bin/env bash
# Is pgfmd right on this machine, and how fast?  Writes a report of one page, results/acceptance/acceptance.md, to send back.
#
#   bash jobs/acceptance.sh [RANKS…]       # default: 1, 2, 4 … up to the hardware threads (or SLURM's tasks)
#
# On each number of ranks: a run compared with that on one rank (fields, numbers, patches, checksums of the files), a wave
# with its exact solution, then seconds and messages of a solve (N=2048 points a side).  In a batch job of several nodes
# give the numbers of ranks that the nodes hold.  LAUNCH="srun -n" starts ranks otherwise than "mpirun -n"; PYTHON=… is
# another interpreter, FOLDER=… another folder, PATIENCE=600 the seconds after which a run counts as hanging.
# Exit code 1: something is wrong, and the report says what.
set -euo pipefail

root=${PGFMD_ROOT:-${SLURM_SUBMIT_DIR:-$(dirname "${BASH_SOURCE[0]}")/..}}
folder=$(realpath -m "${FOLDER:-$root/results/acceptance}")
[ -z "${PYTHON:-}" ] || python=$(realpath -s "$PYTHON")
cd "$root"
source tools/env.sh
python=${python:-$PWD/.venv/bin/python}
mkdir -p "$folder"
rm -f "$folder"/{checks,measured}.jsonl "$folder/acceptance.md"
most=${SLURM_NTASKS:-$(env -u OMP_NUM_THREADS nproc)}
ranks=("$@")
if [ $# -eq 0 ]; then
    for ((count = 1; count < most; count *= 2)); do ranks+=("$count"); done
    ranks+=("$most")
fi
[ "${ranks[0]}" = 1 ] || ranks=(1 "${ranks[@]}")
rows=256
for count in "${ranks[@]}"; do [ "$count" -le "$rows" ] || rows=$count; done

read -ra launcher <<<"${LAUNCH:-mpirun -n}"

launch() { # RANKS SCRIPT OPTIONS…
    timeout --foreground -k 20 "${PATIENCE:-600}" "${launcher[@]}" "$1" "$python" -m mpi4py "${@:2}"
}

failed=()
for count in "${ranks[@]}"; do
    launch "$count" tools/bench/acceptance.py check "$folder" --ranks "$count" --rows "$rows" &&
        launch "$count" tools/bench/scaling.py measure "$folder/measured.jsonl" --n "${N:-2048}" >"$folder/measured.log" ||
        failed+=("$count")
done
"$python" tools/bench/acceptance.py report "$folder" --failed "${failed[@]}"
