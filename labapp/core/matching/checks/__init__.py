"""Checks of labels and their surface: refusal of a frame, removal of a label."""
