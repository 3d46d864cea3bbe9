#!/usr/bin/env bash
# Makes .venv/ in this checkout, ready to run pgfmd; every installation goes through this script.
#
#   bash tools/setup.sh [--parallel-hdf5] [test] [bench] [EXTRA …]
#
# Without a word: what runs jobs and draws figures, in wheels, among them Open MPI.  EXTRA: of pyproject.toml, in addition.
# --parallel-hdf5: the system's MPI and, compiled against it, h5py and mpi4py-fft; once made so, .venv/ stays so.
# test, bench: --parallel-hdf5, and
#   test   what the tests need, among it programs that read results (VTK, h5grove, netCDF4, a notebook's kernel) or
#          instruments' files, that solve the same contacts (tamaas, ContactMechanics), that build the documentation,
#          and a browser;
#   bench  what jobs/benchmark.sh compares with; compiles for some minutes.
#
# If nothing has changed it ends at once.  Missing Debian packages are installed if allowed (root, or sudo without a
# password), else listed.  Compiled packages are kept outside the checkout in ${PGFMD_WHEELS:-~/.cache/pgfmd/wheels}, for
# the next clone.  PGFMD_PYTHON chooses another Python than python3.
set -euo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
venv=$root/.venv
log=$root/.venv/setup.log
stamps=$venv/.ready
wheels=${PGFMD_WHEELS:-${XDG_CACHE_HOME:-${HOME:-/tmp}/.cache}/pgfmd/wheels}
source "$root/tools/env.sh"

say() { printf 'setup: %s\n' "$*"; }
fail() { printf 'setup: %s\n' "$*" >&2; exit 1; }

# quietly COMMAND…: into the log; where it fails, the end of what it said.
quietly() {
    "$@" >>"$log" 2>&1 </dev/null && return
    tail -n 15 "$log" >&2
    fail "this failed: $* (the whole story: $log)"
}

# The Python that the environment is made from, never that of an environment already active.
find_python() {
    local candidate found candidates=(python3 python3.14 python3.13 python3.12 python3.11)
    [ -z "${PGFMD_PYTHON:-}" ] || candidates=("$PGFMD_PYTHON")
    for candidate in "${candidates[@]}"; do
        found=$("$candidate" -c 'import sys; print(sys._base_executable); sys.exit(sys.version_info < (3, 11))' \
            2>/dev/null) && echo "$found" && return
    done
    candidate=${candidates[0]}
    found=$("$candidate" --version 2>/dev/null) || found="not here"
    fail "$candidate is $found; Python 3.11 or newer is needed: apt-get install python3 python3-venv python3-dev," \
        "or load a module, or set PGFMD_PYTHON to another one"
}

