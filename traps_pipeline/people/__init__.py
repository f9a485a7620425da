"""Work with people's labels.

Samples to label, people's scores, scores corrected by labels, and validation of judges.
"""
