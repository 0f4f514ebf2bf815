"""Imaging plane: O′ and the axes in the picture of the target (§5.1)."""

from labapp.gui.pages.plane.view import PlanePage

__all__ = ["PlanePage"]
