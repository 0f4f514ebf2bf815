"""Step 4: the recording or camera that provides the frames."""
