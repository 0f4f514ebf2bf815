"""A camera that is live: its picture, figures, surface, trends and limits."""
