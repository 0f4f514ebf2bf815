"""Step 8: export of results."""
