"""The window: its steps, menus, actions and messages."""
