#!/bin/sh
# The head: Ray without CPUs, so that no run starves it, and Dagster's daemon with its pages. Run it in the environment
# of the package (its `dagster` must be on the PATH), with the variables of deploy/README.md.
set -eu
: "${TRAPS_WORKSPACE:?}" "${TRAPS_DATABASE:?}"
ADDRESS="${1:?the address of this machine in your own network}"
ray start --head --node-ip-address="$ADDRESS" --num-cpus=0 --disable-usage-stats \
    --include-dashboard=true --dashboard-host="$ADDRESS" --dashboard-port=8265
export TRAPS_RAY="http://$ADDRESS:8265"
exec traps ui
