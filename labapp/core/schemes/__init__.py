"""The ways from matched dots to a surface, of one signature."""
