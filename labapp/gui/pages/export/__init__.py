"""Export of results."""
