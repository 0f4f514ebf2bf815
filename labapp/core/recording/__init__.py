"""The frames of one recording: each from the one before, and whether they agree on the rows."""
