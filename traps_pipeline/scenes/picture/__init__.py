"""Frame, render and encode simulated worlds, and check their pixels."""
