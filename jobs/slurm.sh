#!/usr/bin/env bash
# One job, or an array of them, under SLURM; it is put into the queue again until all loads are solved.
#
#   sbatch jobs/slurm.sh JOB.toml DIR [--set section.key=value …]
#   sbatch --array=1-8 jobs/slurm.sh JOB.toml DIR            # eight surfaces: seed and folder are those of the task
#
# Two minutes before its time is over SLURM signals this script, which asks the run to stop: the run writes a checkpoint
# and ends with 75, and the script asks for a place in the queue again.  A run that got nowhere in its time ends with 1,
# one that you stop by `touch DIR/STOP` with 75: neither is queued again.
# PREPARE names a file to source first (modules, a container's wrapper, …), PYTHON the interpreter, LAUNCH how ranks are
# started.
#SBATCH --job-name=pgfmd
#SBATCH --nodes=1
#SBATCH --ntasks-per-node=4
#SBATCH --cpus-per-task=8
#SBATCH --time=04:00:00
#SBATCH --signal=B:USR1@120
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --output=pgfmd-%x-%A-%a.log
set -uo pipefail

[ $# -ge 2 ] || { echo "usage: sbatch $0 JOB.toml DIR [--set section.key=value …]" >&2; exit 2; }
job=$1 folder=$2
shift 2
# SLURM runs a copy of this script: the repository is where it was submitted from, unless PGFMD_ROOT says otherwise.
root=${PGFMD_ROOT:-${SLURM_SUBMIT_DIR:-$PWD}}
# shellcheck source=/dev/null
[ -z "${PREPARE:-}" ] || source "$PREPARE"
# Threads share a socket's memory and need no messages: few ranks with many threads are the fast setting.
export OMP_NUM_THREADS=${SLURM_CPUS_PER_TASK:-1} OMP_PROC_BIND=${OMP_PROC_BIND:-false}
export NUMBA_NUM_THREADS=$OMP_NUM_THREADS OPENBLAS_NUM_THREADS=1
source "$root/tools/env.sh"
python=${PYTHON:-$root/.venv/bin/python}
launch=${LAUNCH:-srun --cpus-per-task=$OMP_NUM_THREADS}

extra=()
if [ -n "${SLURM_ARRAY_TASK_ID:-}" ]; then
    folder=$folder/seed-$SLURM_ARRAY_TASK_ID
    extra=(--set "surface.seed=$SLURM_ARRAY_TASK_ID")
fi

# Whether you asked the run to stop: STOP, which stays, was made or touched since.
stop_file() { stat -c %i-%y "$folder/STOP" 2>/dev/null; }
before=$(stop_file)

# --restart also begins a run whose folder is empty.  It is asked to stop by a file, which every launcher lets through.
$launch "$python" -m mpi4py -m pgfmd run "$job" --output "$folder" --restart "${extra[@]}" "$@" &
run=$!
trap 'mkdir -p "$folder" && touch "$folder/.pgfmd.stop"' USR1 TERM
wait "$run"
code=$?
while kill -0 "$run" 2>/dev/null; do # the signal has ended the wait, not the run
    wait "$run"
    code=$?
done
if [ "$code" = 75 ] && [ "$(stop_file)" = "$before" ]; then
    scontrol requeue "$SLURM_JOB_ID"
fi
exit "$code"
