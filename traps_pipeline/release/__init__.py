"""What others install, load, cite, run elsewhere and hold us to: the released folder, commitments, submissions."""
