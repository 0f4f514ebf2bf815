"""Commands that compute with simulated pools and recordings."""
