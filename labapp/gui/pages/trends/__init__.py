"""Changes of the pool over the recording."""
