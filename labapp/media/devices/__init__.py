"""Foot switches and controllers: USB devices that are pressed and turned."""
