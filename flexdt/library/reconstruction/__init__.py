"""Volumes from data sets, and volume files."""
