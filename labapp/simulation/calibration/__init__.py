"""Pictures of targets, boards and known mirrors."""
