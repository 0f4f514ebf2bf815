"""Surface step: measure, show and assess the surface, compare schemes."""

from labapp.gui.pages.surface.view import SurfacePage

__all__ = ["SurfacePage"]
