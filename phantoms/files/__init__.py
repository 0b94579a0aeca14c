"""Phantoms from files: TOML and JSON definitions, meshes, glTF."""
