#!/usr/bin/env bash
# Runs a command on a Slurm of this one machine that lives no longer than it: in namespaces of its own, nothing is left.
#   unshare --mount --pid --fork --kill-child --mount-proc on_slurm.sh FOLDER COMMAND...
set -euo pipefail
folder=$(realpath "$1"); shift
host=$(hostname -s)
port=$((20000 + RANDOM % 20000))
mkdir -p "$folder"/{conf,state,spool}
# A card is any character device to Slurm: here a second /dev/null.
mknod "$folder/card" c 1 3
echo "Name=gpu File=$folder/card" >"$folder/conf/gres.conf"
# More cores and memory than there are: the test looks at what jobs ask for, and they do next to nothing.
cat >"$folder/conf/slurm.conf" <<END
ClusterName=test
SlurmctldHost=$host(127.0.0.1)
SlurmctldPort=$port
SlurmdPort=$((port + 1))
SlurmUser=root
SlurmdUser=root
AuthType=auth/none
CredType=cred/none
StateSaveLocation=$folder/state
SlurmdSpoolDir=$folder/spool
SlurmctldPidFile=$folder/slurmctld.pid
SlurmdPidFile=$folder/slurmd.pid
SlurmctldLogFile=$folder/slurmctld.log
SlurmdLogFile=$folder/slurmd.log
PlugStackConfig=/dev/null
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
SwitchType=switch/none
AccountingStorageType=accounting_storage/none
JobAcctGatherType=jobacct_gather/none
ReturnToService=2
MinJobAge=900
KillWait=2
SchedulerParameters=batch_sched_delay=0,sched_interval=1,sched_min_interval=0
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
SlurmdParameters=config_overrides
GresTypes=gpu
NodeName=$host NodeAddr=127.0.0.1 CPUs=16 RealMemory=64000 Gres=gpu:1 State=UNKNOWN
PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE State=UP
PartitionName=cards Nodes=ALL MaxTime=INFINITE State=UP
END
# Where programs look for it that are started without SLURM_CONF, as job steps are.
mount --bind "$folder/conf" /etc/slurm

wait_for() {
    for _ in $(seq 200); do "$@" >/dev/null 2>&1 && return; sleep 0.1; done
    echo "no answer from: $*" >&2
    tail -n 5 "$folder"/*.log >&2
    exit 90
}
slurmctld -D >"$folder/slurmctld.out" 2>&1 &
wait_for scontrol ping
slurmd -D -N "$host" >"$folder/slurmd.out" 2>&1 &
wait_for bash -c "sinfo -h -o %t | grep -qx idle"
"$@"
