#!/bin/sh
# A Slurm cluster of one node on loopback, for tests: slurm_one.sh start|stop DIR
# Needs root and (Debian 12) slurmctld slurmd slurm-client slurm-wlm-basic-plugins munge.
set -eu
action=${1:?usage: slurm_one.sh start|stop DIR}
dir=${2:?usage: slurm_one.sh start|stop DIR}
host=$(hostname -s)
export SLURM_CONF="$dir/slurm.conf"

# An own socket and key: a munged that runs on this machine already is left alone.
munge_start() {
  mkdir -p "$dir/munge"
  chmod 755 "$dir" "$dir/munge"
  chown -R munge "$dir/munge"
  runuser -u munge -- sh -c "umask 077; head -c 128 /dev/urandom > '$dir/munge/key'"
  runuser -u munge -- munged --key-file="$dir/munge/key" --socket="$dir/munge/socket" \
    --pid-file="$dir/munge/pid" --log-file="$dir/munge/log" --seed-file="$dir/munge/seed"
}

configure() {
  mkdir -p "$dir/state" "$dir/spool"
  echo "CgroupAutomount=no" > "$dir/cgroup.conf"
  cat > "$SLURM_CONF" <<CONF
ClusterName=one
SlurmctldHost=$host(127.0.0.1)
SlurmctldPort=16817
SlurmdPort=16818
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket=$dir/munge/socket,cred_expire=5
CredType=cred/munge
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU_Memory
DefMemPerCPU=1000
ReturnToService=2
MinJobAge=3600
KillWait=10
StateSaveLocation=$dir/state
SlurmdSpoolDir=$dir/spool
SlurmctldPidFile=$dir/slurmctld.pid
SlurmdPidFile=$dir/slurmd.pid
SlurmctldLogFile=$dir/slurmctld.log
SlurmdLogFile=$dir/slurmd.log
NodeName=$host NodeAddr=127.0.0.1 CPUs=$(nproc) RealMemory=$(awk '/MemTotal/{print int($2/1024*0.8)}' /proc/meminfo) State=UNKNOWN
PartitionName=main Nodes=$host Default=YES MaxTime=INFINITE State=UP
CONF
}

case $action in
start)
  munge_start
  configure
  slurmctld -f "$SLURM_CONF"
  slurmd -f "$SLURM_CONF"
  for _ in 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15; do
    sinfo -h -o %t 2>/dev/null | grep -q idle && exit 0
    sleep 1
  done
  echo "the node does not become idle" >&2
  for log in slurmctld slurmd; do tail -n 5 "$dir/$log.log"; done >&2
  exit 1
  ;;
stop)
  for pid in "$dir/slurmd.pid" "$dir/slurmctld.pid" "$dir/munge/pid"; do
    [ -s "$pid" ] && kill "$(cat "$pid")" 2>/dev/null || true
  done
  ;;
*)
  echo "usage: slurm_one.sh start|stop DIR" >&2
  exit 2
  ;;
esac
