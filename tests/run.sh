#!/usr/bin/env bash
# Prepares the environment and runs the tests, in stages; six minutes on two cores after the set-up.
#
#   bash tests/run.sh [--all | --long] [-k EXPRESSION] [tests/test_x.py …]     # whatever pytest understands
#
# Default: types and style; all tests but those marked `breadth` or `long`, in parallel processes; those marked `mpi` on
# two ranks, those marked `uneven` on three.  --all: then those marked `breadth`, and all marked `mpi` on 2, 3 and 4 ranks
# (or on $RANKS).  --long: then those marked `long`.
# BUDGET=SECONDS: the stages of --all begin only in the first two thirds of that time.  LIMIT=SECONDS: how long one stage
# may take.  WORKERS: how many processes run tests at a time.
set -uo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
cd "$root" || exit 1
breadth="" long="" arguments=()
for word in "$@"; do
    case $word in
        --all) breadth=1 ;;
        --long) breadth=1 long=1 ;;
        *) arguments+=("$word") ;;
    esac
done
bash tools/setup.sh test || exit 1
source tools/env.sh
export MPLBACKEND=Agg PYTHONFAULTHANDLER=1
python=$root/.venv/bin/python
limit=${LIMIT:-$([ "$long" ] && echo 21600 || echo 1800)}
scratch=$(mktemp -d "${TMPDIR:-/tmp}/pgfmd-tests.XXXXXX") || exit 1
trap 'rm -rf "$scratch"' EXIT
failed=() SECONDS=0 options=(--durations 10 --durations-min 2 -q)

stage() { # NAME COMMAND…: exit code 5 of pytest means that the arguments leave no test
    local name=$1 began=$SECONDS code
    shift
    printf '\n==== %s ====\n' "$name"
    "$@"
    code=$?
    case $code in
        0 | 5) code=0 ;;
        124 | 137) echo "stopped after $limit s" ;;
    esac
    [ $code = 0 ] || failed+=("$name")
    printf '==== %s: %s s ====\n' "$name" $((SECONDS - began))
}

more() { # the same for what only --all runs, while there is time
    if [ "$SECONDS" -lt $((${BUDGET:-1000000} * 2 / 3)) ]; then stage "$@"; else echo "no time left for: $1"; fi
}

style() {
    "$python" -m ruff check --quiet --output-format concise . & # beside the first tests, which begin with imports
    "$python" -m mypy && wait $!
}

in_parallel() { # PYTEST'S ARGUMENTS…
    timeout --foreground -k 20 "$limit" "$python" -m pytest -n "${WORKERS:-2}" --dist loadfile "${options[@]}" "$@" \
        "${arguments[@]}"
}

# Each rank: rank 0 speaks, the others write to a file that is shown if the run fails.
export PGFMD_TEST_PYTHON=$python PGFMD_TEST_SCRATCH=$scratch PGFMD_TEST_LIMIT=$((limit / 3))
one_rank='
rank=${OMPI_COMM_WORLD_RANK:-${PMI_RANK:-${PMIX_RANK:-${SLURM_PROCID:-0}}}}
[ "$rank" = 0 ] || exec >"$PGFMD_TEST_SCRATCH/rank-$rank.log" 2>&1
exec "$PGFMD_TEST_PYTHON" -m mpi4py -m pytest -p no:cacheprovider --color no \
    --basetemp "$PGFMD_TEST_SCRATCH/tmp-$rank" -o faulthandler_timeout=$PGFMD_TEST_LIMIT -o faulthandler_exit_on_timeout=true "$@"'

on_ranks() { # RANKS PYTEST'S ARGUMENTS…
    local ranks=$1 code log
    shift
    rm -rf "${scratch:?}"/*
    timeout -k 20 "$limit" mpirun -n "$ranks" bash -c "$one_rank" rank "${options[@]}" "$@" "${arguments[@]}" </dev/null
    code=$?
    case $code in 0 | 5) return 0 ;; esac
    for log in "$scratch"/rank-*.log; do
        printf '\n---- end of %s ----\n' "$(basename "$log" .log)"
        tail -n 40 "$log"
    done
    return $code
}

stage "style and types" style
stage "serial tests" in_parallel
stage "two ranks" on_ranks 2 -m mpi
stage "uneven slabs on three ranks" on_ranks 3 -m uneven
if [ "$breadth" ]; then
    options+=(--all)
    more "breadth" in_parallel -m breadth
    for ranks in ${RANKS:-2 3 4}; do
        more "$ranks ranks" on_ranks "$ranks" -m mpi
    done
fi
if [ "$long" ]; then
    options+=(--long)
    stage "long" in_parallel -m long
    for ranks in 2 3; do
        stage "long on $ranks ranks" on_ranks "$ranks" -m "mpi and long"
    done
    stage "other MPIs" timeout -k 20 "$limit" bash tests/mpis.sh
fi
echo "$SECONDS s"
[ ${#failed[@]} = 0 ] && exit 0
printf 'failed: %s\n' "$(IFS=,; echo "${failed[*]}")" >&2
exit 1
