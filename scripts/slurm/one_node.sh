#!/usr/bin/env bash
# A SLURM of one node on this machine, to try batch scripts; `one_node.sh --help` says more.
set -euo pipefail
source "$(dirname -- "${BASH_SOURCE[0]}")/../lib/common.sh"

usage() {
    cat <<'TEXT'
usage: scripts/slurm/one_node.sh start DIR | stop DIR

Starts munged, slurmctld and slurmd with every file, socket and key of theirs under DIR (made if
there is none), beside any SLURM that the machine may have and in a container too: neither root
nor systemd nor cgroups are needed. Debian, Ubuntu: apt-get install slurm-wlm munge libpmix-dev (SLURM looks for libpmix.so,
which only that has, when srun starts MPI ranks). Then

  export SLURM_CONF=DIR/slurm.conf

lets sbatch, squeue, scontrol, scancel and srun find it. A requeued job starts again after 10 s.

Environment: SLURM_CPUS, the CPUs the node is said to have (default 8, however many there are).
TEXT
}

free_ports() {
    /usr/bin/python3 - "$1" <<'TEXT'
import socket, sys
sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(int(sys.argv[1]))]
print(*(s.getsockname()[1] for s in sockets))
TEXT
}

write_configuration() {
    local host user ports
    host=$(hostname -s)
    user=$(id -un)
    read -ra ports < <(free_ports 2)
    cat >"$dir/slurm.conf" <<TEXT
ClusterName=one_node
SlurmctldHost=$host(127.0.0.1)
SlurmctldPort=${ports[0]}
SlurmdPort=${ports[1]}
CommunicationParameters=NoCtldInAddrAny,NoInAddrAny
SlurmUser=$user
SlurmdUser=$user
AuthType=auth/munge
# A requeued job waits until its old credential has expired, by default two minutes.
AuthInfo=socket=$dir/munge/socket,cred_expire=5
StateSaveLocation=$dir/slurmctld
SlurmdSpoolDir=$dir/slurmd
SlurmctldPidFile=$dir/slurmctld.pid
SlurmdPidFile=$dir/slurmd.pid
SlurmctldLogFile=$dir/slurmctld.log
SlurmdLogFile=$dir/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SlurmdParameters=config_overrides
MpiDefault=none
ReturnToService=2
SchedulerParameters=sched_interval=5
KillWait=10
JobRequeue=1
NodeName=$host NodeAddr=127.0.0.1 CPUs=${SLURM_CPUS:-8} RealMemory=1000 State=UNKNOWN
PartitionName=all Nodes=$host Default=YES MaxTime=INFINITE State=UP
TEXT
}

start() {
    local program
    for program in munged slurmctld slurmd sbatch; do
        command -v "$program" >/dev/null ||
            die 70 "no $program on the PATH: apt-get install slurm-wlm munge"
    done
    mkdir -p "$dir"/{munge,slurmctld,slurmd}
    # munged wants its socket to be reached by all and its key by none.
    chmod 755 "$dir" "$dir/munge"
    (umask 077 && head -c 128 /dev/urandom >"$dir/munge/key")
    write_configuration
    export SLURM_CONF=$dir/slurm.conf

    munged --force --socket="$dir/munge/socket" --key-file="$dir/munge/key" \
        --pid-file="$dir/munged.pid" --log-file="$dir/munge/log" --seed-file="$dir/munge/seed" ||
        die 70 "munged did not start (see $dir/munge/log)"
    slurmctld -f "$SLURM_CONF" || die 70 "slurmctld did not start (see $dir/slurmctld.log)"
    slurmd -f "$SLURM_CONF" || die 70 "slurmd did not start (see $dir/slurmd.log)"
    for _ in {1..60}; do
        if [[ $(sinfo -h -o %T 2>/dev/null) == idle ]]; then return; fi
        sleep 0.5
    done
    stop
    die 70 "the node does not come up (see $dir/slurmctld.log, $dir/slurmd.log)"
}

# End what `start` has started, its jobs first.
stop() {
    local name pid
    export SLURM_CONF=$dir/slurm.conf
    if [[ -f $dir/slurmctld.pid ]]; then
        scancel --full --signal=KILL --user="$(id -un)" 2>/dev/null || true
        scancel --user="$(id -un)" 2>/dev/null || true
    fi
    for name in slurmd slurmctld munged; do
        pid=$(cat "$dir/$name.pid" 2>/dev/null) || continue
        kill "$pid" 2>/dev/null || continue
        for _ in {1..40}; do
            kill -0 "$pid" 2>/dev/null || break
            sleep 0.25
        done
        kill -KILL "$pid" 2>/dev/null || true
    done
}

case ${1:-} in
    -h | --help) usage; exit 0 ;;
    start | stop) (($# == 2)) || die 64 "$1 needs a folder (see --help)" ;;
    *) die 64 "start DIR or stop DIR (see --help)" ;;
esac
[[ $1 == stop ]] || mkdir -p -- "$2"
dir=$(cd -- "$2" && pwd -P)
"$1"
