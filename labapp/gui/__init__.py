"""Graphical interface: views do not know the session, presenters compute the displayed values."""
