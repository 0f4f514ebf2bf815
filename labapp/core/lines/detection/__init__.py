"""The lines in a frame: ridges, their joining to lines, and which are the pattern's own."""
