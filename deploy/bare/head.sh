#!/bin/sh
# The head: Ray without CPUs, so that no run starves it, and Dagster's daemon with its pages, of a study that is made
# where there is none. Run it in the environment of the package (its `python` must be on the PATH), with the variables
# of deploy/README.md: head.sh ADDRESS EXPERIMENT
set -eu
: "${TRAPS_WORKSPACE:?}" "${TRAPS_DATABASE:?}"
# A node that does not answer is dead after three checks of 5 s (docs/cluster.md, "When something dies").
export RAY_health_check_timeout_ms=5000 RAY_health_check_failure_threshold=3
ADDRESS="${1:?the address of this machine in your own network}"
EXPERIMENT="${2:?the experiment}"
ray start --head --node-ip-address="$ADDRESS" --num-cpus=0 --disable-usage-stats \
    --include-dashboard=true --dashboard-host="$ADDRESS" --dashboard-port=8265
export TRAPS_RAY="http://$ADDRESS:8265"
traps init "$EXPERIMENT" --database TRAPS_DATABASE
exec traps ui
