#!/bin/sh
# A worker. Run it in the environment of the package (its `python` must be on the PATH), with the variables of
# deploy/README.md.
set -eu
: "${TRAPS_DATABASE:?}"
HEAD="${1:?the address of the head}"
exec ray start --address="$HEAD:6379" --disable-usage-stats --block
