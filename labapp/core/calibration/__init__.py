"""Laser and imaging plane from readings and pictures (Appendix I, §4.2.1)."""
