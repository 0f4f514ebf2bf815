"""labapp measures the three-dimensional surface of a molten weld pool from a reflected dot matrix."""

__version__ = "0.1.0"
