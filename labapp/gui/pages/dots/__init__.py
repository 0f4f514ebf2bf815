"""Step 5: the dots of a frame, their rows, and corrections by hand."""
