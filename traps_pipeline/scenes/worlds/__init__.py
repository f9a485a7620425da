"""A scenario as data and as a simulated world: outcome, length of the clip, and its two clips."""
