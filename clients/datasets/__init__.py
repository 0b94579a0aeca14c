"""Deprecated import paths."""
