"""Step 7: changes of the pool over the recording."""
