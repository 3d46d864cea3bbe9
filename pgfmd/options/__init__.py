"""Options of a job as typed dataclasses: rules for one value, sections made of them, and their text as TOML."""
