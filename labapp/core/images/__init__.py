"""Detection of the dots in a frame."""
