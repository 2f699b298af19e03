"""Recipes as TOML: data read by `kcgs.fit`."""
