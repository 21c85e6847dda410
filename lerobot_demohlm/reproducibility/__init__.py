"""What lets a run be resumed, repeated and compared: hashes, fingerprints, locks, processes."""
