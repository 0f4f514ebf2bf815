"""Pictures, plots, fields and the 3-D view: reusable, knowing nothing of sessions."""
