#!/usr/bin/env bash
# Installs Slurm, on which the test of profiles/slurm runs, on Debian. Called by .ci/run; safe to call again. Where it may
# not or cannot, it says so, and that test is skipped.
set -euo pipefail

if command -v slurmctld slurmd sbatch >/dev/null; then
    exit 0
fi
install="apt-get update && apt-get install -y --no-install-recommends slurmctld slurmd slurm-client"
if [ "$(id -u)" = 0 ]; then
    DEBIAN_FRONTEND=noninteractive bash -c "$install" && exit 0
elif sudo -n true 2>/dev/null; then
    sudo DEBIAN_FRONTEND=noninteractive bash -c "$install" && exit 0
fi
echo "note: the test on Slurm is skipped; to run it: sudo bash -c '$install'" >&2
