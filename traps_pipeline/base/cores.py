"""Count the cores of this process, or those that a cluster reserved for its run."""

import os

CORES = "TRAPS_CORES"  # set by the submitter of a run on a cluster


def cores() -> int:
    """Return the number of cores to use, at least one."""
    n_allowed, setting = len(os.sched_getaffinity(0)), os.environ.get(CORES)
    return min(n_allowed, max(1, int(setting))) if setting else n_allowed
