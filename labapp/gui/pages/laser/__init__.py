"""Laser: its angle and distance from the cross hair on the work piece (Appendix I)."""

from labapp.gui.pages.laser.view import LaserPage

__all__ = ["LaserPage"]
