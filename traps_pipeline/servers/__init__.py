"""Pages that listen on this machine: the review of scenarios, and labels by people."""
