"""USB input devices: foot switches and 3-D controllers."""
