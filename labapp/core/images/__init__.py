"""From a frame to the places of its dots."""
