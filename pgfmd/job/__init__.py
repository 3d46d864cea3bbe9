"""The TOML file as frozen dataclasses."""
