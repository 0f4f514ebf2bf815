"""Laser: its angle and distance, determined from the cross hair (Appendix I)."""

from labapp.gui.pages.laser.view import LaserPage

__all__ = ["LaserPage"]
