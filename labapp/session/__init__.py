"""Sessions: the set-up, the recording, corrections and results of an experiment in one file."""
