"""Known pools, the forward model and rendered frames: truth, made from the geometry alone.

Nothing here calls the code that measures, so that a mistake there cannot hide itself.
"""
