# Shared by the batch scripts beside it; sourced, not run.
# shellcheck shell=bash

# The name under which messages come; what runs is SLURM's copy, slurm_script.
# shellcheck disable=SC2034
[[ ${0##*/} != slurm_script ]] || BASH_ARGV0=${SLURM_JOB_NAME:-batch script}

source "$(dirname -- "${BASH_SOURCE[0]}")/../lib/common.sh"

# --- Arguments -----------------------------------------------------------------------------

# read_arguments ARGUMENT...: set `out`, the directory behind --out, and `arguments`, the others.
read_arguments() {
    arguments=()
    out=
    while (($#)); do
        case $1 in
            --out)
                [[ $# -ge 2 ]] || die 64 "--out needs a directory"
                out=$2
                shift
                ;;
            --out=*) out=${1#*=} ;;
            *) arguments+=("$1") ;;
        esac
        shift
    done
    [[ -n $out ]] || die 64 "--out DIR is missing: a requeued job resumes from what is in DIR"
}

contains() {
    local wanted=$1 word
    shift
    for word in "$@"; do [[ $word != "$wanted" ]] || return 0; done
    return 1
}

# restart_arguments ARGUMENT...: set `arguments` to those of a job that has been requeued. --force
# allowed the first start to replace an old run, not the following ones to replace this one.
restart_arguments() {
    if contains --resume "$@"; then
        arguments=("$@")
        return
    fi
    local word
    arguments=(--resume)
    for word in "$@"; do [[ $word == --force ]] || arguments+=("$word"); done
}

# --- What SLURM gave -----------------------------------------------------------------------

# In an array SLURM_JOB_ID of one of the tasks stands for all of them.
job_id() {
    if [[ -n ${SLURM_ARRAY_TASK_ID:-} ]]; then
        echo "${SLURM_ARRAY_JOB_ID}_$SLURM_ARRAY_TASK_ID"
    else
        echo "$SLURM_JOB_ID"
    fi
}

job_ranks() {
    echo "${SLURM_NTASKS:-$((${SLURM_JOB_NUM_NODES:-1} * ${SLURM_NTASKS_PER_NODE:-1}))}"
}

# Threads and binding for mpirun and srun, from what was asked of sbatch.
job_environment() {
    local threads=${SLURM_CPUS_PER_TASK:-1}
    export NUMBA_NUM_THREADS=${NUMBA_NUM_THREADS:-$threads}
    if ((threads > 1)); then
        # srun no longer takes it over from sbatch (since 22.05).
        export SRUN_CPUS_PER_TASK=$threads
        # For Open MPI 4 and 5: so many cores for each rank, and the rank bound to them.
        export OMPI_MCA_rmaps_base_mapping_policy=slot:PE=$threads
        export PRTE_MCA_rmaps_default_mapping_policy=slot:PE=$threads
    fi
    # Where SLURM does not confine a job to its CPUs, Open MPI would bind every job on the node to
    # the same first cores.
    if [[ -n ${SLURM_CPUS_ON_NODE:-} ]] && (($(nproc) != SLURM_CPUS_ON_NODE)); then
        unset OMPI_MCA_rmaps_base_mapping_policy PRTE_MCA_rmaps_default_mapping_policy
        export OMPI_MCA_hwloc_base_binding_policy=none PRTE_MCA_hwloc_default_binding_policy=none
    fi
}

# --- One simulation ------------------------------------------------------------------------

# The batch scripts set `asked` when a signal comes: `requeue` on USR1, the warning of the time
# limit; `end` on TERM and INT.
child=

forward() {
    asked=$1
    case $asked in
        requeue) note "warned of the time limit: stopping with a checkpoint" ;;
        end) note "asked to end: stopping with a checkpoint" ;;
    esac
    [[ -z $child ]] || kill -USR1 "$child" 2>/dev/null
}

newest_checkpoint() {
    find "$1" -maxdepth 1 -name '*.checkpoint.*.h5' -printf '%T@ %f\n' 2>/dev/null |
        sort -n | tail -n 1
}

# simulate OUT ARGUMENT...: run a scene in the background, where signals interrupt the wait for
# it, until it ends; set its exit code `code` and `outcome`, a few words about it.
simulate() {
    local before newest
    out=$1
    shift
    [[ -x $root/.venv/bin/python ]] ||
        die 70 "no $root/.venv: run scripts/bootstrap where there is a network, then submit again"
    arguments=("$@")
    ((${SLURM_RESTART_COUNT:-0} == 0)) || restart_arguments "$@"
    if [[ -n ${SLURM_CPUS_PER_TASK:-} && "$*" != *--set[\ =]threads=* ]]; then
        arguments+=(--set "threads=$SLURM_CPUS_PER_TASK")
    fi
    job_environment
    before=$(newest_checkpoint "$out")

    trap 'forward requeue' USR1
    trap 'forward end' TERM INT
    code=75
    if [[ -z $asked ]]; then
        "$root/scripts/run" -n "$(job_ranks)" "${arguments[@]}" --out "$out" &
        child=$!
        await_child
    fi
    # Stopped so early that its traps did not stand: nothing had begun.
    ((code != 128 + $(kill -l USR1))) || code=75

    newest=$(newest_checkpoint "$out")
    if ((code == 0)); then
        outcome=finished
    elif ((code != 75)); then
        outcome="failed with $code"
    elif [[ $asked == end ]]; then
        outcome=stopped
    elif ((${SLURM_RESTART_COUNT:-0} > 0)) && [[ $newest == "$before" ]]; then
        outcome="stopped without progress"
    else
        outcome=requeued
    fi
}

await_child() {
    while :; do
        wait "$child"
        code=$?
        # Over 128 is either the child's own death by a signal or a trap that ran meanwhile.
        kill -0 "$child" 2>/dev/null || break
    done
    wait "$child" 2>/dev/null
    local settled=$?
    ((settled == 127)) || code=$settled
}

# End the job as `simulate` left it: requeue it if it is to go on.
end_job() {
    local again="to go on, submit it again with --resume"
    case $outcome in
        requeued)
            note "requeueing job $(job_id) (restart $((${SLURM_RESTART_COUNT:-0} + 1)))"
            scontrol requeue "$(job_id)" || die 75 "scontrol could not requeue the job; $again"
            ;;
        stopped) note "stopped as asked, not requeued; $again" ;;
        "stopped without progress")
            note "error: no new checkpoint since the last requeue, so the job is not requeued:" \
                "give it more time (--time) and look at what the start and a step take; $again"
            ;;
    esac
    exit "$code"
}
