"""Answer without a model: reference strategies, the observer, one-cue rules."""
