#!/usr/bin/env bash
# One job, or an array of them, under PBS (Professional, OpenPBS); it is submitted again until all loads are solved.
#
#   qsub -v JOB=job.toml,DIR=results/big jobs/pbs.sh
#   qsub -J 1-8 -v JOB=job.toml,DIR=results/seeds jobs/pbs.sh     # eight surfaces: seed and folder are those of the task
#
# The run watches its time itself: LIMIT, in seconds, a little less than the walltime.  Before it is over the run writes
# a checkpoint and ends with 75.  A run that got nowhere in its time ends with 1, one that you stop by `touch DIR/STOP`
# with 75: neither is submitted again.  PREPARE, PYTHON, LAUNCH: as in slurm.sh.
#PBS -N pgfmd
#PBS -l select=1:ncpus=32:mpiprocs=4:ompthreads=8
#PBS -l walltime=04:00:00
#PBS -j oe
#PBS -r y
set -uo pipefail

cd "${PBS_O_WORKDIR:-$PWD}" || exit 1
if [ -z "${JOB:-}" ] || [ -z "${DIR:-}" ]; then
    echo "usage: qsub -v JOB=job.toml,DIR=folder $0" >&2
    exit 2
fi
root=${PGFMD_ROOT:-$PWD} limit=${LIMIT:-14100}
# shellcheck source=/dev/null
[ -z "${PREPARE:-}" ] || source "$PREPARE"
export OMP_NUM_THREADS=${OMP_NUM_THREADS:-1} OMP_PROC_BIND=${OMP_PROC_BIND:-false}
export NUMBA_NUM_THREADS=$OMP_NUM_THREADS OPENBLAS_NUM_THREADS=1
source "$root/tools/env.sh"
python=${PYTHON:-$root/.venv/bin/python}
ranks=$(wc -l <"${PBS_NODEFILE:-/dev/null}")
launch=${LAUNCH:-mpirun -n $((ranks > 0 ? ranks : 1))}

seed=${SEED:-${PBS_ARRAY_INDEX:-}} folder=$DIR extra=(--set "run.time_limit=$limit")
if [ -n "$seed" ]; then
    folder=$DIR/seed-$seed
    extra+=(--set "surface.seed=$seed")
fi

# Whether you asked the run to stop: STOP, which stays, was made or touched since.
stop_file() { stat -c %i-%y "$folder/STOP" 2>/dev/null; }
before=$(stop_file)

# --restart also begins a run whose folder is empty.
$launch "$python" -m mpi4py -m pgfmd run "$JOB" --output "$folder" --restart "${extra[@]}"
code=$?
if [ "$code" = 75 ] && [ "$(stop_file)" = "$before" ]; then
    qsub -v "JOB=$JOB,DIR=$DIR,LIMIT=$limit,SEED=$seed" "$root/jobs/pbs.sh"
fi
exit "$code"
