"""labapp measures the surface of a molten weld pool in 3-D from a reflected dot matrix."""

__version__ = "0.1.0"
