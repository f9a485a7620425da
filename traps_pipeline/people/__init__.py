"""People's labels: samples to label, people's scores, scores corrected by labels, and validation of judges."""
