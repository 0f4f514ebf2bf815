"""The dots of a frame, their rows, and corrections by hand."""
