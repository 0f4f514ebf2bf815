"""Imaging plane: O′ and the axes in the picture of the target (§5.1)."""
