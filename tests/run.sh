#!/usr/bin/env bash
# Prepares the environment and runs all tests: serially, then those marked `mpi` on 2, 3 and 4 ranks.
#
#   bash tests/run.sh [--long] [-k EXPRESSION] [tests/test_x.py …]     # whatever pytest understands
#
# RANKS="2 5" chooses other rank counts, LIMIT=SECONDS how long one of the four runs may take (a test: a third of that).
set -uo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
cd "$root" || exit 1
bash tools/setup.sh test || exit 1
source tools/env.sh
export MPLBACKEND=Agg PYTHONFAULTHANDLER=1
python=$root/.venv/bin/python
case " $* " in *" --long "*) limit=${LIMIT:-21600} ;; *) limit=${LIMIT:-1800} ;; esac
scratch=$(mktemp -d "${TMPDIR:-/tmp}/pgfmd-tests.XXXXXX") || exit 1
trap 'rm -rf "$scratch"' EXIT
failed=()

# Each rank: rank 0 speaks, the others write to a file that is shown if the run fails.
export PGFMD_TEST_PYTHON=$python PGFMD_TEST_SCRATCH=$scratch PGFMD_TEST_LIMIT=$((limit / 3))
one_rank='
rank=${OMPI_COMM_WORLD_RANK:-${PMI_RANK:-${PMIX_RANK:-${SLURM_PROCID:-0}}}}
[ "$rank" = 0 ] || exec >"$PGFMD_TEST_SCRATCH/rank-$rank.log" 2>&1
exec "$PGFMD_TEST_PYTHON" -m mpi4py -m pytest -m mpi -p no:cacheprovider --color no \
    --basetemp "$PGFMD_TEST_SCRATCH/tmp-$rank" -o faulthandler_timeout=$PGFMD_TEST_LIMIT -o faulthandler_exit_on_timeout=true "$@"'

on_ranks() { # RANKS ARGUMENTS…
    local ranks=$1 code log
    shift
    printf '\n==== %s ranks ====\n' "$ranks"
    rm -rf "${scratch:?}"/*
    timeout -k 20 "$limit" mpirun -n "$ranks" bash -c "$one_rank" rank "$@" </dev/null
    code=$?
    case $code in
        0 | 5) return 0 ;; # 5: the arguments leave no test for several ranks
        124 | 137) echo "stopped after $limit s" ;;
    esac
    for log in "$scratch"/rank-*.log; do
        printf '\n---- end of %s ----\n' "$(basename "$log" .log)"
        tail -n 40 "$log"
    done
    return 1
}

"$python" -m ruff check --quiet --output-format concise . || failed+=("ruff")
"$python" -m mypy || failed+=("mypy")
timeout --foreground -k 20 "$limit" "$python" -m pytest "$@" || failed+=("serial")
for ranks in ${RANKS:-2 3 4}; do
    on_ranks "$ranks" "$@" || failed+=("$ranks ranks")
done
[ ${#failed[@]} = 0 ] && exit 0
printf 'failed: %s\n' "$(IFS=,; echo "${failed[*]}")" >&2
exit 1
