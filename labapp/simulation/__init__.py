"""Known pools, the forward model and rendered frames: ground truth from the geometry alone.

Nothing here calls the measuring code, so that an error in that code cannot stay hidden.
"""
