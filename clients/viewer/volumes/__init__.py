"""Volumes in the page: one that grows with its scan, and those of past scans."""
