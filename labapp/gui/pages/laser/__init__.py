"""Laser: its angle and distance, determined from the cross hair (Appendix I)."""
