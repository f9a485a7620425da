"""Sample units to label, score people, correct scores by labels, validate judges."""
