"""Publication: the released folder, commitments, harnesses, results files and submissions."""
