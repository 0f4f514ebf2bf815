"""Surface step: measure, show and assess the surface, compare schemes."""
