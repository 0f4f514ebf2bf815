"""Where laser and imaging plane should stand for the pools expected."""
