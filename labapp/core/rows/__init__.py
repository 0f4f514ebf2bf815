"""Rows and columns of the dots, found or corrected by hand."""
