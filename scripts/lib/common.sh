# Shared by the scripts beside this folder; sourced, not run. Sets `root`.
# shellcheck shell=bash

root=$(cd -- "$(dirname -- "${BASH_SOURCE[0]}")/../.." && pwd -P)

note() { printf '%s: %s\n' "${0##*/}" "$*" >&2; }

# die CODE MESSAGE: end with one line that says what to do.
die() {
    local code=$1
    shift
    note "error: $*"
    exit "$code"
}

# Physical cores this process may use.
physical_cores() {
    local cores allowed
    allowed=$(nproc)
    cores=$(lscpu -p=Core,Socket 2>/dev/null | grep -v '^#' | sort -u | wc -l)
    if ((cores < 1 || cores > allowed)); then cores=$allowed; fi
    echo "$cores"
}

# Flags of mpirun that differ between MPIs: without --quiet, Open MPI adds a banner of ten lines
# to a program's own one-line error.
mpirun_flags() {
    if mpirun --version 2>/dev/null | grep -q 'Open MPI'; then echo --quiet; fi
}

# mpi_environment RANKS: export what every rank should find. What is already set is kept.
mpi_environment() {
    local ranks=$1
    # One thread a rank unless the scene asks for more; numba is then told by the program itself.
    export OMP_NUM_THREADS=${OMP_NUM_THREADS:-1}
    export OPENBLAS_NUM_THREADS=${OPENBLAS_NUM_THREADS:-1}
    # numba's first choice, TBB, is too old in some distributions and then warns at every start.
    export NUMBA_THREADING_LAYER=${NUMBA_THREADING_LAYER:-omp}
    # Debian's h5py takes its serial build unless it sees Open MPI's own launcher.
    export H5PY_ALWAYS_USE_MPI=1
    # Packages under ~/.local would be found before the stack's own numpy and break petsc4py.
    export PYTHONNOUSERSITE=1
    if ((EUID == 0)); then
        export OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1
    fi
    if [[ -z ${SLURM_JOB_ID:-} ]]; then
        # Two runs on one machine would both be bound to the first cores, and a rank bound to one
        # core has no room for the scene's threads. A batch system knows better: left alone there.
        export OMPI_MCA_hwloc_base_binding_policy=${OMPI_MCA_hwloc_base_binding_policy:-none}
        if ((ranks > $(physical_cores))); then
            export OMPI_MCA_rmaps_base_oversubscribe=1 OMPI_MCA_mpi_yield_when_idle=1
        fi
    fi
}
