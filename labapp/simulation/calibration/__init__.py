"""Pictures of targets and boards."""
