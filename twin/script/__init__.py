"""Acquila scan scripts: text to typed commands to a plan, each step plain data."""
