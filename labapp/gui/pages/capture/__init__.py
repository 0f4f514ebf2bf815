"""The recording or camera that provides the frames."""
