"""Computations with simulated pools: chapters 4 and 8, error budgets."""

from labapp.core import schemes

SCHEME_NAMES = tuple(reversed(schemes.SCHEMES))
"""Names of the schemes in the studies: all of them, the default one last."""
