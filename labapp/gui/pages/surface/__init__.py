"""The surface step: measure, look at the surface, judge it, compare schemes."""

from labapp.gui.pages.surface.view import SurfacePage

__all__ = ["SurfacePage"]
