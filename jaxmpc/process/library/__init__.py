"""Processes that come with the package: a TOML file each, and the equations of those whose plant is a JAX function."""
