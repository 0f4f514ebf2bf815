"""Line patterns: ridges, lines and their numbers, the surface under them, states over time."""
