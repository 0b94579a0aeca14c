"""Displays of values in a notebook."""