# One line that changes whenever the environment has to be made again.
fingerprint() {
    { mpirun --version 2>&1 || true; mpicc -show 2>&1 || true; echo /usr/lib/*/hdf5/*; } </dev/null | "$python" -c '
import hashlib, os, sys
digest = hashlib.sha256(repr((sys.version, sys.executable, sys.argv[1], sys.stdin.read())).encode())
for name in ("pyproject.toml", "tools/setup.sh"):
    digest.update(open(os.path.join(sys.argv[1], name), "rb").read())
print(digest.hexdigest())' "$root"
}

ready() {
    local extra
    for extra in $mode "$@"; do
        [ "$(cat "$stamps/$extra" 2>/dev/null)" = "$print" ] || return 1
    done
    [ -x "$venv/bin/python" ]
}

# ---- what the system has to bring -----------------------------------------------------------------------------------

has_header() { # HEADER [FOLDER [LANGUAGE]]
    echo "#include <$1>" | cc ${2:+"-I$2"} -x "${3:-c}" -c - -o /dev/null 2>/dev/null
}

# Prefix (with include/ and lib/) of an HDF5 that was built with MPI, or nothing.
parallel_hdf5() {
    local prefix compiler
    compiler=$(command -v h5pcc || true)
    for prefix in "${HDF5_DIR:-}" "${HDF5_ROOT:-}" "${HDF5_HOME:-}" "${EBROOTHDF5:-}" \
        "/usr/lib/$(cc -print-multiarch 2>/dev/null)/hdf5/$(mpi_flavour)" "${compiler:+${compiler%/bin/h5pcc}}"; do
        [ -n "$prefix" ] || continue
        printf '#include <hdf5.h>\n#ifndef H5_HAVE_PARALLEL\n#error serial\n#endif\n' |
            mpicc -I"$prefix/include" -x c -c - -o /dev/null 2>/dev/null && echo "$prefix" && return
    done
    return 0
}

# Debian packages for what is not there, whatever brought the rest (packages, environment modules, conda).
missing_packages() { # EXTRAS…
    local mpi
    "$python" -c 'import ensurepip, venv' 2>/dev/null || echo python3-venv
    [ $mode = parallel ] || return 0
    mpi=$(mpi_flavour)
    command -v cc >/dev/null && has_header stdio.h || echo gcc libc6-dev
    "$python" -c 'import os, sysconfig; open(os.path.join(sysconfig.get_path("include"), "Python.h"))' 2>/dev/null ||
        echo python3-dev
    command -v mpicc >/dev/null && [ "$mpi" != none ] || echo openmpi-bin libopenmpi-dev
    has_header fftw3.h "${FFTW_INCLUDE_DIR:-${FFTW_ROOT:-${FFTW_DIR:-/usr}}/include}" || echo libfftw3-dev
    if [ "$mpi" = mpich ]; then
        [ -n "$(parallel_hdf5)" ] || echo libhdf5-mpich-dev
    else
        [ -n "$(parallel_hdf5)" ] || echo libhdf5-openmpi-dev
    fi
    case " $* " in *" bench "*) has_header Eigen/Core "${EIGEN3_INCLUDE_DIR:-/usr/include/eigen3}" c++ ||
        echo g++ libeigen3-dev ;; esac # aspher
}

debian_install() { # PACKAGES…: as root or by sudo without a password; fails where neither may be, or a package is not there
    local sudo=""
    [ "$(id -u)" = 0 ] || sudo="sudo -n"
    command -v apt-get >/dev/null && { [ -z "$sudo" ] || $sudo true 2>/dev/null; } || return 1
    say "installing Debian packages: $* (under a minute)"
    $sudo apt-get -qq update >>"$log" 2>&1 </dev/null || true
    $sudo env DEBIAN_FRONTEND=noninteractive apt-get -qq install -y --no-install-recommends "$@" >>"$log" 2>&1 </dev/null
}

# The page of `pgfmd plot overview` is tested in a browser.
browser() {
    local name
    for name in chromium chromium-browser google-chrome google-chrome-stable; do
        command -v $name >/dev/null && return
    done
    debian_install chromium || say "no browser here: the tests of the overview page in one are skipped"
}

system_packages() { # EXTRAS…
    local missing
    missing=$(missing_packages "$@" | tr '\n' ' ')
    [ -n "$missing" ] || return 0
    # shellcheck disable=SC2086  # a list of words
    debian_install $missing || tail -n 5 "$log" >&2
    hash -r
    missing=$(missing_packages "$@" | tr '\n' ' ')
    case "$missing" in
        "" | libhdf5-*-dev\ ) ;;
        *) fail "missing on this system; install them, or load modules that bring the same (an MPI with mpicc, FFTW 3," \
            "HDF5 with MPI):${nl}    apt-get install $missing" ;;
    esac
    [ -z "$missing" ] || say "no HDF5 with MPI here: ranks will write past HDF5 (Debian: $missing)"
}
nl=$'\n'

# ---- what pip brings ------------------------------------------------------------------------------------------------

pip() { "$venv/bin/python" -m pip --disable-pip-version-check --no-input "$@"; }

make_venv() {
    local version
    version="$("$python" -c 'import sys; print(sys.version)') $root"
    [ $mode = parallel ] || version+=" $mode"
    if [ "$(cat "$venv/.python" 2>/dev/null)" != "$version" ] || ! pip --version >/dev/null 2>&1; then
        say "making .venv with $("$python" --version)"
        "$python" -m venv --clear "$venv" || fail "$python cannot make a virtual environment in $venv"
        printf '%s' "$version" >"$venv/.python"
    fi
    printf '*\n' >"$venv/.gitignore"
}

# Everything in wheels.
wheels_only() { # EXTRAS…
    say "installing Python packages (under a minute)"
    quietly pip install -q --no-compile -e "${root}[$(IFS=,; words=(mpi plot "$@"); echo "${words[*]}")]"
}

# The folder of the wheel cache for this combination of what compiled code depends on.
wheel_folder() {
    {
        "$python" -c 'import sys, sysconfig; print(sys.version, sysconfig.get_platform())'
        mpirun --version 2>&1 || true
        mpicc -show
        echo "$hdf5" "${FFTW_ROOT:-} ${FFTW_DIR:-}"
        [ -z "$hdf5" ] || grep -h 'define H5_VERS_INFO' "$hdf5/include/H5public.h"
    } </dev/null | sha256sum | cut -c 1-16 | sed "s|^|$wheels/|"
}

newest() { compgen -G "$folder/$1-*.whl" | sort -V | tail -n 1; }

# Into the wheel cache: what pyproject.toml asks for with these extras, but what is compiled here.
download() { # EXTRAS…
    local names mark staging
    mapfile -t names < <("$python" -c '
import sys, tomllib
project = tomllib.load(open(sys.argv[1], "rb"))["project"]
compiled = ("mpi4py-fft", "h5py") if sys.argv[2] else ("mpi4py-fft",)
names = project["dependencies"] + ["setuptools>=77"]
names += [name for extra in sys.argv[3:] for name in project["optional-dependencies"][extra]]
print(*(name for name in names if not name.startswith(compiled)), sep="\n")' "$root/pyproject.toml" "$hdf5" "$@")
    mark=$folder/complete-$(printf '%s\n' "${names[@]}" | sha256sum | cut -c 1-16)
    [ -e "$mark" ] && return
    say "downloading Python packages (under a minute, once on this machine)"
    rm -rf "$folder"/downloading.*
    staging=$(mktemp -d "$folder/downloading.XXXXXX")
    pip download -q --no-cache-dir --only-binary :all: --dest "$staging" "${names[@]}" >>"$log" 2>&1 </dev/null || return
    [ -z "$hdf5" ] || rm -f "$staging"/h5py-*.whl # other packages ask for it, and pip would take this one
    mv -f "$staging"/*.whl "$folder/"
    rmdir "$staging"
    touch "$mark"
}

# compiled NAME FILE COMPILER TIME: path of the wheel FILE-*.whl, made first if the cache has none.  mpi4py comes from its
# wheel and there is no build isolation, in which pip would compile it: its one C file can take 20 GB of memory.
compiled() {
    local build
    newest "$2" | grep . && return
    say "compiling $1 ($4, once on this machine)" >&2
    build=$(mktemp -d "$folder/building.XXXXXX")
    printf '[build_ext]\nparallel = 2\n' >"$build/options"
    {
        "$python" -m venv "$build/venv" &&
            "$build/venv/bin/python" -m pip install -q --no-cache-dir --only-binary :all: "$(newest numpy)" \
                "$(newest mpi4py)" "$(newest setuptools)" wheel cython pkgconfig &&
            env CC="$3" CFLAGS="-O2 -g0" DIST_EXTRA_CONFIG="$build/options" \
                HDF5_MPI=ON ${hdf5:+"HDF5_DIR=$hdf5" "LDFLAGS=-Wl,-rpath,$hdf5/lib"} \
                "$build/venv/bin/python" -m pip wheel -q --no-build-isolation --no-deps --no-binary "$1" \
                --no-cache-dir --wheel-dir "$build/out" "$1" &&
            mv -f "$build"/out/*.whl "$folder/"
    } >>"$log" 2>&1 </dev/null || { rm -rf "$build"; return 1; }
    rm -rf "$build"
    newest "$2"
}

python_packages() {
    local fft h5py="" extra offline extras=(fft plot) more=(docs look surfaces peers)
    folder=$(wheel_folder)
    mkdir -p "$folder"
    case " $* " in *" test "*) extras+=(test) ;; *) more=() ;; esac
    if [ ${#more[@]} != 0 ] && download "${extras[@]}" "${more[@]}"; then
        extras+=("${more[@]}")
    else
        [ ${#more[@]} = 0 ] || say "some packages for tests are not available for this Python ($log): their tests are skipped"
        download "${extras[@]}" || { tail -n 15 "$log" >&2; fail "packages could not be downloaded ($log)"; }
    fi
    fft=$(compiled mpi4py-fft mpi4py_fft cc "under a minute") ||
        { tail -n 15 "$log" >&2; fail "mpi4py-fft did not compile ($log)"; }
    if [ -n "$hdf5" ]; then
        h5py=$(compiled h5py h5py mpicc "some three minutes") || {
            say "h5py with MPI did not compile ($log): ranks will write past HDF5"
            quietly pip download -q --no-cache-dir --no-deps --only-binary :all: --dest "$folder/serial" h5py
        }
    fi
    say "installing Python packages (half a minute)"
    # The compiled ones first and by force: pip would keep a serial h5py of the same version.
    offline=(pip install -q --no-compile --no-index --find-links "$folder" --find-links "$folder/serial")
    quietly "${offline[@]}" --force-reinstall --no-deps "$fft" ${h5py:+"$h5py"}
    quietly "${offline[@]}" -e "${root}[$(IFS=,; echo "${extras[*]}")]"
    for extra in "$@"; do
        [ "$extra" = test ] && continue
        say "installing the extra packages of '$extra'$([ "$extra" != bench ] || echo ' (some minutes: they are compiled)')"
        quietly pip install -q --no-compile -e "${root}[$extra]"
    done
}

# Two ranks that see each other: the MPI that mpi4py found is the one of mpirun.  The imports leave their byte code,
# which pip did not make: compiling all that no run ever imports takes longer than the rest of the installation.  That
# of pgfmd spares each rank .2 s.
check_mpi() {
    local seen fft=""
    [ $mode = wheels ] || fft=", mpi4py_fft"
    source "$root/tools/env.sh" # mpirun may be new
    quietly env -u PYTHONDONTWRITEBYTECODE "$venv/bin/python" -c "
import h5py, matplotlib.pyplot, numba, pyfftw, scipy.optimize, scipy.special, tqdm$fft"
    quietly "$venv/bin/python" -m compileall -q "$root/pgfmd"
    seen=$(cd "$venv" && timeout 120 mpirun -n 2 "$venv/bin/python" -c '
from mpi4py import MPI
import h5py
total = MPI.COMM_WORLD.allreduce(1)
if MPI.COMM_WORLD.rank == 0:  # one alone, or the words of two would be mixed
    print("sum", total, "h5py", "with" if h5py.get_config().mpi else "without")' 2>&1 </dev/null) ||
        fail "two ranks do not start:$nl$seen"
    case "$seen" in
        *"sum 2 h5py with"*) ;;
        *) fail "mpirun and mpi4py belong to different MPIs: each rank is alone." \
            "Make one of them first in PATH and in LD_LIBRARY_PATH:$nl$seen" ;;
    esac
}

# ---- the order of things --------------------------------------------------------------------------------------------

[ ! -L "$venv" ] || fail "$venv is a link: run the set-up of the checkout that it belongs to"
exec 9<"$root" && { flock 9 2>/dev/null || true; } # a second set-up at the same time waits here
mode=wheels extras=()
[ ! -d "$stamps" ] || [ -e "$stamps/wheels" ] || mode=parallel
for word in "$@"; do
    case $word in --parallel-hdf5 | test | bench | fft) mode=parallel ;; esac
    [ "$word" = --parallel-hdf5 ] || extras+=("$word")
done
set -- "${extras[@]}"
[ $mode = wheels ] || [ ! -e "$stamps/wheels" ] || rm -rf "$venv" # it may be active, with an MPI of its own
python=$(find_python)
print=$(fingerprint)
ready "$@" && exit 0

mkdir -p "$venv" && : >"$log"
rm -rf "$stamps"
system_packages "$@"
case " $* " in *" test "*) browser ;; esac
make_venv
if [ $mode = wheels ]; then
    wheels_only "$@"
else
    hdf5=$(parallel_hdf5)
    python_packages "$@"
fi
check_mpi
mkdir -p "$stamps"
for extra in $mode "$@"; do
    fingerprint >"$stamps/$extra"
done
say "ready: $venv ($("$venv/bin/python" -c 'import h5py; print("h5py " + h5py.__version__, "with MPI" if h5py.get_config().mpi else "without MPI")'))"
