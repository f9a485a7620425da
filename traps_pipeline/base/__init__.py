"""What every other room uses: errors, files, digests, paths, keys, and what is said on a terminal."""
