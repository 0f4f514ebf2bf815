"""Which ray made which dot, and how sure."""
