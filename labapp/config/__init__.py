"""Files written by users: setups of benches and scenarios for simulation (TOML)."""
