# shellcheck shell=bash
# Sourced by the bash scripts of this repository: how MPI programs are started on this machine.
# Everything is set through the environment, so that a plain `mpirun -n P …` works as root, in a container, and with
# more ranks than cores.  What the caller has set already is kept.

# An Open MPI that pip brought into .venv/ is the one that Python there uses.
pgfmd_bin=$(cd "$(dirname "${BASH_SOURCE[0]:-$0}")/.." && pwd)/.venv/bin
[ ! -x "$pgfmd_bin/mpirun" ] || PATH=$pgfmd_bin:$PATH

# Open MPI refuses to run as root unless told twice; version 5 reads the PRTE names.
export OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1
export PRTE_ALLOW_RUN_AS_ROOT=1 PRTE_ALLOW_RUN_AS_ROOT_CONFIRM=1

# More ranks than cores, as in the tests; and no binding, so that two runs at a time do not share one core.
export OMPI_MCA_rmaps_base_oversubscribe="${OMPI_MCA_rmaps_base_oversubscribe:-true}"
export OMPI_MCA_hwloc_base_binding_policy="${OMPI_MCA_hwloc_base_binding_policy:-none}"
export PRTE_MCA_rmaps_default_mapping_policy="${PRTE_MCA_rmaps_default_mapping_policy:-:oversubscribe}"
export PRTE_MCA_hwloc_default_binding_policy="${PRTE_MCA_hwloc_default_binding_policy:-none}"

# Docker forbids the system call by which Open MPI copies between processes, and every message would say so.
if [ -e /.dockerenv ] || [ -e /run/.containerenv ]; then
    export OMPI_MCA_btl_vader_single_copy_mechanism="${OMPI_MCA_btl_vader_single_copy_mechanism:-none}"
fi

# One thread per rank: the ranks fill the cores.
export OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}"
export NUMBA_NUM_THREADS="${NUMBA_NUM_THREADS:-$OMP_NUM_THREADS}"
export OPENBLAS_NUM_THREADS="${OPENBLAS_NUM_THREADS:-$OMP_NUM_THREADS}"

# mpi_flavour: "openmpi", "mpich" (and its descendants, Intel MPI among them) or "none".
mpi_flavour() {
    case "$(mpirun --version 2>&1 </dev/null)" in
        *"Open MPI"* | *OpenRTE*) echo openmpi ;;
        *HYDRA* | *MPICH* | *"Intel(R) MPI"*) echo mpich ;;
        *) echo none ;;
    esac
}
