"""Inner loops of the surface's steps, compiled for the processor (docs/adr/0018)."""
