"""Volumes back from projections."""
