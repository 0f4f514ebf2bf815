"""Rows and columns of the dots, found automatically or corrected by the operator."""
