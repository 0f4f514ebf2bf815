"""Files that people write: the setup of the bench, and scenarios to simulate (TOML)."""
