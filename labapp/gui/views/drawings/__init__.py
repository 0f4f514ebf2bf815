"""Drawings of the bench, the cross hair and the pattern, with fields at their dimensions."""
